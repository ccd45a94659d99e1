"""`lightsim demo`: the shipped synthetic street, built, relit and measured against its truth."""

from __future__ import annotations

import shlex
from dataclasses import replace
from pathlib import Path

from lightsim.build.options import BuildOptions
from lightsim.build.pipeline import build
from lightsim.build.workspace import Workspace
from lightsim.core.reading import LogReading
from lightsim.progress import Progress
from lightsim.simulation.options import RelightOptions
from lightsim_lab.synthetic import shipped_street

# Settings of the short demo, chosen for a duration of about four minutes on two cores.

# Cameras of the build: those that face ahead. All six took 45 s more in one run each, and gained
# 0.1 to 0.6 dB.
DEMO_LOG_CAMERAS = ("front_camera", "front_left_camera", "front_right_camera")
# Frames: every second one, including the two whose truth is shipped.
DEMO_FRAMES = "1:10:2"
# Training steps of the neural field; the preset has more.
DEMO_STEPS = 60
# Cameras that are relit.
DEMO_CAMERAS = ("front_camera",)


def run_demo(out: Path, seed: int, progress: Progress, *, is_full: bool = False) -> Path:
    """Build the shipped street under OUT/street, relight it under the skies whose truth is shipped,
    score the frames that have a true picture, and return OUT/index.html.

    Args:
        is_full: use all cameras and frames, train as long as the preset does, and relight all
            cameras.
    """
    street = shipped_street()
    reading = LogReading(source=str(street / "log"), image_scale=1.0)
    if not is_full:
        reading = replace(reading, cameras=DEMO_LOG_CAMERAS, frames=DEMO_FRAMES)
    work = out / "street"
    steps = None if is_full else DEMO_STEPS
    build(work, BuildOptions(reading=reading, seed=seed, neural_steps=steps), progress)
    from lightsim.build.measures import QUICK
    from lightsim_lab.studies.against_truth import relit_folders, score_relit_folders
    from lightsim_lab.studies.report import write_demo_report

    cameras = () if is_full else DEMO_CAMERAS
    options = RelightOptions(name="demo", cameras=cameras, seed=seed)
    workspace, truth = Workspace(work), street / "truth"
    folders = relit_folders(workspace, truth, options, progress, with_all_frames=True)
    scores = score_relit_folders(workspace, truth, folders, progress, QUICK)
    return write_demo_report(out / "index.html", workspace, folders, scores, next_steps(out))


def next_steps(out: Path) -> list[tuple[str, str]]:
    """Return further commands for the demo's street: their purpose, and their arguments.

    The range 4:6 is one frame of the short demo, which reads every second frame, and two frames of
    the full demo, which take 33 to 47 processor seconds. The other commands take less than 10.
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
