"""What relighting costs a picture, and what several jobs save; Markdown.

    python benchmarks/relight_speed.py WORK [--cameras front_camera] [--frames 46:50] [--skies 5]

Seconds a picture: processor seconds of one picture under the first sky and under each further one,
without writing files; the first frame is left out, because it compiles. Commands: processor and
wall seconds of `lightsim relight` with 1 and 2 jobs, and whether the pictures have the same bytes.
"""

from __future__ import annotations

import argparse
import hashlib
import shutil
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from lightsim.progress import SilentProgress
from lightsim.simulation.claims import image_scale_of, opened_for
from lightsim.simulation.options import RelightOptions
from lightsim.simulation.relight import relight, replayed
from lightsim.simulation.relighter import RelightConfig, Relighter
from lightsim.simulation.seen_light import SeenLight
from lightsim.simulation.skies import resolve_sky

_NAME = "relight-speed"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("work", type=Path)
    parser.add_argument("--cameras", nargs="*", default=[])
    parser.add_argument("--frames", default="")
    parser.add_argument("--skies", type=int, default=5)
    given = parser.parse_args()
    suns = np.linspace(0, 360, given.skies, endpoint=False)
    options = RelightOptions(
        name=_NAME,
        # Low and high suns in turn: the length of shadows changes the time.
        sky=tuple(f"sun:{suns[k]:.0f},{(15, 45)[k % 2]}" for k in range(given.skies)),
        cameras=tuple(given.cameras),
        frames=given.frames,
        overwrite=True,
    )
    first, further = seconds_a_picture(given.work, options)
    lines = [
        "| picture | processor s |",
        "|---|---:|",
        f"| first sky | {first:.2f} |",
        f"| each further sky | {further:.2f} |",
        "",
        "| jobs | processor s | wall s | bytes |",
        "|---:|---:|---:|---|",
    ]
    reference = ""
    for jobs in (1, 2):
        spent, passed, digest = of_command(given.work, replace(options, jobs=jobs))
        reference = reference or digest
        same = "equal" if digest == reference else "different"
        lines.append(f"| {jobs} | {spent:.1f} | {passed:.1f} | {same} |")
    sys.stdout.write("\n".join(lines) + "\n")


def seconds_a_picture(work: Path, options: RelightOptions) -> tuple[float, float]:
    """Return processor seconds of a picture under the first and under each further sky."""
    with opened_for(work, options) as workspace:
        scenario, seen = replayed(workspace, options), SeenLight(workspace)
        log = workspace.log_at(image_scale_of(workspace, options))
        relighter = Relighter(workspace, log, RelightConfig(), options, renderer=seen.renderer)
        skies = [resolve_sky(sky, workspace, seen) for sky in options.sky_by_name.values()]
        targets = [relighter.target(sky) for sky in skies]
        taken = []
        for frame in scenario.frames:
            times = [time.process_time()]
            ready = relighter.ready(frame, scenario)
            for target in targets:
                relighter.under(ready, target)
                times.append(time.process_time())
            taken.append(np.diff(times))
    means = np.mean(taken[1:], axis=0)
    return float(means[0]), float(means[1:].mean())


def of_command(work: Path, options: RelightOptions) -> tuple[float, float, str]:
    """Return processor and wall seconds of relighting, and a hash of its pictures."""
    before = time.process_time(), time.perf_counter()
    folders = relight(work, options, SilentProgress())
    spent, passed = time.process_time() - before[0], time.perf_counter() - before[1]
    digest = _digest(folders)
    shutil.rmtree(work / "scenarios" / options.name)
    return spent, passed, digest


def _digest(folders: Sequence[Path]) -> str:
    pictures = sorted(path for folder in folders for path in folder.glob("frames/*/*.png"))
    found = hashlib.blake2b()
    for path in pictures:
        found.update(path.read_bytes())
    return found.hexdigest()


if __name__ == "__main__":
    main()
