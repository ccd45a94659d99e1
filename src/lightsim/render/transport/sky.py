"""A dome ready for light-transport sums: means of environment-map cells, and the sun."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from lightsim.core.dome import SkyDome, Sun, split_sun
from lightsim.core.equirect import solid_angles_sr
from lightsim.core.resample import resize_area
from lightsim.render.transport.faces import SKY_CELL_ROWS

_REFLECTED_ROWS = 512


@dataclass(frozen=True, eq=False)
class EnvironmentCells:
    """A dome ready for the light transport matrix; make it once for all frames with `prepare_sky`.

    Args:
        radiance: mean radiance of every sky cell, the sun left out.
        sun: the sun, if the dome has one.
        smooth: the sky without its sun at its own resolution (at most 512 rows), for reflections.
        behind: what a camera sees of the sky without its sun, at its own resolution.
    """

    radiance: Float32[np.ndarray, "c 3"]
    sun: Sun | None
    smooth: Float32[np.ndarray, "h w 3"] | None = None
    behind: Float32[np.ndarray, "a b 3"] | None = None


def prepare_sky(dome: SkyDome, behind: SkyDome | None = None) -> EnvironmentCells:
    """Mean radiance of each sky cell by solid angle, and the sun; energy is kept.

    Args:
        behind: what a camera sees where it is not the dome itself; it gives no light.
    """
    rest, sun = split_sun(dome)
    rows = SKY_CELL_ROWS
    solid = np.broadcast_to(
        solid_angles_sr(dome.height_px).astype(np.float32)[..., None], (*rest.shape[:2], 1)
    )
    mean = resize_area(rest * solid, rows, 2 * rows) / resize_area(solid.copy(), rows, 2 * rows)
    smooth = rest
    if len(rest) > _REFLECTED_ROWS:
        smooth = resize_area(rest, _REFLECTED_ROWS, 2 * _REFLECTED_ROWS)
    seen = rest if behind is None else split_sun(behind)[0]
    return EnvironmentCells(mean.astype(np.float32).reshape(-1, 3), sun, smooth, seen)
