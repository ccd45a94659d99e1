"""How well the unseen sky follows from the two strips that a street shows, on real skies.

    python benchmarks/bench_sky_completion.py HDRI_DIR [--split benchmarks/hdri_split.csv]

Training skies that show nothing but sky are seen between 7 and 32 degrees of elevation, 35 degrees
to both sides of a street's two ends; their level light without the sun is compared with that of the
completed dome, in stops, for three headings of the street.
"""

from __future__ import annotations

import argparse
import csv
import sys
from pathlib import Path

import numpy as np

from lightsim.core.dome import SkyDome, find_sun, irradiance, resized, split_sun
from lightsim.core.equirect import pixel_directions
from lightsim.core.twin import Panorama
from lightsim.lighting.sky.blend import blend_observed
from lightsim.lighting.sky.estimate import SkyConfig, fit_analytic_sky
from lightsim.store.images import read_hdr

_ROWS, _HEADINGS = 128, 3
_UP = np.array([0.0, 0.0, 1.0])


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--split", type=Path, default=Path(__file__).parent / "hdri_split.csv")
    options = parser.parse_args()
    with options.split.open() as file:
        rows = [r for r in csv.DictReader(file) if r["split"] == "train" and r["scene"] == "none"]
    errors = []
    sys.stdout.write("| sky | " + " | ".join(["stops"] * _HEADINGS) + " |\n|---|---:|---:|---:|\n")
    for row in rows:
        found = _errors(read_hdr(options.folder / f"{row['name']}.hdr").astype(np.float32))
        errors += found
        cells = " | ".join(f"{value:+.2f}" for value in found)
        sys.stdout.write(f"| {row['name']} | {cells} |\n")
    sys.stdout.write(f"mean {np.mean(errors):+.2f}, standard deviation {np.std(errors):.2f}\n")


def _errors(image: np.ndarray) -> list[float]:
    """Completed over true level light of the sky alone, stops."""
    sky, sun = split_sun(SkyDome(image, find_sun(image)))
    sky = resized(SkyDome(sky, None), _ROWS).radiance.copy()
    sky[_ROWS // 2 :] = 0.0
    directions = pixel_directions(_ROWS)
    brightest = directions.reshape(-1, 3)[sky.mean(axis=-1).argmax()]
    direction = brightest if sun is None else sun.direction_world
    elevation = np.degrees(np.arcsin(directions[..., 2]))
    azimuth = np.degrees(np.arctan2(directions[..., 1], directions[..., 0]))
    # As bright as a street's sky is exposed.
    sky *= 0.4 / np.median(sky[(elevation > 5) & (elevation < 40)])
    errors = []
    for heading in np.random.default_rng(1).uniform(0, 360, _HEADINGS):
        off_axis = np.abs((azimuth - heading + 90) % 180 - 90)
        is_seen = (elevation > 7) & (elevation < 32) & (off_axis < 35)
        is_clipped = is_seen & (sky.max(axis=-1) > 1)
        seen = np.where(is_seen[..., None], np.minimum(sky, 1.0), 0.0).astype(np.float32)
        panorama = Panorama(seen, is_seen, is_seen, is_clipped)
        fit = fit_analytic_sky(panorama, direction, SkyConfig(height_px=_ROWS))
        levels = [
            irradiance(dome, _UP)[1] for dome in (blend_observed(panorama, fit.radiance), sky)
        ]
        errors.append(float(np.log2(levels[0] / levels[1])))
    return errors


if __name__ == "__main__":
    main()
