"""Diagnosis of the machine: missing requirements, slow parts, and advice."""

from __future__ import annotations

import ctypes.util
import os
import platform
import re
import shutil
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Literal

from lightsim.core.cores import core_count
from lightsim.core.version import __version__
from lightsim.errors import ArtefactError, InputError
from lightsim.store.weights import WEIGHTS_FOLDER, list_weights, read_record

State = Literal["ok", "note", "missing"]

# Bytes of a GiB.
_GIB = 1 << 30
# Free memory, in GiB, for a build of a log at full size.
_MIN_MEMORY_GIB = 8
# Free disk space, in GiB, for one work folder.
_MIN_DISK_GIB = 10
# Instruction sets that ray casting and training use.
_CPU_FEATURES = ("avx", "avx2", "avx512f", "f16c", "fma")
# Versions of libLLVM that are searched for, newest first; Mitsuba needs 15 or newer.
_LLVM_VERSIONS = range(25, 14, -1)


@dataclass(frozen=True)
class Finding:
    """One line of the report.

    Args:
        topic: "python", "package", "processor", "memory", "disk", "gpu", "renderer", "weights" or
            "data".
        name: checked item.
        value: result of the check.
        state: "missing": LightSim cannot run; "note": something is slow or unavailable.
        advice: remedy or consequence; empty for "ok".
    """

    topic: str
    name: str
    value: str
    state: State = "ok"
    advice: str = ""


@dataclass(frozen=True)
class DoctorReport:
    """All findings, in order."""

    findings: tuple[Finding, ...]

    @property
    def is_ready(self) -> bool:
        """True if no requirement is missing."""
        return all(finding.state != "missing" for finding in self.findings)

    def to_table(self) -> str:
        """Return plain text: one line per finding, then the advice."""
        width = max(len(f.name) for f in self.findings) + 2
        mark = {"ok": "ok", "note": "note", "missing": "MISSING"}
        lines = [
            f"{mark[f.state]:9s}{f.topic:11s}{f.name:{width}s}{f.value}" for f in self.findings
        ]
        advice = [f"- {f.name}: {f.advice}" for f in self.findings if f.advice]
        head = "ready" if self.is_ready else "NOT ready: install what is missing"
        return "\n".join([*lines, "", f"LightSim {__version__} is {head}.", *advice])


def diagnose(folder: Path | None = None) -> DoctorReport:
    """Check packages, processor, memory, disk of `folder`, GPU, renderers and weights.

    Heavy packages are found by their metadata and not imported.
    """
    findings = [
        _python(),
        *_packages(),
        *_processor(Path("/proc/cpuinfo")),
        *_memory(Path("/proc/meminfo")),
        _disk(folder or Path.cwd()),
        _gpu(),
        _llvm(),
        *_weights(WEIGHTS_FOLDER),
        _data(os.environ.get("LIGHTSIM_DATA")),
    ]
    return DoctorReport(tuple(findings))


def _python() -> Finding:
    # The package cannot be installed or imported with a version that is too old.
    value = f"{platform.python_version()} on {platform.system()} {platform.machine()}"
    return Finding("python", "Python", value)


def _packages() -> list[Finding]:
    """Return the declared requirements with their versions; missing optional ones are notes."""
    findings: list[Finding] = []
    for requirement in metadata.requires("lightsim") or []:
        name = re.match(r"[A-Za-z0-9_.-]+", requirement)
        extra = re.search(r"extra\s*==\s*['\"]([\w-]+)['\"]", requirement)
        # Users of LightSim need neither the tools of its development nor of its documentation.
        if name is None or (extra and extra[1] in ("dev", "docs")):
            continue
        version = _version(name[0])
        if version is not None:
            findings.append(Finding("package", name[0], version))
        elif extra:
            advice = f"Optional. Run: pip install 'lightsim[{extra[1]}]'"
            findings.append(Finding("package", name[0], "not installed", "note", advice))
        else:
            advice = f"Run: pip install '{requirement.split(';')[0].strip()}'"
            findings.append(Finding("package", name[0], "not installed", "missing", advice))
    return findings


def _version(distribution: str) -> str | None:
    # Metadata is read, because importing torch or mitsuba takes seconds.
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return None


def _processor(cpuinfo: Path) -> list[Finding]:
    text = cpuinfo.read_text() if cpuinfo.is_file() else ""
    model = re.search(r"model name\s*:\s*(.+)", text)
    # Processors of ARM list "Features" instead of flags; their instructions are not checked.
    flags = re.search(r"flags\s*:\s*(.+)", text)
    cores = core_count()
    name = model[1].strip() if model else platform.processor() or "unknown processor"
    advice = (
        ""
        if cores >= 4
        else "Building takes many minutes; try --preset draft and --image-scale 0.25."
    )
    state: State = "note" if advice else "ok"
    findings = [Finding("processor", "CPU", f"{name}, {cores} usable cores", state, advice)]
    if flags is None:
        return findings
    present = [feature for feature in _CPU_FEATURES if feature in flags[1].split()]
    value = " ".join(present) or "none of " + " ".join(_CPU_FEATURES)
    if "avx2" in present:
        return [*findings, Finding("processor", "instructions", value)]
    slow = "Without AVX2, ray casting and training are several times slower."
    return [*findings, Finding("processor", "instructions", value, "note", slow)]


def _memory(meminfo: Path) -> list[Finding]:
    text = meminfo.read_text() if meminfo.is_file() else ""
    total = re.search(r"MemTotal:\s*(\d+) kB", text)
    free = re.search(r"MemAvailable:\s*(\d+) kB", text)
    if total is None or free is None:
        return [Finding("memory", "RAM", "unknown", "note", "The size could not be read.")]
    # /proc/meminfo writes kB for KiB. MemAvailable includes caches that the kernel can release.
    free_gib, total_gib = int(free[1]) * 1024 / _GIB, int(total[1]) * 1024 / _GIB
    value = f"{free_gib:.1f} GiB free of {total_gib:.1f} GiB"
    if free_gib >= _MIN_MEMORY_GIB:
        return [Finding("memory", "RAM", value)]
    advice = f"Building needs {_MIN_MEMORY_GIB} GiB; close programs or use --image-scale 0.25."
    return [Finding("memory", "RAM", value, "note", advice)]


def _disk(folder: Path) -> Finding:
    free_gib = shutil.disk_usage(folder).free / _GIB
    value = f"{free_gib:.1f} GiB free"
    if free_gib >= _MIN_DISK_GIB:
        return Finding("disk", "current folder", value)
    advice = f"A work folder needs up to {_MIN_DISK_GIB} GiB; point --work to another disk."
    return Finding("disk", "current folder", value, "note", advice)


def _gpu() -> Finding:
    """Check for an NVIDIA driver and a CUDA build of torch, without loading them."""
    has_driver = ctypes.util.find_library("cuda") is not None or Path("/dev/nvidia0").exists()
    # The CPU builds of torch have the local version "+cpu".
    has_cuda_torch = "+cpu" not in (_version("torch") or "+cpu")
    if has_driver and has_cuda_torch:
        return Finding("gpu", "CUDA", "driver and a CUDA build of torch found")
    if has_driver:
        advice = "There is a driver, but torch is the CPU build: install torch with CUDA."
        return Finding("gpu", "CUDA", "driver found, torch without CUDA", "note", advice)
    advice = "All runs on the CPU; training networks is slow, building and relighting are fine."
    return Finding("gpu", "CUDA", "no NVIDIA driver", "note", advice)


def _llvm() -> Finding:
    """Check for libLLVM, which Mitsuba's fast llvm variants need; scalar variants always run."""
    found = os.environ.get("DRJIT_LIBLLVM_PATH") or ctypes.util.find_library("LLVM")
    # Distributions install libLLVM under versioned names.
    for version in _LLVM_VERSIONS:
        found = found or ctypes.util.find_library(f"LLVM-{version}")
    if found:
        return Finding("renderer", "Mitsuba", f"scalar_rgb and llvm variants ({found})")
    advice = "Only `--renderer path` and `synthesize` are slower: install libLLVM 15 or newer."
    return Finding("renderer", "Mitsuba", "scalar_rgb only (no libLLVM)", "note", advice)


def _weights(folder: Path) -> list[Finding]:
    try:
        known = list_weights(folder)
    except InputError as error:
        return [Finding("weights", "manifest", "not readable", "missing", str(error))]
    findings: list[Finding] = []
    advice = "Reinstall lightsim; the package is incomplete."
    for name, files in known.items():
        try:
            lines = {read_record(folder / file).line() for file in files}
            findings.append(Finding("weights", name, " / ".join(sorted(lines))))
        except ArtefactError as error:
            findings.append(Finding("weights", name, f"{error.where}: damaged", "missing", advice))
    return findings


def _data(data: str | None) -> Finding:
    """Check the folder of real logs, which only development needs."""
    if data is None:
        return Finding("data", "LIGHTSIM_DATA", "not set (only tests on real logs need it)")
    if Path(data).is_dir():
        return Finding("data", "LIGHTSIM_DATA", data)
    advice = "Set LIGHTSIM_DATA to the folder with pandaset/, hdri/ and cad/."
    return Finding("data", "LIGHTSIM_DATA", f"{data} is not a folder", "note", advice)
