"""The README's picture: one recorded moment of the shipped street, and the same under other skies.

lightsim build src/lightsim/data/street/log --work WORK --hold-out 5
python tools/front_picture.py WORK --out docs/pictures/skies.jpg
"""

from __future__ import annotations

import argparse
from pathlib import Path

from PIL import Image, ImageDraw

import lightsim
from lightsim import RelightOptions
from lightsim.progress import terminal_progress
from lightsim_lab.synthetic import shipped_street

SKIES = {
    "source": "recorded",
    "sun:110,25": "morning sun",
    "sun:180,60": "noon",
    "sun:250,12": "evening sun",
    "sun:300,30": "sun from the other side",
    str(shipped_street() / "truth" / "skies" / "overcast.exr"): "overcast",
}
COLUMNS = 3


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("work", type=Path)
    parser.add_argument("--camera", default="front_left_camera")
    parser.add_argument("--frame", type=int, default=3)
    parser.add_argument("--method", default="network")
    parser.add_argument("--out", type=Path, required=True)
    asked = parser.parse_args()
    options = RelightOptions(
        name="front-picture",
        sky=tuple(SKIES),
        cameras=(asked.camera,),
        frames=f"{asked.frame}:{asked.frame + 1}",
        method=asked.method,
        overwrite=True,
    )
    folders = lightsim.relight(asked.work, options, progress=terminal_progress())
    tiles = [
        Image.open(next((folder / "frames" / asked.camera).iterdir())).convert("RGB")
        for folder in folders
    ]
    width, height = tiles[0].size
    rows = -(-len(tiles) // COLUMNS)
    sheet = Image.new("RGB", (COLUMNS * width, rows * height))
    draw = ImageDraw.Draw(sheet)
    for number, (tile, words) in enumerate(zip(tiles, SKIES.values(), strict=True)):
        left, top = number % COLUMNS * width, number // COLUMNS * height
        sheet.paste(tile, (left, top))
        draw.text((left + 10, top + 8), words, fill="white", stroke_width=2, stroke_fill="black")
    asked.out.parent.mkdir(parents=True, exist_ok=True)
    sheet.save(asked.out, quality=88)


if __name__ == "__main__":
    main()
