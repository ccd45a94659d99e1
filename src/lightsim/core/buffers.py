"""Geometry and light buffers of one frame, rendered for relighting; arrays are [h, w]."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import numpy as np
from jaxtyping import Bool, Float32, Int32

from lightsim.core.window import Window

NO_SURFACE = -2
"""`actor_index` of a pixel that shows the sky."""
BACKGROUND = -1
"""`actor_index` of a pixel that shows the static background."""


@dataclass(frozen=True, eq=False)
class GBuffers:
    """Geometry buffers. Pixels without a surface have depth inf, position and normal 0, and index
    NO_SURFACE."""

    depth_z_m: Float32[np.ndarray, "h w"]
    position_world: Float32[np.ndarray, "h w 3"]
    normal_world: Float32[np.ndarray, "h w 3"]
    base_colour: Float32[np.ndarray, "h w 3"]
    ambient_occlusion: Float32[np.ndarray, "h w"]
    """Cosine-weighted fraction of the upper hemisphere about the normal that is open; sky 1."""
    actor_index: Int32[np.ndarray, "h w"]
    """Index into the frame's list of placed actors, BACKGROUND or NO_SURFACE."""
    offset_world: Float32[np.ndarray, "h w 3"] | None = None
    """Points on the curved surface that the smooth vertex normals imply; None: the position."""
    towards_camera_world: Float32[np.ndarray, "h w 3"] | None = None
    """Unit vector to the camera; 0 without a surface. None: no specular reflection is rendered."""
    material: Float32[np.ndarray, "h w 2"] | None = None
    """Roughness and metallic. None: no specular reflection is rendered."""
    found_visibility: Float32[np.ndarray, "h w"] | None = None
    """Fraction of the recorded sun that reaches the surface, estimated from all pictures without
    the shadows of moving actors; NaN where there is no estimate. None: no estimate at all."""

    @property
    def ray_starts_world(self) -> Float32[np.ndarray, "h w 3"]:
        """Origins of secondary rays, on the curved surface of the smooth normals."""
        # Rays from the flat faces would be blocked by neighbouring faces near the terminator.
        return self.position_world if self.offset_world is None else self.offset_world

    @property
    def has_surface(self) -> Bool[np.ndarray, "h w"]:
        """True where the pixel's ray meets a mesh; elsewhere it shows the sky."""
        return np.isfinite(self.depth_z_m)

    def part(self, window: Window) -> GBuffers:
        """Return the buffers of a window of the picture."""
        return _each(self, lambda values, _: values[window])

    def within(self, mask: Bool[np.ndarray, "h w"]) -> GBuffers:
        """Return the buffers with all pixels outside `mask` set to "no surface"."""
        return _each(self, lambda values, empty: _kept(values, mask, empty))


# Values of pixels without a surface, for the buffers where that is not 0.
_EMPTY = {
    "depth_z_m": np.inf,
    "ambient_occlusion": 1.0,
    "actor_index": float(NO_SURFACE),
    "found_visibility": np.nan,
}


def _each(buffers: GBuffers, change: Callable[[np.ndarray, float], np.ndarray]) -> GBuffers:
    """Apply `change(array, value without a surface)` to each array."""
    arrays = {f.name: getattr(buffers, f.name) for f in fields(buffers)}
    changed = {n: change(a, _EMPTY.get(n, 0.0)) for n, a in arrays.items() if a is not None}
    return replace(buffers, **changed)


def _kept(values: np.ndarray, mask: Bool[np.ndarray, "h w"], empty: float) -> np.ndarray:
    kept = np.full_like(values, empty)
    kept[mask] = values[mask]
    return kept


@dataclass(frozen=True, eq=False)
class ShadowBuffers:
    """One sky's light on one frame. Irradiances are divided by pi: a white Lambert surface
    shows exactly this radiance.

    Args:
        sun_visibility: visible fraction of the solar disc (0 below the horizon of the surface).
        direct_sun: sun light with visibility.
        sky: light of the dome without the sun, with visibility.
        bounce: light from other surfaces.
        shaded: direct_sun + sky + bounce.
        unshadowed: the same light without visibility rays and without bounce.
        coverage: fraction of each pixel that shows a surface, where pixels were sampled; light is
            the mean over that fraction. None: 1 where the pixel's centre shows a surface, else 0.
        diffuse: radiance of the surfaces by diffuse reflection, mean over the covered fraction.
            None: base colour times `shaded`.
        glossy: radiance by specular reflection, mean over the covered fraction; no part of S.
            None: 0.
        glossy_sun: part of `glossy` that an unoccluded sun would cause. None: 0.
    """

    sun_visibility: Float32[np.ndarray, "h w"]
    direct_sun: Float32[np.ndarray, "h w 3"]
    sky: Float32[np.ndarray, "h w 3"]
    bounce: Float32[np.ndarray, "h w 3"]
    shaded: Float32[np.ndarray, "h w 3"]
    unshadowed: Float32[np.ndarray, "h w 3"]
    coverage: Float32[np.ndarray, "h w"] | None = None
    diffuse: Float32[np.ndarray, "h w 3"] | None = None
    glossy: Float32[np.ndarray, "h w 3"] | None = None
    glossy_sun: Float32[np.ndarray, "h w 3"] | None = None

    @property
    def reflected_sun(self) -> Float32[np.ndarray, "h w 3"]:
        """`glossy_sun`, or zeros."""
        return np.zeros_like(self.shaded) if self.glossy_sun is None else self.glossy_sun

    @property
    def reflected(self) -> Float32[np.ndarray, "h w 3"]:
        """`glossy`, or zeros."""
        return np.zeros_like(self.shaded) if self.glossy is None else self.glossy

    @property
    def ratio(self) -> Float32[np.ndarray, "h w 3"]:
        """Shadow ratio S on direct light (sun and sky), so that S <= 1; 1 where no light
        arrives (paper, Sec. 4: I_render / I_render without visibility)."""
        # Bounced light is in neither term: with it, S could exceed 1.
        direct = self.direct_sun + self.sky
        safe = np.where(self.unshadowed > 0, self.unshadowed, 1.0)
        return np.where(self.unshadowed > 0, direct / safe, 1.0).astype(np.float32)
