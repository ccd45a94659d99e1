"""One moment of a log while the sun goes round: a video a camera, all suns from one tracing.

Run: python examples/06_sun_goes_round.py [WORK] [--frame 60] [--cameras front_camera,...]
         [--suns 4] [--elevation 30] [--method physical]
"""

import argparse
import sys
from pathlib import Path

import lightsim
from lightsim import BuildOptions, LogReading, RelightOptions
from lightsim.progress import terminal_progress
from lightsim.store.images import read_srgb8
from lightsim.store.mp4 import Mp4Writer
from lightsim_lab.synthetic import shipped_street

ROUND_S = 4.0


def main(asked: argparse.Namespace) -> None:
    work, progress = asked.work, terminal_progress()
    if not (work / "build.json").exists():
        reading = LogReading(source=str(shipped_street() / "log"), cameras=("front_camera",))
        options = BuildOptions(reading=reading, preset="draft", neural_steps=60)
        lightsim.build_twin(work, options, progress=progress)

    azimuths = [round(360 * k / asked.suns, 1) for k in range(asked.suns)]
    options = RelightOptions(
        name="sun-goes-round",
        sky=tuple(f"sun:{azimuth:g},{asked.elevation:g}" for azimuth in azimuths),
        frames=f"{asked.frame}:{asked.frame + 1}",
        cameras=tuple(asked.cameras.split(",")),
        method=asked.method,
    )
    folders = lightsim.relight(work, options, progress=progress)
    for camera in options.cameras:
        pictures = [read_srgb8(next((f / "frames" / camera).iterdir())) for f in folders]
        path = work / "scenarios" / options.name / f"{camera}.mp4"
        height, width = pictures[0].shape[:2]
        with Mp4Writer(path, width, height, asked.suns / ROUND_S) as video:
            for picture in pictures:
                video.write(picture)
        sys.stdout.write(f"{path}\n")


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("work", type=Path, nargs="?", default=Path("out/example"))
    parser.add_argument("--frame", type=int, default=1)
    parser.add_argument("--cameras", default="front_camera")
    parser.add_argument("--suns", type=int, default=4)
    parser.add_argument("--elevation", type=float, default=30.0)
    parser.add_argument("--method", default="physical")
    main(parser.parse_args())
