"""How rough a road is, told by its sheen before the recorded sun.

A road's diffuse light is the same from everywhere; what it mirrors of the sun is seen towards the
sun alone, several times as bright there as elsewhere under a low sun. The roughness at which base
colours there are those of the road elsewhere is the road's.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float, Float64

from lightsim.appearance.intrinsic.light import SurfaceLight
from lightsim.core.colour import luminance
from lightsim.core.mesh import MATTE_ROUGHNESS

Sheen = Callable[[float], Float[np.ndarray, "n 3"]]
"""Radiance of the sun's reflection at places, of a roughness."""

# Roughness that is looked for: lobes are wide, and roads no mirrors.
_SMOOTHEST, _ROUGHEST = MATTE_ROUGHNESS, 0.95
# Places that nothing shades by either belief.
_LIT = 0.95
# Angles between a place's normal and what would mirror the sun: at most before the sun, and from to
# elsewhere. Beyond, the road is looked at with the sun behind, and rough roads are brighter.
_BEFORE_SUN_DEG, _ELSEWHERE_DEG = 20.0, (35.0, 60.0)
# Fewer places tell nothing.
_LEAST_PLACES = 100
_LEAST_PART = 0.05
_HALVINGS = 12


def fitted_roughness(
    radiance: Float[np.ndarray, "n 3"],
    light: SurfaceLight,
    sheen: Sheen,
    half_cosine: Float64[np.ndarray, " n"],
) -> float | None:
    """Of the road of n places in pictures; None where too few of them tell.

    Args:
        radiance: of the pictures.
        light: on the places.
        sheen: of their sun, nothing in its way.
        half_cosine: of the angle between the places' normals and the bisectors of the ways to
            camera and sun.
    """
    half_deg = np.degrees(np.arccos(np.clip(half_cosine, -1.0, 1.0)))
    is_lit = (light.visibility.min(axis=1) > _LIT) & (luminance(radiance) > 0)
    before = is_lit & (half_deg < _BEFORE_SUN_DEG)
    elsewhere = is_lit & (half_deg > _ELSEWHERE_DEG[0]) & (half_deg < _ELSEWHERE_DEG[1])
    if min(before.sum(), elsewhere.sum()) < _LEAST_PLACES:
        return None
    rest = 0.0 if light.reflected is None else light.reflected.rest
    diffuse = luminance(light.sun + light.sky + light.bounce)

    def excess(roughness: float) -> float:
        """By how much the road's base colour before the sun is above that elsewhere, log."""
        left = luminance(radiance - rest - sheen(roughness))
        part = np.maximum(left, _LEAST_PART * luminance(radiance)) / diffuse
        return float(np.log(_median(part, before) / _median(part, elsewhere)))

    low, high = _SMOOTHEST, _ROUGHEST
    if excess(low) > 0:
        return low
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        low, high = (low, middle) if excess(middle) > 0 else (middle, high)
    return (low + high) / 2


def _median(values: Float64[np.ndarray, " n"], members: Bool[np.ndarray, " n"]) -> float:
    return float(np.median(values[members]))
