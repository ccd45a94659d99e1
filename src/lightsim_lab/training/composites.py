"""Measured clouds over physical clear skies: many skies from the few that were photographed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32
from scipy import ndimage

from lightsim.core.colour import luminance
from lightsim.lighting.panorama.inpaint import fill_by_nearest
from lightsim_lab.training import grids
from lightsim_lab.training.hdr_skies import HdrSky
from lightsim_lab.training.procedural_skies import (
    ClearSkies,
    Heaven,
    clear_heaven,
    heaven_of,
    is_sunny,
    turned_heaven,
)

# Not measured alone.

_BLUE_RANGE = 0.25
"""Log of blue over red must differ by this within a sky to part cloud from blue."""
_BLUE_LEVEL = 0.35
"""A sky of one colour is blue above this log ratio, else a closed cover."""
_SHADE_RANGE = (0.05, 8.0)
"""Of a cloud's radiance over that of white level ground: its silver lining at most."""
_GLARE_DEG = 12.0
"""The glow of a clear sun is white, too: no cloud is taken from within this of it."""
_ELEVATION_SPREAD = 0.35
"""Largest change of the log of the sun's elevation: clouds keep their light and dark sides."""
_GLOW_RATIO = 3.0
"""A sky whose brightest part exceeds its median by this is lit from there, sun or no sun."""
_GLOW_PX = 3
"""Radius over which the brightest part is averaged."""
_DEPTH = (1.0, 6.0)
"""Optical depth of an opaque cloud before the sun."""


@dataclass(frozen=True, eq=False)
class CloudLayer:
    """The clouds of a measured sky; where light comes from one side, that lies at azimuth 0.

    Args:
        opacity: 0 to 1.
        shade: radiance over that of white level ground under the whole sky.
        elevation_deg: of the sun or of the glow it leaves in clouds; None of an even sky.
        is_sunny: its sun is clear.
    """

    opacity: Float32[np.ndarray, "h w"]
    shade: Float32[np.ndarray, "h w 3"]
    elevation_deg: float | None
    is_sunny: bool


def cloud_layer(sky: HdrSky) -> CloudLayer:
    """Cloud is what is less blue than the bluest of the sky; scene takes the nearest sky."""
    heaven = heaven_of(sky)
    rest = fill_by_nearest(heaven.rest, sky.sky_seen) if sky.sky_seen.any() else heaven.rest
    columns, elevation_deg = 0, None
    towards = heaven.sun_direction if is_sunny(heaven) else _glow(rest)
    if towards is not None:
        columns = _columns_to(towards, rest.shape[1])
        elevation_deg = float(np.degrees(np.arcsin(np.clip(towards[2], -1, 1))))
    turned = turned_heaven(Heaven(rest, *_sun_of(heaven)), columns, flip=False)
    shade = turned.rest / max(_level(turned) / np.pi, 1e-6)
    shade = np.clip(shade, 0.0, _SHADE_RANGE[1]).astype(np.float32)
    return CloudLayer(_opacity(turned.rest), shade, elevation_deg, is_sunny(heaven))


def composite_heaven(layer: CloudLayer, clear: ClearSkies, rng: np.random.Generator) -> Heaven:
    """The clouds over a clear sky whose sun, at azimuth 0, stands about as high as theirs."""
    wanted = None
    if layer.elevation_deg is not None:
        factor = float(np.exp(rng.uniform(-_ELEVATION_SPREAD, _ELEVATION_SPREAD)))
        wanted = float(np.clip(layer.elevation_deg * factor, 2.0, 85.0))
    behind = clear_heaven(clear, rng, wanted)
    columns = 0 if wanted is not None else int(rng.integers(layer.opacity.shape[1]))
    return _covered(behind, layer, columns, rng)


def exchanged_heaven(
    sky: HdrSky, layers: Sequence[CloudLayer], clear: ClearSkies, rng: np.random.Generator
) -> Heaven:
    """A measured place under another sky with the same clear sun, whose light its ground shows.

    Args:
        layers: of which those with a clear sun about as high count.
    """
    heaven = heaven_of(sky)
    elevation_deg = float(np.degrees(np.arcsin(np.clip(heaven.sun_direction[2], -1, 1))))
    behind = clear_heaven(clear, rng, elevation_deg)
    # Shadows on the ground say that no cloud is before the sun.
    fitting = [layer for layer in layers if _has_such_a_sun(layer, elevation_deg)]
    if fitting:
        behind = _covered(behind, fitting[int(rng.integers(len(fitting)))], 0, rng)
    columns = -_columns_to(heaven.sun_direction, behind.rest.shape[1])
    other = turned_heaven(behind, columns, flip=False)
    scale = np.median(luminance(heaven.rest[sky.sky_seen])) / max(
        float(np.median(luminance(other.rest[sky.sky_seen]))), 1e-6
    )
    rest = np.where(sky.sky_seen[..., None], other.rest * np.float32(scale), heaven.rest)
    return Heaven(rest.astype(np.float32), *_sun_of(heaven))


def _has_such_a_sun(layer: CloudLayer, elevation_deg: float) -> bool:
    if not layer.is_sunny or layer.elevation_deg is None:
        return False
    change = abs(math.log(max(layer.elevation_deg, 1.0) / elevation_deg))
    return change <= _ELEVATION_SPREAD


def _columns_to(direction: Float[np.ndarray, "3"], width: int) -> int:
    """Columns by which a sky is turned to bring a direction to azimuth 0."""
    return round(float(np.arctan2(direction[1], direction[0])) / (2 * np.pi) * width)


def _glow(rest: Float32[np.ndarray, "h w 3"]) -> Float[np.ndarray, "3"] | None:
    """Where an uneven sky is brightest."""
    value = luminance(rest).astype(np.float64)
    value = ndimage.uniform_filter1d(value, 2 * _GLOW_PX + 1, axis=1, mode="wrap")
    value = ndimage.uniform_filter1d(value, 2 * _GLOW_PX + 1, axis=0, mode="nearest")
    if value.max() < _GLOW_RATIO * np.median(value):
        return None
    directions = grids.directions(2 * len(rest))[: len(rest)]
    return directions.reshape(-1, 3)[int(value.argmax())].astype(np.float64)


def _covered(behind: Heaven, layer: CloudLayer, columns: int, rng: np.random.Generator) -> Heaven:
    """A clear sky, its sun at azimuth 0, behind the layer turned by columns."""
    opacity, shade = (np.roll(a, columns, axis=1) for a in (layer.opacity, layer.shade))
    if rng.random() < 0.5:
        opacity, shade = opacity[:, ::-1], shade[:, ::-1]
    angle = _angle_to(behind.sun_direction, 2 * len(opacity))
    if layer.is_sunny:
        opacity = opacity * np.clip(angle / np.radians(_GLARE_DEG) - 0.5, 0.0, 1.0)
    at_sun = float(opacity.ravel()[int(angle.argmin())])
    # A closed cover lets less of the light through than scattered clouds do.
    dimming = float(np.exp(-rng.uniform(0.2, 1.4) * opacity.mean() ** 2))
    lit = shade * np.float32(dimming * _level(behind) / np.pi)
    rest = behind.rest * (1 - opacity[..., None]) + lit * opacity[..., None]
    sun = behind.sun_irradiance * float(np.exp(-rng.uniform(*_DEPTH) * at_sun))
    return Heaven(rest.astype(np.float32), behind.sun_direction, sun)


def _opacity(rest: Float32[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "h w"]:
    blue = np.log(np.maximum(rest[..., 2], 1e-6) / np.maximum(rest[..., 0], 1e-6))
    low, high = (float(x) for x in np.percentile(blue, (5, 95)))
    if high - low < _BLUE_RANGE:
        return np.full(blue.shape, float(high < _BLUE_LEVEL), np.float32)
    cloud = np.clip((high - blue) / (high - low) * 1.4 - 0.2, 0.0, 1.0)
    return (cloud * cloud * (3 - 2 * cloud)).astype(np.float32)


def _level(heaven: Heaven) -> float:
    """Luminance of the irradiance on level ground, sun and sky."""
    total = heaven.level_irradiance() + heaven.sun_irradiance * max(heaven.sun_direction[2], 0.0)
    return float(luminance(total.astype(np.float32)))


def _sun_of(heaven: Heaven) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    return heaven.sun_direction, heaven.sun_irradiance


def _angle_to(direction: Float[np.ndarray, "3"], height_px: int) -> Float[np.ndarray, "h w"]:
    cosine = grids.directions(height_px)[: height_px // 2] @ direction
    return np.arccos(np.clip(cosine, -1, 1))
