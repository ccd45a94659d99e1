"""Sky dome prepared for the light transport matrix: means of environment cells, and the sun."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from lightsim.core.dome import SkyDome, Sun, split_sun
from lightsim.core.equirect import solid_angles_sr
from lightsim.core.resample import resize_area
from lightsim.render.transport.faces import SKY_CELL_ROWS


@dataclass(frozen=True, eq=False)
class EnvironmentCells:
    """Sky dome prepared for the light transport matrix; make it once for all frames with
    `prepare_sky`.

    Args:
        radiance: mean radiance of every environment cell, without the sun.
        sun: the sun, if the dome has one.
        smooth: the sky without its sun, at most 512 rows, for reflections.
        behind: the sky without its sun behind surfaces, at its own resolution.
    """

    radiance: Float32[np.ndarray, "c 3"]
    sun: Sun | None
    smooth: Float32[np.ndarray, "h w 3"] | None = None
    behind: Float32[np.ndarray, "a b 3"] | None = None


def prepare_sky(dome: SkyDome, behind: SkyDome | None = None) -> EnvironmentCells:
    """Return the mean radiance of each environment cell by solid angle, and the sun; energy is
    conserved.

    Args:
        behind: the sky that cameras show, if another one; it gives no light.
    """
    rest, sun = split_sun(dome)
    rows = SKY_CELL_ROWS
    solid = np.broadcast_to(
        solid_angles_sr(dome.height_px).astype(np.float32)[..., None], (*rest.shape[:2], 1)
    )
    # Weighted by solid angle, because pixels near the zenith are smaller.
    mean = resize_area(rest * solid, rows, 2 * rows) / resize_area(solid.copy(), rows, 2 * rows)
    smooth = rest
    if len(rest) > 512:
        # Rows of 0.35 degrees, to bound memory and time. Sensitivity not measured.
        smooth = resize_area(rest, 512, 1024)
    visible = rest if behind is None else split_sun(behind)[0]
    return EnvironmentCells(mean.astype(np.float32).reshape(-1, 3), sun, smooth, visible)
