"""`lightsim demo`: the shipped synthetic street, built, relit and measured against its truth."""

from __future__ import annotations

from pathlib import Path

from lightsim.pipeline.build import BuildOptions, build
from lightsim.progress import Progress
from lightsim.simulate.relight import relight_all
from lightsim.simulate.relighter import RelightOptions
from lightsim.simulate.skies import SkyChoice
from lightsim.store.log import LogReading
from lightsim.synthetic import shipped_street

DEMO_SKIES = {"morning": "sun:100,25", "evening": "sun:265,12"}
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
    reading = LogReading(str((street / "log").resolve()), "pandaset", (), "", None, 1.0, 5)
    work = out / "street"
    steps = None if is_full else DEMO_STEPS
    build(work, BuildOptions(reading, "standard", seed, steps), progress)
    cameras = () if is_full else DEMO_CAMERAS
    choices = [
        RelightOptions(name, SkyChoice(sky), cameras=cameras, seed=seed, is_overwriting=True)
        for name, sky in DEMO_SKIES.items()
    ]
    relight_all(work, choices, progress)
    from lightsim.pipeline.measures import QUICK
    from lightsim.simulate.against_truth import relit_frames
    from lightsim.simulate.report import write_demo_report

    report = relit_frames(work, street / "truth", progress, QUICK)
    return write_demo_report(out / "index.html", work, tuple(DEMO_SKIES), report)
