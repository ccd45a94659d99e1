"""Take the traffic out of a street, let a car cut in beside road works, and change the sky.

Run: python examples/04_simulate.py [folder]
"""

import json
import sys
from pathlib import Path

import lightsim
from lightsim import BuildOptions, LogReading, SimulateOptions
from lightsim.progress import terminal_progress
from lightsim.scenario.generators import EgoLane, construction, cut_in
from lightsim_lab.synthetic import shipped_street


def main(work: Path) -> None:
    progress = terminal_progress()
    source = str(shipped_street() / "log")
    reading = LogReading(source=source, cameras=("front_camera",), frames="0:3")
    # A field trained this briefly is for a first look; leave neural_steps out for the preset's own.
    options = BuildOptions(reading=reading, preset="draft", neural_steps=60)
    twin = lightsim.build_twin(work, options, progress=progress)

    lane = EgoLane.of(twin.log)
    edits = [
        {"do": "remove", "actor": "all-moving"},
        *cut_in(lane, "car-red", gap_m=11.0),
        *construction(lane, ahead_m=6.0),
    ]
    scenario = work / "cut_in.json"
    scenario.write_text(json.dumps({"version": 1, "name": "cut-in", "edits": edits}, indent=1))

    wanted = SimulateOptions(sky=("source", "sun:240,15"), frames="1:2", labels=True)
    for folder in lightsim.simulate(work, scenario, wanted, progress=progress):
        sys.stdout.write(f"frames: {folder / 'frames'}, labels: {folder / 'labels'}\n")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "out/example"))
