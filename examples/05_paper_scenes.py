"""The paper's three kinds of new scene on one log: a car cuts in beside road works; all traffic is
gone and others stand and drive there; other vehicles drive where recorded ones drove.

Run: python examples/05_paper_scenes.py [WORK [FRAMES [CAMERAS [ACTOR]]]]
such as ... out/002 52:76:2 front_camera,front_left_camera 0d238564-0ebe-47b3-8067-593b980ce26d
where ACTOR is who of the log cuts in; without one a car is put in.
"""

import json
import sys
from pathlib import Path

import lightsim
from lightsim import BuildOptions, LogReading, SimulateOptions
from lightsim.progress import terminal_progress
from lightsim.scenario import generators
from lightsim.scenario.generators import EgoLane
from lightsim.synthetic import shipped_street

ASSETS = ("car-red", "van", "car-black")
SKIES = ("source", "sun:120,35")


def main(work: Path, frames: str = "1:2", cameras: str = "front_camera", actor: str = "") -> None:
    progress = terminal_progress()
    if not (work / "build.json").exists():
        reading = LogReading(source=str(shipped_street() / "log"), cameras=("front_camera",))
        options = BuildOptions(reading=reading, preset="draft", neural_steps=60)
        lightsim.build_twin(work, options, progress=progress)

    log = lightsim.load_twin(work).log
    lane = EgoLane.of(log)
    zone = generators.construction(lane, length_m=14.0, from_left=True, is_next_lane=True)
    scenes = {
        "cut-in": [*generators.cut_in(lane, ASSETS[0], gap_m=11.0, actor_id=actor), *zone],
        "new-traffic": [
            {"do": "remove", "actor": "all-moving"},
            *generators.hard_brake(lane, ASSETS[2], gap_m=13.0),
            *generators.lane_change(lane, ASSETS[0], gap_m=22.0),
            *generators.stalled(lane, ASSETS[1], ahead_m=14.0),
        ],
        "replaced": generators.replaced(lane, log.actors, ASSETS),
    }
    options = SimulateOptions(sky=SKIES, frames=frames, cameras=tuple(cameras.split(",")))
    for name, edits in scenes.items():
        path = work / f"{name}.json"
        path.write_text(json.dumps({"version": 1, "name": name, "edits": edits}, indent=1))
        for folder in lightsim.simulate(work, path, options, progress=progress):
            sys.stdout.write(f"{name}: {folder / 'report.html'}\n")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "out/example"), *sys.argv[2:])
