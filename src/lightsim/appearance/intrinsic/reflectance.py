"""Prior of the base colours of streets, by class of surface.

Lit and shadowed neighbours determine the ratio of the sun to all other light. Where no camera
observes the sky, only the known base colours of street materials determine the level of that other
light. Albedo ranges are from Oke, Boundary Layer Climates, 2nd ed. 1987, Table 8.2:
asphalt 0.05 to 0.20, concrete 0.10 to 0.35, brick 0.20 to 0.40, stone 0.20 to 0.35, red, brown and
green paint 0.20 to 0.35, white paint 0.50 to 0.90, clear glass 0.08.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64, Int64

from lightsim.appearance.intrinsic.surfels import Surfels

# The values below were chosen by inspection; their sensitivity was not measured.

# Maximum distance from the path, in metres, of the pavement that the ego vehicle drives over.
_NEAR_PATH_M = 1.5
# Range of the height of the cameras above pavement, in metres.
_BELOW_PATH_M = (0.2, 3.5)
# Height above pavement, in metres, from which upright surfaces are walls: cars, kerbs and planters
# are lower.
_ABOVE_PAVEMENT_M = 1.0
# Least z component of the unit normal of pavement.
_MIN_PAVEMENT_NORMAL_Z = 0.95
# Greatest absolute z component of the unit normal of a wall.
_MAX_WALL_NORMAL_Z = 0.15
# Density of base colours outside the mixture: limits the evidence of a single patch.
_MIN_DENSITY = 0.02
# Mean radiance above which some of the averaged pixels are assumed to be saturated.
_CLIPPED = 0.9
# Least number of surfels of a class.
_MIN_SURFELS = 50
# Number of surfels from which a class is thinned, to save time.
_MAX_SURFELS = 2000


@dataclass(frozen=True)
class MaterialVariation:
    """Normal variation of log base colour between two patches of one material.

    Args:
        log_std: standard deviation of the mean over the channels.
        hue_std: standard deviation of each channel's difference from that mean.
    """

    log_std: float
    hue_std: float

    def misfit(self, step: Float[np.ndarray, "e 3"]) -> Float[np.ndarray, " e"]:
        """Return the negative log likelihood of steps of log base colour, up to a constant."""
        mean = step.mean(axis=1)
        hue = ((step - mean[:, None]) ** 2).sum(axis=1)
        return 0.5 * (mean / self.log_std) ** 2 + 0.5 * hue / self.hue_std**2


@dataclass(frozen=True)
class ReflectanceClass:
    """Log-normal prior of the base colours of a class of surface.

    Args:
        median: median luminance over a street.
        log_std: standard deviation of the log of that median between streets.
        hue_std: standard deviation between streets of each log channel, relative to the mean of the
            channels; infinite for a class without a typical hue.
        log_hue: mean log channels, RGB, relative to their mean.
        mixture: (weight, median, log standard deviation) of the luminance of each material that
            single patches consist of.
    """

    median: float
    log_std: float
    hue_std: float = np.inf
    log_hue: tuple[float, float, float] = (0.0, 0.0, 0.0)
    mixture: tuple[tuple[float, float, float], ...] = ()

    def log_density(self, luminance: Float[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
        """Return the log density of the luminance of single patches, up to a constant."""
        log_luminance = np.log(np.maximum(luminance.astype(np.float64), 1e-9))
        density = np.full(log_luminance.shape, _MIN_DENSITY)
        for weight, median, log_std in self.mixture:
            z_score = (log_luminance - np.log(median)) / log_std
            density += weight * np.exp(-0.5 * z_score**2) / log_std
        return np.log(density)


# New to worn asphalt and concrete, nearly grey and slightly red (90 %), and lane marks (10 %).
PAVEMENT = ReflectanceClass(0.13, 0.4, 0.1, (0.04, 0.0, -0.04), ((0.9, 0.13, 0.5), (0.1, 0.5, 0.4)))
# Brick, stone, concrete and paint of any colour (75 %), white paint (10 %), panes (15 %).
WALLS = ReflectanceClass(
    0.28, 0.45, mixture=((0.75, 0.27, 0.5), (0.1, 0.7, 0.25), (0.15, 0.06, 0.6))
)


@dataclass(frozen=True, eq=False)
class Members:
    """Surfels `rows` of one class `kind`."""

    kind: ReflectanceClass
    rows: Int64[np.ndarray, " k"]


def class_members(surfels: Surfels, path_world: Float[np.ndarray, "p 3"]) -> Iterator[Members]:
    """Yield the pavement under the driven path, and the walls, if they have enough surfels.

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
    if len(pavement) >= _MIN_SURFELS:
        yield Members(PAVEMENT, _thinned(pavement))
        height_m = np.median(below_m[pavement]) - below_m
        walls = (np.abs(upward) < _MAX_WALL_NORMAL_Z) & (height_m > _ABOVE_PAVEMENT_M)
        rows = np.flatnonzero(walls & is_usable)
        if len(rows) >= _MIN_SURFELS:
            yield Members(WALLS, _thinned(rows))


def materials_of(surfels: Surfels, path_world: Float[np.ndarray, "p 3"]) -> tuple[Members, ...]:
    """Return all observed surfels of each class: level ones at the road's height, and upright ones.

    Args:
        path_world: positions of the cameras along the drive.
    """
    if not len(path_world) or not len(surfels):
        return ()
    is_seen = surfels.confidence > 0.5
    is_low = _is_pavement(surfels, _from_path(surfels, path_world)[1])
    is_upright = np.abs(surfels.normal[:, 2]) < _MAX_WALL_NORMAL_Z
    return (
        Members(PAVEMENT, np.flatnonzero(is_seen & is_low)),
        Members(WALLS, np.flatnonzero(is_seen & is_upright)),
    )


def _from_path(
    surfels: Surfels, path_world: Float[np.ndarray, "p 3"]
) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
    """Horizontal distance of each surfel from the path, and its depth below the path, in metres."""
    from scipy.spatial import KDTree

    distance, nearest = KDTree(path_world[:, :2]).query(surfels.position[:, :2])
    return distance, path_world[nearest, 2] - surfels.position[:, 2]


def _is_pavement(surfels: Surfels, below_m: Float64[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    is_low = (below_m > _BELOW_PATH_M[0]) & (below_m < _BELOW_PATH_M[1])
    return is_low & (surfels.normal[:, 2] > _MIN_PAVEMENT_NORMAL_Z)


def _thinned(rows: Int64[np.ndarray, " n"]) -> Int64[np.ndarray, " k"]:
    return rows[:: max(1, len(rows) // _MAX_SURFELS)]
