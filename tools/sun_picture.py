"""Make the moving picture of the README: one recorded frame of a log while the sun goes round.

lightsim demo --out out/demo
python tools/sun_picture.py out/demo/street --out docs/pictures/sun.webp

All suns are lit from one tracing. Relit frames are left in WORK/scenarios/sun-picture.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from PIL import Image, ImageDraw

import lightsim
from lightsim import RelightOptions
from lightsim.progress import terminal_progress

ROUND_S = 6.0
"""Duration of one round: slow enough to follow a shadow, short enough to wait for its repetition."""
QUALITY = 72
"""WebP quality at which 36 frames of 480x270 stay below 1 MB without visible blocks."""
_DIAL_PX = 22
"""Radius of the dial that shows the sun's azimuth."""
_EDGE_PX = 10
"""Distance of the dial from the corner."""


def with_dial(picture: Image.Image, azimuth_deg: float) -> Image.Image:
    """Return the picture with a dial in its upper right corner: north is up, a dot is the sun."""
    size = 4  # Drawn larger and reduced, which smooths edges.
    canvas = picture.resize((picture.width * size, picture.height * size))
    draw = ImageDraw.Draw(canvas, "RGBA")
    radius, edge = _DIAL_PX * size, _EDGE_PX * size
    left, top = canvas.width - edge - 2 * radius, edge
    box = (left, top, left + 2 * radius, top + 2 * radius)
    draw.ellipse(box, fill=(0, 0, 0, 90), outline=(255, 255, 255, 200), width=size)
    draw.pieslice(box, azimuth_deg - 95, azimuth_deg - 85, fill=(255, 214, 80, 255))
    return canvas.resize(picture.size, Image.Resampling.LANCZOS)


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
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("work", type=Path, help="work folder of a finished build")
    parser.add_argument("--camera", default="front_left_camera")
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
    pictures = [Image.open(frame).convert("RGB") for frame in frames]
    save([with_dial(p, a) for p, a in zip(pictures, azimuths, strict=True)], asked.out)


if __name__ == "__main__":
    main()
