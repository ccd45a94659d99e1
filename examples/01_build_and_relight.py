"""Build a twin of the shipped synthetic street and relight it under another sun.

Run: python examples/01_build_and_relight.py [folder]
"""

import sys
from pathlib import Path

import lightsim
from lightsim.progress import terminal_progress
from lightsim.store.log import LogReading
from lightsim.synthetic import shipped_street


def main(work: Path) -> None:
    progress = terminal_progress()
    reading = LogReading(
        source=str(shipped_street() / "log"),
        dataset="auto",
        cameras=("front_camera",),
        frames="0:3",
        heading_deg=None,
        image_scale=0.5,
        hold_out=0,
    )
    # A field trained this briefly is for a first look; leave neural_steps out for the preset's own.
    twin = lightsim.build_twin(reading, work, preset="draft", neural_steps=60, progress=progress)
    sys.stdout.write(f"{len(twin.assets.actors)} actors, sun from {twin.sky.origin}\n")
    folder = lightsim.relight(work, "sun:150,30", "afternoon", progress=progress)
    sys.stdout.write(f"relit frames: {folder / 'frames'}\n")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "out/example"))
