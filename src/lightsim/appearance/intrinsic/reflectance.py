"""What is known of the base colours of a street before any picture of it.

Lit and shadowed neighbours tell the sun against all other light, and nothing tells how bright that
other light is where no camera saw the sky, except that streets are made of known materials. Ranges
of albedo are those of Oke, Boundary Layer Climates, 2nd ed. 1987, Table 8.2: asphalt 0.05 to 0.20,
concrete 0.10 to 0.35, brick 0.20 to 0.40, stone 0.20 to 0.35, red, brown and green paint 0.20 to
0.35, white paint 0.50 to 0.90, clear glass 0.08.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int64

from lightsim.appearance.intrinsic.surfels import Surfels

_NEAR_PATH_M = 1.5
"""Half the width of what a car drives over."""
_BELOW_PATH_M = (0.2, 3.5)
"""Pavement lies this far below the cameras."""
_ABOVE_PAVEMENT_M = 1.0
"""Walls are looked at from here on: below lie cars, kerbs and planters."""
_LEVEL, _UPRIGHT = 0.95, 0.15
_CLIPPED = 0.9
"""Mean radiance from which on some of the pictures were saturated."""
_LEAST, _MOST = 50, 2000
"""Fewer surfels say nothing; more are thinned."""


@dataclass(frozen=True)
class ReflectanceClass:
    """Base colours of a class of surface, log-normal.

    Args:
        name: for reports.
        median: of the luminance.
        log_std: of what the median over a street may be.
        hue_std: the same of log red and of log blue over the mean of all channels, whose own mean
            is `log_hue`; infinite where a class has no colour of its own.
        log_hue: RGB.
    """

    name: str
    median: float
    log_std: float
    hue_std: float = np.inf
    log_hue: tuple[float, float, float] = (0.0, 0.0, 0.0)


PAVEMENT = ReflectanceClass("pavement", 0.13, 0.4, 0.1, (0.04, 0.0, -0.04))
"""Asphalt, new to worn, and concrete; nearly grey, reflecting a little more towards red."""
WALLS = ReflectanceClass("walls", 0.28, 0.45)
"""Brick, stone, concrete, paint of all colours, and panes between."""


def class_members(
    surfels: Surfels, path_world: Float[np.ndarray, "p 3"]
) -> Iterator[tuple[ReflectanceClass, Int64[np.ndarray, " k"]]]:
    """Surfels of each class that has enough of them: what the ego drove over, and upright surfaces.

    Args:
        path_world: positions of the cameras along the drive.
    """
    from scipy.spatial import KDTree

    if not len(path_world) or not len(surfels):
        return
    distance, nearest = KDTree(path_world[:, :2]).query(surfels.position[:, :2])
    below_m = path_world[nearest, 2] - surfels.position[:, 2]
    upward = surfels.normal[:, 2]
    is_pavement = (upward > _LEVEL) & (distance < _NEAR_PATH_M)
    is_pavement &= (below_m > _BELOW_PATH_M[0]) & (below_m < _BELOW_PATH_M[1])
    is_usable = (surfels.confidence > 0.5) & (surfels.radiance < _CLIPPED).all(axis=1)
    pavement = np.flatnonzero(is_pavement & is_usable)
    if len(pavement) >= _LEAST:
        yield PAVEMENT, _thinned(pavement)
        height_m = np.median(below_m[pavement]) - below_m
        walls = (np.abs(upward) < _UPRIGHT) & (height_m > _ABOVE_PAVEMENT_M)
        rows = np.flatnonzero(walls & is_usable)
        if len(rows) >= _LEAST:
            yield WALLS, _thinned(rows)


def _thinned(rows: Int64[np.ndarray, " n"]) -> Int64[np.ndarray, " k"]:
    return rows[:: max(1, len(rows) // _MOST)]
