"""Table of finishes (materials) of one street."""

from __future__ import annotations

import numpy as np

from lightsim_lab.synthetic.textures import (
    Finish,
    Line,
    brick,
    constant,
    glass,
    paint,
    plaster,
    road,
    slabs,
    speckled,
)

# Linear RGB albedos, chosen by eye within the range of real materials.
_PLASTERS = ((0.74, 0.72, 0.67), (0.70, 0.60, 0.40), (0.62, 0.42, 0.33), (0.52, 0.58, 0.60))
# See _PLASTERS.
_BRICKS = ((0.36, 0.15, 0.10), (0.44, 0.30, 0.18))
# Linear RGB base colours of car paints: white, black, grey, red, blue, dark grey and green.
_PAINTS = (
    (0.72, 0.72, 0.71),
    (0.035, 0.037, 0.04),
    (0.40, 0.41, 0.42),
    (0.42, 0.035, 0.03),
    (0.05, 0.11, 0.32),
    (0.16, 0.17, 0.18),
    (0.10, 0.22, 0.16),
)
# Linear RGB albedos of clothes.
_CLOTHS = ((0.10, 0.14, 0.28), (0.45, 0.10, 0.08), (0.06, 0.06, 0.07), (0.55, 0.50, 0.36))

# Number of finishes `wall0`, `wall1` and so on: plasters, bricks and one of stone slabs.
WALL_COUNT = len(_PLASTERS) + len(_BRICKS) + 1
# Number of finishes `glass0` and so on; the first has no lit room behind it.
GLASS_COUNT = 3
PAINT_COUNT = len(_PAINTS)
CLOTH_COUNT = len(_CLOTHS)


def make_finishes(
    rng: np.random.Generator, road_length_m: float, road_width_m: float, lane_m: float
) -> dict[str, Finish]:
    """Return all finishes of a street by name."""
    # The order of this table is that of the random draws: reordering it changes every street.
    finishes: dict[str, Finish] = {
        "road": _road(rng, (road_length_m, road_width_m), lane_m),
        "sidewalk": slabs(rng, (0.36, 0.35, 0.33)),
        "kerb": speckled(rng, (0.40, 0.39, 0.38), 0.18),
        "earth": speckled(rng, (0.27, 0.25, 0.20), 0.25, 12.0, 0.95),
        "slab": speckled(rng, (0.45, 0.44, 0.42), 0.1),
        "roof": speckled(rng, (0.20, 0.19, 0.18), 0.2, 6.0, 0.9),
        "door": speckled(rng, (0.22, 0.11, 0.06), 0.2, 2.0, 0.5),
        "bark": speckled(rng, (0.16, 0.12, 0.09), 0.35, 1.0, 0.95),
        "leaf": speckled(rng, (0.085, 0.16, 0.035), 0.35, 3.0, 0.6),
        "steel": _metal(rng, (0.42, 0.43, 0.44), 0.4),
        "bin": speckled(rng, (0.08, 0.16, 0.10), 0.12, 2.0, 0.45),
        "rubber": speckled(rng, (0.035, 0.035, 0.036), 0.15, 1.0, 0.7),
        "skin": speckled(rng, (0.48, 0.30, 0.22), 0.06, 1.0, 0.6),
        "lamp": _gloss(rng, (0.70, 0.71, 0.72)),
        "tail": _gloss(rng, (0.42, 0.02, 0.02)),
        "plate": speckled(rng, (0.75, 0.75, 0.72), 0.08, 1.0, 0.5),
        "car_glass": _gloss(rng, (0.03, 0.034, 0.036), 0.06, 0.1),
        "sign0": speckled(rng, (0.55, 0.04, 0.04), 0.06, 2.0, 0.35),
        "sign1": speckled(rng, (0.04, 0.14, 0.46), 0.06, 2.0, 0.35),
        "sign2": speckled(rng, (0.75, 0.62, 0.08), 0.06, 2.0, 0.35),
    }
    for i, rgb in enumerate(_PLASTERS):
        finishes[f"wall{i}"] = plaster(rng, _varied(rng, rgb))
    for i, rgb in enumerate(_BRICKS):
        finishes[f"wall{len(_PLASTERS) + i}"] = brick(rng, _varied(rng, rgb))
    finishes[f"wall{WALL_COUNT - 1}"] = slabs(rng, _varied(rng, (0.55, 0.51, 0.44)), 32)
    for i, rgb in enumerate(((0.78, 0.77, 0.74), (0.36, 0.30, 0.24), (0.60, 0.58, 0.52))):
        finishes[f"trim{i}"] = speckled(rng, rgb, 0.08, 3.0, 0.6)
    for i in range(GLASS_COUNT):
        finishes[f"glass{i}"] = glass(rng, i > 0)
    for i, rgb in enumerate(_PAINTS):
        finishes[f"paint{i}"] = paint(rng, rgb)
    for i, rgb in enumerate(_CLOTHS):
        finishes[f"cloth{i}"] = speckled(rng, rgb, 0.15, 1.0, 0.95)
    return finishes


def _road(rng: np.random.Generator, size_m: tuple[float, float], lane_m: float) -> Finish:
    """Return a road of two lanes with a broken centre line (3 m of every 7 m) and edge lines."""
    tracks = (-lane_m / 2 - 0.8, -lane_m / 2 + 0.8, lane_m / 2 - 0.8, lane_m / 2 + 0.8)
    edges = [Line(across_m, 0.06, 6.5, 5.8) for across_m in (-lane_m, lane_m)]
    return road(rng, size_m, tracks, [Line(0.0, 0.07, 7.0, 3.0), *edges])


def _varied(
    rng: np.random.Generator, rgb: tuple[float, float, float]
) -> tuple[float, float, float]:
    r, g, b = (np.asarray(rgb) * np.exp(rng.normal(0, 0.1, 3))).tolist()
    return (r, g, b)


def _metal(rng: np.random.Generator, rgb: tuple[float, float, float], roughness: float) -> Finish:
    base = speckled(rng, rgb, 0.1, 2.0, roughness)
    return Finish(base.base_colour, base.extent_m, base.roughness, 0.5, 0.6)


def _gloss(
    rng: np.random.Generator,
    rgb: tuple[float, float, float],
    amount: float = 0.05,
    lidar_gain: float = 0.6,
) -> Finish:
    base = speckled(rng, rgb, amount, 2.0)
    return Finish(
        base.base_colour, base.extent_m, constant(0.12), specular=0.7, lidar_gain=lidar_gain
    )
