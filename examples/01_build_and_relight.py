"""Build a twin of the shipped synthetic street and relight it under another sun.

Run: python examples/01_build_and_relight.py [folder]
"""

import sys
from pathlib import Path

import lightsim
from lightsim import BuildOptions, LogReading, RelightOptions
from lightsim.progress import terminal_progress
from lightsim_lab.synthetic import shipped_street


def main(work: Path) -> None:
    progress = terminal_progress()
    source = str(shipped_street() / "log")
    reading = LogReading(source=source, cameras=("front_camera",), frames="0:3")
    # A field trained this briefly is for a first look; leave neural_steps out for the preset's own.
    options = BuildOptions(reading=reading, preset="draft", neural_steps=60)
    twin = lightsim.build_twin(work, options, progress=progress)
    sys.stdout.write(f"{len(twin.assets.actors)} actors, sun from {twin.sky.origin}\n")
    skies = RelightOptions(name="day", sky=("sun:120,30", "sun:240,15"))
    for folder in lightsim.relight(work, skies, progress=progress):
        sys.stdout.write(f"relit frames: {folder / 'frames'}\n")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "out/example"))
