"""Roughness of the road, estimated from its specular reflection of the recorded sun.

The diffuse radiance of a road does not depend on the view direction. The specular reflection of a
low sun is visible only in directions towards the sun, where it is several times the diffuse
radiance. The estimate is the roughness at which the road has the same median base colour within and
outside that reflection.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Float64

from lightsim.appearance.intrinsic.light import SurfaceLight
from lightsim.core.colour import luminance
from lightsim.core.mesh import MATTE_ROUGHNESS

SunReflection = Callable[[float], Float[np.ndarray, "n 3"]]
"""Radiance of the sun's specular reflection at n points, given a roughness."""

# The values below were chosen on synthetic streets; their sensitivity was not measured.

# Range of the estimated roughness.
_ROUGHNESS_RANGE = (MATTE_ROUGHNESS, 0.95)
# Least sun visibility of a lit point, with and without inferred surfaces.
_LIT = 0.95
# Greatest angle between the normal and the half vector of camera and sun, for points within the
# specular reflection.
_BEFORE_SUN_DEG = 20.0
# Range of this angle for points outside the reflection. At larger angles the sun is behind the
# camera, where rough roads are brighter (retroreflection).
_ELSEWHERE_DEG = (35.0, 60.0)
# Least number of points in either group.
_MIN_PLACES = 100


def estimate_roughness(
    radiance: Float[np.ndarray, "n 3"],
    light: SurfaceLight,
    sun_reflection: SunReflection,
    half_cosine: Float64[np.ndarray, " n"],
) -> float | None:
    """Estimate the roughness of a road from n points in images; None if too few are usable.

    Args:
        radiance: observed at the points, linear RGB.
        light: light at the points.
        sun_reflection: radiance of the specular reflection of the unoccluded sun.
        half_cosine: cosine between the normals and the half vectors of camera and sun.
    """
    half_deg = np.degrees(np.arccos(np.clip(half_cosine, -1.0, 1.0)))
    is_lit = (light.visibility.min(axis=1) > _LIT) & (luminance(radiance) > 0)
    before = is_lit & (half_deg < _BEFORE_SUN_DEG)
    elsewhere = is_lit & (half_deg > _ELSEWHERE_DEG[0]) & (half_deg < _ELSEWHERE_DEG[1])
    if min(before.sum(), elsewhere.sum()) < _MIN_PLACES:
        return None
    rest = 0.0 if light.reflected is None else light.reflected.rest
    diffuse = luminance(light.sun + light.sky + light.bounce)

    def excess(roughness: float) -> float:
        """Log ratio of the base colour within the reflection to that outside it."""
        left = luminance(radiance - rest - sun_reflection(roughness))
        # At least 5 % of the radiance is diffuse: keeps the logarithm finite.
        part = np.maximum(left, 0.05 * luminance(radiance)) / diffuse
        return float(np.log(np.median(part[before]) / np.median(part[elsewhere])))

    # Rougher roads reflect less of a low sun to the camera, so the excess grows with roughness.
    low, high = _ROUGHNESS_RANGE
    if excess(low) > 0:
        return low
    for _ in range(12):
        middle = (low + high) / 2
        low, high = (low, middle) if excess(middle) > 0 else (middle, high)
    return (low + high) / 2
