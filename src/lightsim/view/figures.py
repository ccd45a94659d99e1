"""Images for reports: sky previews, image rows, and colour maps of buffers (8-bit sRGB)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Float32, UInt8

from lightsim.core.buffers import GBuffers
from lightsim.core.colour import linear_from_srgb8, luminance, srgb8_from_linear
from lightsim.core.dome import SkyDome
from lightsim.core.equirect import uv_from_directions
from lightsim.core.resample import resize_area
from lightsim.errors import InputError

# Coefficients of the Turbo colour map's polynomial (Mikhailov 2019) by channel, sRGB in [0, 1].
_TURBO = np.array(
    [
        [0.13572138, 4.61539260, -42.66032258, 132.13108234, -152.94239396, 59.28637943],
        [0.09140261, 2.19418839, 4.84296658, -14.18503333, 4.27729857, 2.82956604],
        [0.10667330, 12.64194608, -60.58204836, 110.36276771, -89.90310912, 27.34824973],
    ]
)


def tone_mapped(linear: Float[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """Return an image of HDR radiance, with the median positive luminance mapped to 0.35.

    Highlights are compressed, so that the sun's shape remains visible.
    """
    value = luminance(linear)
    lit = value[value > 0]
    gain = 0.35 / float(np.median(lit)) if len(lit) else 1.0
    # Linear up to 0.6, then a smooth shoulder that reaches 1 at infinity. One factor for all three
    # channels preserves the hue.
    exposed = np.maximum(value * gain, 1e-9)
    over = np.maximum(exposed - 0.6, 0.0)
    mapped = np.minimum(exposed, 0.6) + 0.4 * over / (over + 0.4)
    return srgb8_from_linear(linear * (gain * mapped / exposed)[..., None])


def dome_preview(dome: SkyDome) -> UInt8[np.ndarray, "h w 3"]:
    """Return the dome as an 8-bit image about 768 pixels wide.

    Its centre column looks along world +x; a ring marks the sun, if the dome has one.
    """
    width_px = 768
    step = max(1, dome.radiance.shape[1] // width_px)
    height, width = dome.height_px // step, dome.radiance.shape[1] // step
    cropped = dome.radiance[: height * step, : width * step]
    small = cropped.reshape(height, step, width, step, 3).mean(axis=(1, 3))
    enlarge = max(1, width_px // width)
    picture = tone_mapped(small).repeat(enlarge, axis=0).repeat(enlarge, axis=1)
    if dome.sun is not None:
        uv = uv_from_directions(dome.sun.direction_world)
        _draw_ring(picture, float(uv[0]), float(uv[1]))
    return picture


def strip(pictures: Sequence[UInt8[np.ndarray, "..."]]) -> UInt8[np.ndarray, "h w 3"]:
    """Return images of one height side by side.

    Raises:
        InputError: there is none, or their heights differ.
    """
    heights = {picture.shape[0] for picture in pictures}
    if len(heights) != 1:
        raise InputError(
            "images in one row of a figure differ in height, or there is none",
            got=f"heights {sorted(heights)} px",
            expected="one or more images of one height",
        )
    gap = np.full((heights.pop(), 6, 3), 128, dtype=np.uint8)
    parts = [part for picture in pictures for part in (picture, gap)]
    return np.concatenate(parts[:-1], axis=1)


def ratio_grey(ratio: Float32[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """Return the shadow ratio as grey: black in full shadow, white in full light."""
    return np.round(np.clip(ratio, 0.0, 1.0) * 255).astype(np.uint8)


def depth_colours(depth_z_m: Float[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """Return depth in Turbo colours on a logarithmic scale, near (2 m) red to far (80 m) blue.

    Pixels without a surface are dark grey.
    """
    near_m, far_m = 2.0, 80.0
    part = np.log(np.clip(depth_z_m, near_m, far_m) / far_m) / np.log(near_m / far_m)
    # The dark ends of Turbo are left out, so that depths differ from the grey of missing surfaces.
    return _on_surface(_turbo(0.08 + 0.84 * part), np.isfinite(depth_z_m))


def normal_colours(buffers: GBuffers) -> UInt8[np.ndarray, "h w 3"]:
    """Return world normals as (n + 1) / 2: red along world x, green along y, blue up."""
    colours = np.round((buffers.normal_world + 1.0) * 127.5)
    return _on_surface(np.clip(colours, 0, 255).astype(np.uint8), buffers.has_surface)


def _on_surface(
    colours: UInt8[np.ndarray, "h w 3"], is_surface: np.ndarray
) -> UInt8[np.ndarray, "h w 3"]:
    return np.where(is_surface[..., None], colours, np.uint8(24)).astype(np.uint8)


def _turbo(part: Float[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    powers = np.stack([part.astype(np.float64) ** k for k in range(6)], axis=-1)
    return np.round(np.clip(powers @ _TURBO.T, 0.0, 1.0) * 255).astype(np.uint8)


def _draw_ring(picture: UInt8[np.ndarray, "h w 3"], u: float, v: float) -> None:
    """Draw an orange ring around (u, v), fractions of width and height; wraps around in u."""
    height, width = picture.shape[:2]
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    dx = np.abs(x - u * width)
    distance = np.hypot(np.minimum(dx, width - dx), y - v * height)
    radius = max(6.0, height / 24)
    picture[np.abs(distance - radius) < max(1.0, height / 250)] = (255, 64, 32)


def reduced(image: UInt8[np.ndarray, "h w 3"], width_px: int = 640) -> UInt8[np.ndarray, "h2 w2 3"]:
    """Return the image at most `width_px` wide, averaged in linear light."""
    if image.shape[1] <= width_px:
        return image
    height_px = round(image.shape[0] * width_px / image.shape[1])
    return srgb8_from_linear(resize_area(linear_from_srgb8(image), height_px, width_px))
