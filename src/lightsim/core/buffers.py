"""What the renderer hands to relighting, per frame; arrays are [h, w]."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import numpy as np
from jaxtyping import Bool, Float32, Int32

from lightsim.core.window import Window

NO_SURFACE = -2
"""actor_index of a pixel that sees the sky."""
BACKGROUND = -1
"""actor_index of a pixel that sees the static background."""


@dataclass(frozen=True, eq=False)
class GBuffers:
    """Geometry buffers. Without a surface: depth inf, position and normal 0, index -2."""

    depth_z_m: Float32[np.ndarray, "h w"]
    position_world: Float32[np.ndarray, "h w 3"]
    normal_world: Float32[np.ndarray, "h w 3"]
    base_colour: Float32[np.ndarray, "h w 3"]
    ambient_occlusion: Float32[np.ndarray, "h w"]
    """Cosine-weighted fraction of the upper hemisphere about the normal that is open; sky 1."""
    actor_index: Int32[np.ndarray, "h w"]
    """Index into the frame's list of placed actors, BACKGROUND or NO_SURFACE."""
    offset_world: Float32[np.ndarray, "h w 3"] | None = None
    """Points of the curved surface that the faces' smooth normals tell of; None: the position."""
    towards_camera_world: Float32[np.ndarray, "h w 3"] | None = None
    """Unit; 0 without a surface. None: nothing reflects."""
    material: Float32[np.ndarray, "h w 2"] | None = None
    """Roughness and metallic. None: nothing reflects."""
    found_visibility: Float32[np.ndarray, "h w"] | None = None
    """Fraction of the recorded sun that the twin found to reach the surfaces, moving actors left
    out; NaN where it found none. None: nowhere."""

    @property
    def ray_starts_world(self) -> Float32[np.ndarray, "h w 3"]:
        """Where rays that leave the surface start: on the curved surface, not on the flat faces,
        which would shadow themselves where they turn away from the light."""
        return self.position_world if self.offset_world is None else self.offset_world

    @property
    def has_surface(self) -> Bool[np.ndarray, "h w"]:
        """Pixels whose ray meets a mesh; the others show the sky."""
        return np.isfinite(self.depth_z_m)

    def part(self, window: Window) -> GBuffers:
        """A window of the picture."""
        return _each(self, lambda values, _: values[window])

    def within(self, mask: Bool[np.ndarray, "h w"]) -> GBuffers:
        """These pixels alone: the others show no surface."""
        return _each(self, lambda values, empty: _kept(values, mask, empty))


_EMPTY = {
    "depth_z_m": np.inf,
    "ambient_occlusion": 1.0,
    "actor_index": float(NO_SURFACE),
    "found_visibility": np.nan,
}
"""What buffers hold without a surface, where that is not 0."""


def _each(buffers: GBuffers, change: Callable[[np.ndarray, float], np.ndarray]) -> GBuffers:
    """The buffers with each array changed; told what it holds without a surface."""
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
        sun_visibility: fraction of the solar disc seen (0 below the horizon of the surface).
        direct_sun: sun light with visibility.
        sky: light of the dome without the sun, with visibility.
        bounce: light from other surfaces.
        shaded: direct_sun + sky + bounce.
        unshadowed: the same light without visibility rays and without bounce.
        coverage: fraction of each pixel that shows a surface, where pixels were sampled; light is
            the mean over that share. None: 1 where the pixel's centre shows a surface, else 0.
        diffuse: radiance of the surfaces by diffuse reflection, mean over the covered share.
            None: base colour times `shaded`.
        glossy: radiance by specular reflection, mean over the covered share; no part of S.
            None: 0.
        glossy_sun: what of `glossy` the sun would give where nothing stands before it. None: 0.
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
        direct = self.direct_sun + self.sky
        safe = np.where(self.unshadowed > 0, self.unshadowed, 1.0)
        return np.where(self.unshadowed > 0, direct / safe, 1.0).astype(np.float32)
