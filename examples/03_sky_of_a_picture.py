"""The HDR sky of a picture that shows a part of it, and the same sky under another sun.

python examples/03_sky_of_a_picture.py [FOLDER]
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from lightsim.core.colour import srgb8_from_linear
from lightsim.core.equirect import pixel_directions
from lightsim.core.sky_choice import SkyChoice
from lightsim.lighting.sky.estimate import SkyConfig
from lightsim.lighting.sky.image_sky import (
    edited_sky,
    estimate_from_picture,
    panorama_from_image,
)
from lightsim.lighting.sky.predict import predict_sky
from lightsim.simulation.skies import sky_without_log
from lightsim.store.sky import write_sky


def main() -> None:
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path("out/sky")

    # Instead of a photograph: a clear sky, exposed for its blue, of which cameras observed only
    # the lower 35 degrees.
    dome = sky_without_log(SkyChoice("sun:40,30")).dome
    level = np.median(dome.radiance[:128])
    picture = srgb8_from_linear(np.clip(0.3 * dome.radiance / level, 0.0, 1.0))
    is_seen = pixel_directions(256)[..., 2] < np.sin(np.radians(35.0))

    panorama = panorama_from_image(picture, is_seen)
    prediction = predict_sky(panorama)
    estimate = estimate_from_picture(panorama, None, SkyConfig(), prediction)
    sys.stdout.write(f"{estimate.notes[0]}\n")

    moved = edited_sky(estimate, (200.0, 50.0), 1.0, None)
    for name, sky in (("estimate", estimate), ("moved", moved)):
        (folder / name).mkdir(parents=True, exist_ok=True)
        write_sky(folder / name, sky, None, "sky.exr")
    brightest = edited_sky(estimate, None, 2.0, None).dome.radiance.max()
    sys.stdout.write(f"with its sun twice as strong its brightest pixel is {brightest:.0f}\n")


if __name__ == "__main__":
    main()
