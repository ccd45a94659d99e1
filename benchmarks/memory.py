"""Peak memory and time of a build's stages, each in a fresh process; a Markdown table.

    python benchmarks/memory.py WORK [--stages twin,assets] [--folder DIR]

WORK: a build up to the last stage that is asked for. Every stage runs again with the options of
the build, on the artefacts that lie in WORK, into DIR (by default one that is thrown away): WORK
is only read. "base" is the process before the stage begins, which its peak includes.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from lightsim.build.options import BuildOptions
from lightsim.build.pipeline import STAGES, read_options, stages_of
from lightsim.build.stages.context import Context
from lightsim.build.workspace import Workspace
from lightsim.progress import SilentProgress
from lightsim.store.artefact import peak_memory_mb

_HEAD = "| stage | base MB | peak MB | wall s | processor s |\n|---|---:|---:|---:|---:|"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("work", type=Path)
    parser.add_argument("--stages", default=",".join(stage.name for stage in STAGES))
    parser.add_argument("--folder", type=Path)
    parser.add_argument("--measure", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.measure is not None:
        sys.stdout.write(json.dumps(_measure(options.work, options.measure, options.folder)))
        return
    sys.stdout.write(_HEAD + "\n")
    for name in options.stages.split(","):
        with tempfile.TemporaryDirectory() as thrown_away:
            folder = options.folder / name if options.folder else Path(thrown_away)
            folder.mkdir(parents=True, exist_ok=True)
            row = _in_fresh_process(options.work, name, folder)
        cells = " | ".join(f"{row[key]:.0f}" for key in ("base", "peak", "wall", "processor"))
        sys.stdout.write(f"| {name} | {cells} |\n")
        sys.stdout.flush()


def _in_fresh_process(work: Path, name: str, folder: Path) -> dict[str, float]:
    command = [sys.executable, __file__, str(work), "--measure", name, "--folder", str(folder)]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(done.stdout)


def _measure(work: Path, name: str, folder: Path) -> dict[str, float]:
    """Run one stage in this process."""
    build: BuildOptions = read_options(work)
    stage = next(stage for stage in stages_of(build) if stage.name == name)
    context = Context(SilentProgress(), build.seed, build.preset, build.device)
    base, wall, processor = peak_memory_mb(), time.monotonic(), time.process_time()
    tuple(stage.make(Workspace(work, build.reading), stage.config(build), folder, context))
    return {
        "base": base,
        "peak": peak_memory_mb(),
        "wall": time.monotonic() - wall,
        "processor": time.process_time() - processor,
    }


if __name__ == "__main__":
    main()
