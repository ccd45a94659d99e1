"""Source light with the sun visibility that was estimated from all pictures.

The twin stores this estimate because reconstructed geometry does not render the recorded shadows
to the pixel.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Float32

from lightsim.core.buffers import GBuffers, ShadowBuffers
from lightsim.core.dome import Sun

# Estimates below the first value become 0, above the second 1; between them, visibility is linear.
# Texture that is mistaken for sunlight leaves a few hundredths of the sun in shade, where a small
# part of the sun is a large part of the light. Chosen; sensitivity not measured.
_UNDECIDED = 0.1, 0.9


def decided(visibility: Float[np.ndarray, "*n"]) -> Float32[np.ndarray, "*n"]:
    """Stretch an estimated visibility, so that values near 0 and 1 become exactly 0 and 1."""
    shade, light = _UNDECIDED
    return np.clip((visibility - shade) / (light - shade), 0.0, 1.0).astype(np.float32)


def unoccluded_sun(
    buffers: GBuffers, shadows: ShadowBuffers, sun: Sun
) -> Float32[np.ndarray, "h w 3"]:
    """Return the unoccluded sunlight divided by pi; in lit pixels, from the rendered light
    itself."""
    direction = sun.direction_world.astype(np.float32)
    cosine = np.maximum(buffers.normal_world @ direction, 0.0)[..., None]
    computed = cosine * (sun.irradiance / np.float32(np.pi))
    visibility = shadows.sun_visibility[..., None]
    # The division amplifies noise of rays: only where most rays reached the sun.
    is_lit = visibility > 0.5
    rendered = shadows.direct_sun / np.where(is_lit, visibility, 1.0)
    return np.where(is_lit, rendered, computed).astype(np.float32)


def with_found_visibility(
    shadows: ShadowBuffers,
    buffers: GBuffers,
    sun: Sun,
    found: Float32[np.ndarray, "h w"] | None,
) -> ShadowBuffers:
    """Return the source light with an estimated sun visibility.

    Args:
        found: estimate from all pictures; NaN where the rendered visibility holds. None:
        everywhere.
    """
    if found is None:
        return shadows
    is_found = np.isfinite(found) & buffers.has_surface
    visibility = np.where(is_found, found, shadows.sun_visibility).astype(np.float32)
    return with_sun_visibility(shadows, unoccluded_sun(buffers, shadows, sun), visibility)


def with_sun_visibility(
    shadows: ShadowBuffers,
    sunlight: Float32[np.ndarray, "h w 3"],
    visibility: Float32[np.ndarray, "h w"],
) -> ShadowBuffers:
    """Return the light with another sun visibility; pixels with an equal value stay exact."""
    # Recomputed light differs from rendered light by rounding: a comparison of both must not show
    # a change where there is none.
    is_same = visibility == shadows.sun_visibility
    direct = np.where(is_same[..., None], shadows.direct_sun, sunlight * visibility[..., None])
    direct = direct.astype(np.float32)
    shaded = np.where(is_same[..., None], shadows.shaded, direct + shadows.sky + shadows.bounce)
    diffuse, glossy = shadows.diffuse, shadows.glossy
    if diffuse is not None:
        # The mean base colour of the pixel's samples is assumed unchanged, so that their reflection
        # changes as the light does.
        brighter = shaded / np.maximum(shadows.shaded, np.float32(1e-9))
        diffuse = np.where(is_same[..., None], diffuse, diffuse * brighter).astype(np.float32)
    if glossy is not None:
        change = (visibility - shadows.sun_visibility)[..., None]
        glossy = np.maximum(glossy + change * shadows.reflected_sun, 0.0).astype(np.float32)
    return replace(
        shadows,
        diffuse=diffuse,
        glossy=glossy,
        sun_visibility=visibility,
        direct_sun=direct,
        shaded=shaded.astype(np.float32),
        # The unoccluded sunlight of a partly lit pixel is inaccurate, and may exceed the rendered
        # value: raised with it, so that the ratio S stays at most 1.
        unshadowed=np.maximum(shadows.unshadowed, direct + shadows.sky),
    )
