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
from jaxtyping import Bool, Float, Float64, Int64

from lightsim.appearance.intrinsic.surfels import Surfels

# Half the width of what a car drives over.
_NEAR_PATH_M = 1.5
# Pavement lies this far below the cameras.
_BELOW_PATH_M = (0.2, 3.5)
# Walls are looked at from here on: below lie cars, kerbs and planters.
_ABOVE_PAVEMENT_M = 1.0
_LEVEL, _UPRIGHT = 0.95, 0.15
# What no material has; keeps a single patch from being sure.
_LEAST_DENSITY = 0.02
# Mean radiance from which on some of the pictures were saturated.
_CLIPPED = 0.9
# Fewer surfels say nothing; more are thinned.
_LEAST, _MOST = 50, 2000


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
        mixture: share, median and log spread of the materials that single patches consist of.
    """

    name: str
    median: float
    log_std: float
    hue_std: float = np.inf
    log_hue: tuple[float, float, float] = (0.0, 0.0, 0.0)
    mixture: tuple[tuple[float, float, float], ...] = ()

    def log_density(self, luminance: Float[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
        """Natural log of how probable base colours are for single patches, up to a constant."""
        log_luminance = np.log(np.maximum(luminance.astype(np.float64), 1e-9))
        density = np.full(log_luminance.shape, _LEAST_DENSITY)
        for share, median, log_std in self.mixture:
            z_score = (log_luminance - np.log(median)) / log_std
            density += share * np.exp(-0.5 * z_score**2) / log_std
        return np.log(density)


# Asphalt, new to worn, and concrete, nearly grey, reflecting a little more towards red; marks.
PAVEMENT = ReflectanceClass(
    "pavement", 0.13, 0.4, 0.1, (0.04, 0.0, -0.04), ((0.9, 0.13, 0.5), (0.1, 0.5, 0.4))
)
# Brick, stone, concrete and paint of all colours; white paint; panes between.
WALLS = ReflectanceClass(
    "walls", 0.28, 0.45, mixture=((0.75, 0.27, 0.5), (0.1, 0.7, 0.25), (0.15, 0.06, 0.6))
)


@dataclass(frozen=True, eq=False)
class Members:
    """Surfels of one class."""

    kind: ReflectanceClass
    rows: Int64[np.ndarray, " k"]


def class_members(surfels: Surfels, path_world: Float[np.ndarray, "p 3"]) -> Iterator[Members]:
    """Surfels of each class that has enough of them: what the ego drove over, and upright surfaces.

    Args:
        path_world: positions of the cameras along the drive.
    """
    if not len(path_world) or not len(surfels):
        return
    distance, below_m = _from_path(surfels, path_world)
    upward = surfels.normal[:, 2]
    is_usable = (surfels.confidence > 0.5) & (surfels.radiance < _CLIPPED).all(axis=1)
    is_driven = _is_pavement(surfels, below_m) & (distance < _NEAR_PATH_M)
    pavement = np.flatnonzero(is_driven & is_usable)
    if len(pavement) >= _LEAST:
        yield Members(PAVEMENT, _thinned(pavement))
        height_m = np.median(below_m[pavement]) - below_m
        walls = (np.abs(upward) < _UPRIGHT) & (height_m > _ABOVE_PAVEMENT_M)
        rows = np.flatnonzero(walls & is_usable)
        if len(rows) >= _LEAST:
            yield Members(WALLS, _thinned(rows))


def materials_of(surfels: Surfels, path_world: Float[np.ndarray, "p 3"]) -> tuple[Members, ...]:
    """Surfels of each class, wherever cameras saw them: level ones as low as what the sensors moved
    over, and upright ones.

    Args:
        path_world: positions of any sensors of the ego along the drive.
    """
    if not len(path_world) or not len(surfels):
        return ()
    is_seen = surfels.confidence > 0.5
    is_low = _is_pavement(surfels, _from_path(surfels, path_world)[1])
    is_upright = np.abs(surfels.normal[:, 2]) < _UPRIGHT
    return (
        Members(PAVEMENT, np.flatnonzero(is_seen & is_low)),
        Members(WALLS, np.flatnonzero(is_seen & is_upright)),
    )


def _from_path(
    surfels: Surfels, path_world: Float[np.ndarray, "p 3"]
) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
    """Distance in plan from the nearest place of the path, and how far below it."""
    from scipy.spatial import KDTree

    path = _distinct_places(path_world)
    distance, nearest = KDTree(path[:, :2]).query(surfels.position[:, :2])
    return distance, path[nearest, 2] - surfels.position[:, 2]


def _distinct_places(path_world: Float[np.ndarray, "p 3"]) -> Float64[np.ndarray, "q 3"]:
    """Each decimetre of space once: there is one place for every return of the log."""
    cells = np.round(path_world.astype(np.float64) * 10).astype(np.int64)
    low = cells.min(axis=0)
    size = cells.max(axis=0) - low + 1
    keys = np.ravel_multi_index(tuple((cells - low).T), tuple(size))
    return cells[np.unique(keys, return_index=True)[1]] / 10


def _is_pavement(surfels: Surfels, below_m: Float64[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    is_low = (below_m > _BELOW_PATH_M[0]) & (below_m < _BELOW_PATH_M[1])
    return is_low & (surfels.normal[:, 2] > _LEVEL)


def _thinned(rows: Int64[np.ndarray, " n"]) -> Int64[np.ndarray, " k"]:
    return rows[:: max(1, len(rows) // _MOST)]
