from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from lightsim.cli import diagnosis as doctor


def test_this_machine_is_described() -> None:
    report = doctor.diagnose()
    topics = {finding.topic for finding in report.findings}
    assert topics == {
        "python", "package", "processor", "memory", "disk", "gpu", "renderer", "weights", "data"
    }  # fmt: skip
    assert report.is_ready
    table = report.to_table()
    assert "numpy" in table
    assert "is ready." in table
    weights = {f.name: f.value for f in report.findings if f.topic == "weights"}
    assert "9000 steps" in weights["sky-small"]
    for finding in report.findings:
        assert finding.state == "ok" or finding.advice


def test_it_imports_nothing_heavy() -> None:
    script = (
        "import sys\nfrom lightsim.cli.diagnosis import diagnose\ndiagnose().to_table()\n"
        "assert not {'torch', 'mitsuba', 'numba', 'pandas'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", script], check=True)


def test_what_is_missing_is_said(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(doctor, "WEIGHTS_FOLDER", tmp_path)
    monkeypatch.setattr(
        doctor.metadata, "requires", lambda _: ["no-such-package>=1", 'other; extra == "blender"']
    )
    report = doctor.diagnose()
    assert not report.is_ready
    by_name = {finding.name: finding for finding in report.findings}
    assert by_name["no-such-package"].state == "missing"
    assert "pip install" in by_name["no-such-package"].advice
    assert by_name["other"].state == "note"
    assert "lightsim[blender]" in by_name["other"].advice
    assert by_name["manifest"].state == "missing"
    assert "NOT ready" in report.to_table()


def test_small_machines_get_advice(tmp_path: Path) -> None:
    (tmp_path / "mem").write_text("MemTotal: 4000000 kB\nMemAvailable: 2000000 kB\n")
    (tmp_path / "cpu").write_text("model name : Old CPU\nflags : sse sse2 avx\n")
    memory = doctor._memory(tmp_path / "mem")[0]
    assert (memory.state, memory.value) == ("note", "1.9 GiB free of 3.8 GiB")
    instructions = doctor._processor(tmp_path / "cpu")[1]
    assert instructions.value == "avx"
    assert "AVX2" in instructions.advice
    assert doctor._memory(tmp_path / "none")[0].value == "unknown"
