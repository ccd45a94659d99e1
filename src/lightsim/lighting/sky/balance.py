"""An estimated sky with its sun and its unseen part changed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from lightsim.core.dome import SkyDome, Sun, add_sun, irradiance, split_sun
from lightsim.core.twin import LightFreedom, SkyEstimate

_UP = np.array([0.0, 0.0, 1.0])


def unseen_part(dome: SkyDome, freedom: LightFreedom) -> SkyDome:
    """The sky where no camera saw it, without sun."""
    sky, _ = split_sun(dome)
    return SkyDome((sky * freedom.unseen[..., None]).astype(np.float32), None)


def rebalanced(
    estimate: SkyEstimate,
    freedom: LightFreedom,
    sun_factor: Float[np.ndarray, "3"],
    unseen_factor: Float[np.ndarray, "3"],
    *,
    log_std: float,
    note: str,
) -> SkyEstimate:
    """The estimate with RGB factors on its sun and on its unseen sky.

    Args:
        log_std: one standard deviation of the log of the new sun's irradiance.
        note: says why.
    """
    sky, sun = split_sun(estimate.dome)
    factor = 1.0 + freedom.unseen[..., None] * (unseen_factor - 1.0)
    changed = (sky * factor).astype(np.float32)
    upper = changed.copy()
    upper[len(upper) // 2 :] = 0.0
    dome = SkyDome(changed, None)
    if sun is not None:
        light = (sun.irradiance * sun_factor).astype(np.float32)
        dome = add_sun(changed, Sun(sun.direction_world, light, sun.angular_radius_deg))
    return replace(
        estimate,
        dome=dome,
        sun_irradiance_log_std=log_std,
        sky_irradiance=irradiance(upper, _UP).astype(np.float32),
        notes=(*estimate.notes, note),
    )
