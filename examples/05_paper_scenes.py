"""The paper's three kinds of new scene on one log: a car cuts in where road works close its lane;
all traffic is gone and other vehicles drive and stand there; others drive where recorded ones did.

Run: python examples/05_paper_scenes.py [WORK] [--frames 52:76:2] [--cameras front_camera,...]
         [--cut-in ACTOR] [--assets a.glb,b.glb,c.glb]
ACTOR is who of the log cuts in (lightsim actors WORK); without one a car is put in.
"""

import argparse
import json
import sys
from pathlib import Path

import lightsim
from lightsim import BuildOptions, LogReading, SimulateOptions
from lightsim.progress import terminal_progress
from lightsim.scenario import generators
from lightsim.scenario.generators import EgoLane
from lightsim_lab.synthetic import shipped_street

SKIES = ("source", "sun:120,35")


def main(asked: argparse.Namespace) -> None:
    work, assets, progress = asked.work, asked.assets.split(","), terminal_progress()
    if not (work / "build.json").exists():
        reading = LogReading(source=str(shipped_street() / "log"), cameras=("front_camera",))
        options = BuildOptions(reading=reading, preset="draft", neural_steps=60)
        lightsim.build_twin(work, options, progress=progress)

    log = lightsim.load_twin(work).log
    lane = EgoLane.of(log)
    zone = generators.construction(lane, length_m=14.0, from_left=True, is_next_lane=True)
    scenes = {
        "closed-lane": [*generators.cut_in(lane, assets[0], 11.0, actor_id=asked.cut_in), *zone],
        # One passes a third that stands in the lane, behind cones; another has just passed it.
        "new-traffic": [
            {"do": "remove", "actor": "all-moving"},
            *generators.lane_change(lane, assets[0], gap_m=10.0),
            *generators.cut_in(lane, assets[1], gap_m=34.0),
            *generators.stalled(lane, assets[2], ahead_m=10.0),
        ],
        "replaced": generators.replaced(lane, log.actors, tuple(assets)),
    }
    options = SimulateOptions(sky=SKIES, frames=asked.frames, cameras=(*asked.cameras.split(","),))
    for name, edits in scenes.items():
        path = work / f"{name}.json"
        path.write_text(json.dumps({"version": 1, "name": name, "edits": edits}, indent=1))
        for folder in lightsim.simulate(work, path, options, progress=progress):
            sys.stdout.write(f"{name}: {folder / 'report.html'}\n")


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("work", type=Path, nargs="?", default=Path("out/example"))
    parser.add_argument("--frames", default="1:2")
    parser.add_argument("--cameras", default="front_camera")
    parser.add_argument("--cut-in", default="")
    parser.add_argument("--assets", default="car-red,van,car-black")
    main(parser.parse_args())
