"""Changes of an estimated sky: factors on its sun and on its unobserved part."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from lightsim.core.dome import SkyDome, Sun, add_sun, split_sun
from lightsim.core.twin import LightPrior, SkyEstimate
from lightsim.lighting.sky.clear_sky import level_irradiance


def unseen_part(dome: SkyDome, light_prior: LightPrior) -> SkyDome:
    """The sky where no camera observed it, without the sun."""
    sky, _ = split_sun(dome)
    return SkyDome((sky * light_prior.unseen[..., None]).astype(np.float32), None)


def rebalanced(
    estimate: SkyEstimate,
    light_prior: LightPrior,
    sun_factor: Float[np.ndarray, "3"],
    unseen_factor: Float[np.ndarray, "3"],
    *,
    sun_log_std: float,
    unseen_log_std: float,
    note: str,
) -> SkyEstimate:
    """Return the estimate with RGB factors on its sun and on its unobserved sky.

    Args:
        sun_log_std: one standard deviation of the log of the new sun.
        unseen_log_std: one standard deviation of the log of the new unobserved sky.
        note: reason for the change, added to the estimate's notes.
    """
    sky, sun = split_sun(estimate.dome)
    factor = 1.0 + light_prior.unseen[..., None] * (unseen_factor - 1.0)
    changed = (sky * factor).astype(np.float32)
    upper = changed.copy()
    upper[len(upper) // 2 :] = 0.0
    level = level_irradiance(upper)
    unseen = level_irradiance((upper * light_prior.unseen[..., None]).astype(np.float32))
    dome = SkyDome(changed, None)
    if sun is not None:
        light = (sun.irradiance * sun_factor).astype(np.float32)
        dome = add_sun(changed, Sun(sun.direction_world, light, sun.angular_radius_deg))
    return replace(
        estimate,
        dome=dome,
        sun_irradiance_log_std=sun_log_std,
        sky_irradiance=level.astype(np.float32),
        sky_irradiance_log_std=unseen_log_std * float(unseen.sum() / max(level.sum(), 1e-12)),
        notes=(*estimate.notes, note),
    )
