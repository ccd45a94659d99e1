"""Make the moving picture of the README: one recorded frame of a log while the sun goes round.

lightsim demo --out out/demo
python tools/sun_picture.py out/demo/street --out docs/pictures/sun.webp

All suns are lit from one tracing. Relit frames are left in WORK/scenarios/sun-picture.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from pathlib import Path

from PIL import Image, ImageDraw

import lightsim
from lightsim import RelightOptions
from lightsim.build.workspace import Workspace
from lightsim.core.log import DrivingLog
from lightsim.core.solar import azimuth_elevation
from lightsim.errors import InputError
from lightsim.progress import terminal_progress

ROUND_S = 6.0
"""Duration of one round: slow enough to follow a shadow, short enough to watch it again."""
QUALITY = 82
"""WebP quality: 36 frames of 480x270 pixels take 0.6 MB at 37 dB."""
_DIAL_PX = 22
"""Radius of the dial that shows the sun's azimuth."""
_EDGE_PX = 10
"""Distance of the dial from the corner."""


def viewing_azimuth_deg(log: DrivingLog, camera: str, stem: str) -> float:
    """Return the azimuth of a frame's viewing direction, degrees clockwise from true north.

    Raises:
        InputError: the heading of the log is unknown.
    """
    frame = next(frame for frame in log.frames_of(camera) if frame.stem == stem)
    if log.geo is None or log.geo.enu_from_world is None:
        raise InputError(
            "the heading of the log is unknown",
            where=log.name,
            remedy="Build with --heading-deg.",
        )
    forward = frame.world_from_camera.rotation[:, 2]
    return azimuth_elevation(log.geo.enu_from_world.rotate(forward[None])[0]).azimuth_deg


def with_dial(picture: Image.Image, sun_deg: float) -> Image.Image:
    """Return the picture with a dial in its upper right corner; a dot marks the sun.

    Args:
        sun_deg: azimuth of the sun, clockwise from the viewing direction, which is up.
    """
    size = 4  # The dial is drawn larger and reduced, which smooths its edges.
    side = 2 * _DIAL_PX * size
    dial = Image.new("RGBA", (side, side))
    draw = ImageDraw.Draw(dial)
    draw.ellipse((0, 0, side - 1, side - 1), (0, 0, 0, 110), (255, 255, 255, 220), size)
    angle, reach, dot = math.radians(sun_deg), 0.62 * side / 2, 0.24 * side / 2
    x, y = side / 2 + reach * math.sin(angle), side / 2 - reach * math.cos(angle)
    draw.ellipse((x - dot, y - dot, x + dot, y + dot), (255, 205, 70, 255))
    dial = dial.resize((2 * _DIAL_PX, 2 * _DIAL_PX), Image.Resampling.LANCZOS)
    shown = picture.copy()
    shown.paste(dial, (picture.width - _EDGE_PX - dial.width, _EDGE_PX), dial)
    return shown


def save(pictures: Sequence[Image.Image], path: Path) -> None:
    """Write an endless animation."""
    path.parent.mkdir(parents=True, exist_ok=True)
    pictures[0].save(
        path,
        save_all=True,
        append_images=list(pictures[1:]),
        duration=round(1000 * ROUND_S / len(pictures)),
        loop=0,
        quality=QUALITY,
        method=6,
        # Every frame is whole: some browsers show traces of earlier frames otherwise.
        kmin=1,
        kmax=1,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("work", type=Path, help="work folder of a finished build")
    parser.add_argument("--camera", default="front_camera")
    parser.add_argument("--frame", type=int, default=3, help="number of the log's frame")
    parser.add_argument("--suns", type=int, default=36, help="positions of the sun")
    parser.add_argument("--elevation", type=float, default=30.0, help="of the sun, degrees")
    parser.add_argument("--method", default="network")
    parser.add_argument("--out", type=Path, required=True, help="WebP file to write")
    asked = parser.parse_args()
    azimuths = [round(360 * number / asked.suns, 1) for number in range(asked.suns)]
    options = RelightOptions(
        name="sun-picture",
        sky=tuple(f"sun:{azimuth:g},{asked.elevation:g}" for azimuth in azimuths),
        cameras=(asked.camera,),
        frames=f"{asked.frame}:{asked.frame + 1}",
        method=asked.method,
    )
    folders = lightsim.relight(asked.work, options, progress=terminal_progress())
    frames = [next((folder / "frames" / asked.camera).iterdir()) for folder in folders]
    ahead_deg = viewing_azimuth_deg(Workspace(asked.work).log, asked.camera, frames[0].stem)
    save(
        [
            with_dial(Image.open(frame).convert("RGB"), azimuth - ahead_deg)
            for frame, azimuth in zip(frames, azimuths, strict=True)
        ],
        asked.out,
    )


if __name__ == "__main__":
    main()
