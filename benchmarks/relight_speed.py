"""What relighting costs a picture, and what several jobs save; Markdown.

    python benchmarks/relight_speed.py WORK [--cameras front_camera] [--frames 46:50] [--skies 5]
        [--image-scale 1]

Seconds a picture: processor and wall seconds of one picture under the first sky and under each
further one, without writing files; the first frame is left out, because it compiles. Commands: the
same of `lightsim relight` with 1 and 2 jobs, and whether the pictures have the same bytes. On a
machine with CUDA, where rays, light and networks use it, wall seconds count.
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
from lightsim.simulation.scene_luminance import SceneLuminance
from lightsim.simulation.skies import resolve_sky

_NAME = "relight-speed"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("work", type=Path)
    parser.add_argument("--cameras", nargs="*", default=[])
    parser.add_argument("--frames", default="")
    parser.add_argument("--skies", type=int, default=5)
    parser.add_argument("--image-scale", type=float)
    given = parser.parse_args()
    suns = np.linspace(0, 360, given.skies, endpoint=False)
    options = RelightOptions(
        name=_NAME,
        # Low and high suns in turn: the length of shadows changes the time.
        sky=tuple(f"sun:{suns[k]:.0f},{(15, 45)[k % 2]}" for k in range(given.skies)),
        cameras=tuple(given.cameras),
        frames=given.frames,
        image_scale=given.image_scale,
        overwrite=True,
    )
    first, further = seconds_a_picture(given.work, options)
    lines = [
        "| picture | processor s | wall s |",
        "|---|---:|---:|",
        f"| first sky | {first[0]:.2f} | {first[1]:.2f} |",
        f"| each further sky | {further[0]:.2f} | {further[1]:.2f} |",
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


def seconds_a_picture(work: Path, options: RelightOptions) -> tuple[np.ndarray, np.ndarray]:
    """Return (processor, wall) seconds of a picture under the first and under each further sky."""
    with opened_for(work, options) as workspace:
        scenario, seen = replayed(workspace, options), SceneLuminance(workspace)
        log = workspace.log_at(image_scale_of(workspace, options))
        relighter = Relighter(workspace, log, RelightConfig(), options, renderer=seen.renderer)
        skies = [resolve_sky(sky, workspace, seen) for sky in options.sky_by_name.values()]
        targets = [relighter.target(sky) for sky in skies]
        taken = []
        for frame in scenario.frames:
            times = [_now()]
            ready = relighter.prepare_frame(frame, scenario)
            for target in targets:
                relighter.relit_under(ready, target)
                times.append(_now())
            taken.append(np.diff(times, axis=0))
    # [skies, 2]
    means = np.mean(taken[1:], axis=0)
    return means[0], means[1:].mean(axis=0)


def _now() -> tuple[float, float]:
    return time.process_time(), time.perf_counter()


def of_command(work: Path, options: RelightOptions) -> tuple[float, float, str]:
    """Return processor and wall seconds of relighting, and a hash of its pictures."""
    before = _now()
    folders = relight(work, options, SilentProgress())
    spent, passed = np.subtract(_now(), before)
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
