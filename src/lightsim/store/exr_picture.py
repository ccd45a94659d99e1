"""Colour pictures of OpenEXR files: choice of the layer, crops, chroma and primaries."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from lightsim.core.primaries import (
    ACES_AP0,
    SRGB,
    Primaries,
    luminance_weights,
    primaries_of_name,
)
from lightsim.errors import InputError
from lightsim.store.exr_file import (
    HALF_MAX,
    MAX_VALUES,
    ExrChannel,
    Window,
    data_window,
    display_window,
    read_channels,
    read_headers,
)
from lightsim.store.exr_layers import (
    MAX_NAMED,
    ExrLayer,
    ExrPart,
    layers_of,
    named_layers,
)

# Least deviation of a header's number from its default that is noted; rounding causes less.
_NOTED = 1e-3
# Values of oiio:ColorSpace and colorInteropID that name no colour space.
_NO_SPACE = frozenset(("linear", "scene_linear", "unknown", "data", ""))


def read_exr_picture(
    path: Path, layer: str, notes: list[str]
) -> tuple[Float32[np.ndarray, "h w 3"], Primaries]:
    """Return the colours of a layer as stored, row 0 at the top, and their primaries.

    Grey is repeated in three channels, alpha is ignored. Pixels of the display window outside the
    data window are black.

    Args:
        layer: name of a layer, part or view; empty selects the finished picture.
        notes: list to which choices and changes are added.

    Raises:
        InputError: as `read_headers` and `read_channels`; or the file has no colour layer, no layer
            of this name, or several layers of which none is the finished picture.
    """
    headers = read_headers(path)
    chosen = _choose(path, [_part(header) for header in headers], layer, notes)
    # All parts have the same colour space, and some writers declare it in the first part only.
    header = {**headers[0], **headers[chosen.part]}
    primaries = _primaries(header, notes)
    window, frame = data_window(header), _frame(path, header, notes)
    names = [*chosen.channels, *([chosen.alpha] if chosen.alpha else [])]
    channels = read_channels(path, headers, chosen.part, names)
    channels, alpha = channels[: len(chosen.channels)], channels[len(chosen.channels) :]
    rgb = np.empty((window.height, window.width, 3), dtype=np.float32)
    for letter in range(3):
        rgb[..., letter] = _plane(channels[letter % len(channels)], rgb.shape[:2])
    _note_brightest(channels, notes)
    if alpha:
        _note_alpha(_plane(alpha[0], rgb.shape[:2]), rgb, window, frame, notes)
    if chosen.kind == "chroma":
        _rgb_from_chroma(path, rgb, primaries)
        notes.append("converted from luminance and chroma (Y, RY, BY)")
    _note_unapplied(header, primaries, notes)
    return _framed(path, rgb, window, frame, notes), primaries


def _part(header: Mapping[str, Any]) -> ExrPart:
    window = data_window(header)
    views = header.get("multiView", ())
    return ExrPart(
        str(header.get("name", "")),
        str(header.get("view", "")),
        tuple(map(str, views)) if isinstance(views, list) else (),
        tuple(channel.name for channel in header["channels"]),
        window.width * window.height,
    )


def _choose(path: Path, parts: Sequence[ExrPart], name: str, notes: list[str]) -> ExrLayer:
    layers = layers_of(parts)
    found = named_layers(layers, name) if name else layers
    offered = ", ".join(layer.name for layer in layers[:MAX_NAMED])
    if not layers:
        channels = [channel for part in parts for channel in part.channels]
        raise InputError(
            "the OpenEXR file does not contain a colour picture",
            where=path,
            got=f"channels {', '.join(sorted(channels)[:MAX_NAMED])}",
            expected="R, G, B; Y, RY, BY; or Y, with or without a layer's name",
            remedy="Export the picture as RGB.",
        )
    if len(found) != 1 and name:
        raise InputError(
            f"the OpenEXR file has {'several layers' if found else 'no layer'} of this name",
            where=path,
            got=name,
            expected=f"one of {offered}",
        )
    chosen = found[0]
    # Several layers, none of them named as a finished picture: any choice would be a guess.
    if not chosen.is_certain and len(found) > 1:
        raise InputError(
            "the OpenEXR file contains several pictures, and no name identifies the finished one",
            where=path,
            got=offered,
            remedy=f"Name one: {path.name}#{chosen.name}",
        )
    others = [layer.name for layer in layers if layer is not chosen]
    if name:
        notes.append(f"took {chosen.name}, as named")
    elif others:
        more = ", ".join(others[:MAX_NAMED])
        notes.append(f"took {chosen.name}, not {more}; FILE#LAYER chooses another")
    elif len(parts) > 1 or "." in chosen.channels[0]:
        notes.append(f"took {chosen.name}, the only colour picture")
    return chosen


def _plane(channel: ExrChannel, shape: tuple[int, int]) -> Float32[np.ndarray, "h w"]:
    """Return a channel at every pixel, with sparse samples interpolated."""
    pixels = channel.pixels
    if pixels.dtype == np.float16:
        # Writers store a sun that is brighter than the largest half as infinite.
        pixels = np.where(np.isposinf(pixels), np.float16(HALF_MAX), pixels)
    plane = pixels.astype(np.float32, copy=False)
    for axis, step in enumerate(channel.sampling[::-1]):
        if step > 1:
            plane = _between(plane, axis, step, shape[axis])
    return plane


def _between(
    plane: Float32[np.ndarray, "h w"], axis: int, step: int, count: int
) -> Float32[np.ndarray, "v u"]:
    """Interpolate samples at pixels 0, step, 2 step, ... linearly, and repeat the last one."""
    position = np.arange(count) / step
    first = np.minimum(position.astype(np.int64), plane.shape[axis] - 1)
    second = np.minimum(first + 1, plane.shape[axis] - 1)
    part = (position - first).astype(np.float32)
    part = part[:, None] if axis == 0 else part
    return plane.take(first, axis) * (1 - part) + plane.take(second, axis) * part


def _note_brightest(channels: Sequence[ExrChannel], notes: list[str]) -> None:
    halves = [c.pixels for c in channels if c.pixels.dtype == np.float16]
    count = sum(int((pixels >= HALF_MAX).sum()) for pixels in halves)
    if count:
        notes.append(
            f"{count} values reach the largest half float and are taken as 65504: the sun's light"
            " is a lower bound; export 32-bit floats for all of it"
        )


def _note_alpha(
    alpha: Float32[np.ndarray, "h w"],
    rgb: Float32[np.ndarray, "h w 3"],
    window: Window,
    frame: Window,
    notes: list[str],
) -> None:
    """Note the part of the sphere with alpha below 1, and how much of it is black.

    Stitched panoramas have alpha 0 where no photograph was taken, renderers often in the sky, too.
    """
    is_open = alpha < 1 - _NOTED
    columns = np.arange(window.width) + window.x - frame.x
    is_open &= (columns >= 0) & (columns < frame.width)
    if not is_open.any():
        return
    edges = np.clip((np.arange(window.height + 1) + window.y - frame.y) / frame.height, 0, 1)
    # Solid angle of a pixel of each row as a fraction of the sphere; 0 outside the frame.
    share = -np.diff(np.cos(np.pi * edges)) / (2 * frame.width)
    is_black = is_open & ~rgb.any(axis=2)
    whole, black = (float(share @ there.sum(axis=1)) for there in (is_open, is_black))
    if whole > 0:
        notes.append(
            f"alpha is not applied: it is below 1 over {whole:.1%} of the sphere, of which"
            f" {black / whole:.0%} is black"
        )


def _primaries(header: Mapping[str, Any], notes: list[str]) -> Primaries:
    """Return the primaries from the header's chromaticities, else from its other attributes."""
    written = header.get("chromaticities")
    if isinstance(written, tuple) and any(written):
        return tuple(float(value) for value in written)
    for key in ("colorInteropID", "oiio:ColorSpace"):
        name = header.get(key)
        if not isinstance(name, str) or name.strip().lower() in _NO_SPACE:
            continue
        known = primaries_of_name(name)
        if known is not None:
            return known
        notes.append(
            f"{key} is {name[:40]!r}, but the header has no chromaticities: colours are taken as"
            " linear sRGB"
        )
    # Files in the ACES container have AP0 primaries (SMPTE ST 2065-4).
    return ACES_AP0 if header.get("acesImageContainerFlag") == 1 else SRGB


def _note_unapplied(header: Mapping[str, Any], primaries: Primaries, notes: list[str]) -> None:
    """Add a note for each ignored attribute that concerns the display instead of the light."""
    luminance, neutral = header.get("whiteLuminance"), header.get("adoptedNeutral")
    if isinstance(luminance, float):
        notes.append(f"whiteLuminance {luminance:.4g} is not applied: values are taken as stored")
    if (
        isinstance(neutral, np.ndarray)
        and neutral.shape == (2,)
        and np.abs(neutral - primaries[6:]).max() > _NOTED
    ):
        notes.append("adoptedNeutral is not applied: the light keeps its colour")
    aspect = header["pixelAspectRatio"]
    if abs(aspect - 1.0) > _NOTED:
        notes.append(
            f"pixelAspectRatio {aspect:.4g} is not applied: the picture is taken to span the sphere"
        )


def _rgb_from_chroma(
    path: Path, pixels: Float32[np.ndarray, "h w 3"], primaries: Primaries
) -> None:
    """Convert Y, RY, BY to R, G, B in place: R = Y (1 + RY), B = Y (1 + BY), Y = luminance."""
    try:
        red_weight, green_weight, blue_weight = luminance_weights(primaries).tolist()
    except ValueError as error:
        raise unusable_primaries(path, error) from error
    # Green is divided by its weight, which is 0.7 for sRGB.
    if green_weight < 1e-3:
        raise unusable_primaries(path, ValueError("green has no luminance"))
    # Overflow gives inf or NaN, which `hdr` refuses afterwards.
    with np.errstate(over="ignore", invalid="ignore"):
        y, red_chroma, blue_chroma = np.moveaxis(pixels, 2, 0)
        red, blue = y * (1 + red_chroma), y * (1 + blue_chroma)
        green = (y - red_weight * red - blue_weight * blue) / green_weight
        pixels[..., 0], pixels[..., 1], pixels[..., 2] = red, green, blue


def unusable_primaries(path: Path, error: ValueError) -> InputError:
    """Return the error for primaries that do not define a colour space."""
    return InputError(
        "the colours of the picture cannot be converted to linear sRGB",
        where=path,
        got=f"{error}",
        expected="chromaticities of red, green, blue and white",
        remedy="Export it with linear sRGB (Rec.709) primaries.",
    )


def _frame(path: Path, header: Mapping[str, Any], notes: list[str]) -> Window:
    """Return the display window, or the data window if only this one is twice as wide as high."""
    data, display = data_window(header), display_window(header)
    if data.width == 2 * data.height and display.width != 2 * display.height:
        notes.append(f"the display window {display} is not applied: the picture is {data}")
        return data
    size = 3 * display.width * display.height
    if min(display.width, display.height) < 1 or size > MAX_VALUES:
        raise InputError(
            "the display window of the OpenEXR picture is out of range",
            where=path,
            got=display,
            expected=f"1 to {MAX_VALUES // 3} pixels",
            remedy="Export it with a display window of the whole panorama.",
        )
    return display


def _framed(
    path: Path, rgb: Float32[np.ndarray, "h w 3"], data: Window, frame: Window, notes: list[str]
) -> Float32[np.ndarray, "v u 3"]:
    """Crop or pad the data window to the frame; pixels without data are black."""
    if data.is_same(frame):
        return rgb
    left, top = max(data.x, frame.x), max(data.y, frame.y)
    right = min(data.x + data.width, frame.x + frame.width)
    bottom = min(data.y + data.height, frame.y + frame.height)
    if right <= left or bottom <= top:
        raise InputError(
            "no pixel of the OpenEXR picture lies in its display window",
            where=path,
            got=f"the data window {data}",
            expected=f"a part of {frame}",
            remedy="Export it with a display window of the whole panorama.",
        )
    inside = rgb[top - data.y : bottom - data.y, left - data.x : right - data.x]
    if inside.shape[:2] == (frame.height, frame.width):
        notes.append(f"cropped from {data} to the display window {frame}")
        return np.ascontiguousarray(inside)
    # OpenEXR defines no value outside the data window; black adds no light.
    whole = np.zeros((frame.height, frame.width, 3), dtype=np.float32)
    whole[top - frame.y : bottom - frame.y, left - frame.x : right - frame.x] = inside
    missing = 1.0 - _sphere(top - frame.y, bottom - frame.y, frame.height) * (
        (right - left) / frame.width
    )
    notes.append(
        f"black outside the data window {data} of {frame}: {missing:.1%} of the sphere is missing"
    )
    return whole


def _sphere(top: int, bottom: int, height: int) -> float:
    """Return the fraction of the sphere's solid angle between two rows of a panorama."""
    upper, lower = np.cos(np.pi * top / height), np.cos(np.pi * bottom / height)
    return float(upper - lower) / 2
