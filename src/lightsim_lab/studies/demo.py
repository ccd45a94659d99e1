"""`lightsim demo`: the shipped synthetic street, built, relit and measured against its truth."""

from __future__ import annotations

import shlex
from pathlib import Path

from lightsim.build.options import BuildOptions
from lightsim.build.pipeline import build
from lightsim.core.reading import LogReading
from lightsim.progress import Progress
from lightsim.simulation.options import RelightOptions
from lightsim.simulation.relight import relight
from lightsim_lab.synthetic import shipped_street

DEMO_SKIES = ("sun:100,25", "sun:265,12")
"""A morning and an evening."""
DEMO_STEPS = 150
"""Training steps of the neural field for a first look: a quarter of a minute on two cores."""
DEMO_CAMERAS = ("front_camera", "left_camera")
"""Those whose films the page shows."""


def run_demo(out: Path, seed: int, progress: Progress, *, is_full: bool = False) -> Path:
    """Build the street under OUT/street and relight it; returns OUT/index.html.

    Args:
        is_full: train as long as the preset says, and relight all cameras; goes on with what a
            first look has made.
    """
    street = shipped_street()
    reading = LogReading(source=str(street / "log"), image_scale=1.0, hold_out=5)
    work = out / "street"
    steps = None if is_full else DEMO_STEPS
    build(work, BuildOptions(reading=reading, seed=seed, neural_steps=steps), progress)
    cameras = () if is_full else DEMO_CAMERAS
    options = RelightOptions(
        name="demo", sky=DEMO_SKIES, cameras=cameras, seed=seed, overwrite=True
    )
    folders = relight(work, options, progress)
    from lightsim.build.measures import QUICK
    from lightsim_lab.studies.against_truth import relit_frames
    from lightsim_lab.studies.report import write_demo_report

    report = relit_frames(work, street / "truth", progress, QUICK)
    return write_demo_report(out / "index.html", work, folders, report, next_steps(out))


def next_steps(out: Path) -> list[tuple[str, str]]:
    """Return what can be tried on the demo's street, and the command of each without its program.

    Two frames of one camera take 33 to 47 processor seconds, the other commands less than 10.
    """
    work, scene = (shlex.quote(str(path)) for path in (out / "street", out / "cut.json"))
    few = "--cameras front_camera --frames 4:6"
    return [
        ("what is made", f"status {work}"),
        ("who can be edited, with pictures", f"actors {work}"),
        ("another sun", f"relight {work} --sky sun:200,50 --name noon {few}"),
        (
            "a car cuts in: a file to edit",
            f"scenario cut-in {work} --out {scene} --remove-blockers",
        ),
        ("its pictures", f"simulate {work} {scene} {few}"),
    ]
