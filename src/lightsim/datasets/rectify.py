"""Pinhole views of a distorted camera: one, or several for a lens wider than 110 degrees."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from lightsim.core.camera import PinholeCamera
from lightsim.core.colour import linear_from_srgb8, srgb8_from_linear
from lightsim.datasets.lenses import Lens

# Widest single pinhole view: at its edge a pixel covers a third of the angle of a central one.
_WIDEST_DEG = 110.0
# Steepest elevation of a view: beyond, a pinhole picture is mostly stretched corners.
_STEEPEST_DEG = 50.0
# Spacing of the directions that measure a lens's field of view.
_STEP_DEG = 0.5
# Endings of the names of views, by their number.
_VIEW_NAMES = {1: ("",), 2: ("_left", "_right"), 3: ("_left", "_mid", "_right")}


@dataclass(frozen=True, eq=False)
class View:
    """A pinhole camera that shows a part of a lens's picture.

    Args:
        camera_from_view: rotation from the view's axes to those of the recorded camera.
    """

    camera: PinholeCamera
    lens: Lens
    camera_from_view: Float[np.ndarray, "3 3"]

    @cached_property
    def _source(self) -> tuple[Float32[np.ndarray, "h w 2"], Bool[np.ndarray, "h w"]]:
        """(u, v) in the recorded picture of each pixel of the view, and whether it exists."""
        shape = (self.camera.height_px, self.camera.width_px)
        directions = self.camera.directions(self.camera.pixel_centres().reshape(-1, 2))
        uv, is_inside = self.lens.project(directions @ self.camera_from_view.T)
        uv = np.where(is_inside[:, None], uv, 0.0).astype(np.float32)
        return uv.reshape(*shape, 2), is_inside.reshape(shape)

    @property
    def is_recorded(self) -> bool:
        """True if the view is the recorded picture itself."""
        return self.lens.is_pinhole

    def outside(self, mask: Bool[np.ndarray, "H W"] | None) -> Bool[np.ndarray, "h w"] | None:
        """Return the pixels that the lens does not see or that are masked in the recorded picture;
        None if there are none."""
        if self.is_recorded:
            return mask if mask is not None and mask.any() else None
        uv, is_inside = self._source
        found = ~is_inside
        if mask is not None:
            column, row = np.moveaxis(uv.astype(np.int64), -1, 0)
            found |= mask[row, column]
        return found if found.any() else None

    def resampled(self, picture: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "h w 3"]:
        """Return the view of a recorded picture, interpolated in linear light; black outside."""
        if self.is_recorded:
            return picture
        from scipy.ndimage import map_coordinates

        uv, is_inside = self._source
        # Pixel centres are at 0.5, array indices at 0; rows first.
        at = np.moveaxis(uv[..., ::-1] - 0.5, -1, 0)
        linear = linear_from_srgb8(picture)
        channels = [map_coordinates(linear[..., c], at, order=1, mode="nearest") for c in range(3)]
        made = np.stack(channels, axis=-1)
        made[~is_inside] = 0.0
        return srgb8_from_linear(made)

    def readout(self, down_s: float, across_s: float) -> tuple[float, float, float]:
        """Return the readout of the view's rows and columns, and of its centre, in seconds.

        The times of recorded rows and columns are fitted by an affine function of the view's u
        and v; of a lens without distortion, this is exact.

        Args:
            down_s: seconds from the top to the bottom of the recorded picture.
            across_s: seconds from its left to its right.
        """
        if self.is_recorded or (down_s == 0.0 and across_s == 0.0):
            return down_s, across_s, 0.0
        uv, is_inside = self._source
        size = np.array([self.lens.width_px, self.lens.height_px])
        recorded = (uv[is_inside] / size - 0.5) @ np.array([across_s, down_s])
        height, width = is_inside.shape
        own = self.camera.pixel_centres()[is_inside] / np.array([width, height]) - 0.5
        columns = np.column_stack([own, np.ones(len(own))])
        across, down, centre = np.linalg.lstsq(columns, recorded, rcond=None)[0].tolist()
        return down, across, centre

    def loader(
        self, load: Callable[[], UInt8[np.ndarray, "H W 3"]]
    ) -> Callable[[], UInt8[np.ndarray, "h w 3"]]:
        """Return a function that loads a recorded picture and resamples it."""
        return load if self.is_recorded else lambda: self.resampled(load())


def views_of(name: str, lens: Lens) -> tuple[View, ...]:
    """Return the pinhole views of a lens.

    A lens without distortion, or with a Brown distortion and less than 110 degrees, keeps its
    size and focal length. Others are divided into views of equal angle side by side, named
    `name`_left, `name`_right, and `name`_mid for three.
    """
    if lens.is_pinhole:
        return (_kept(name, lens),)
    left_deg, right_deg, up_deg, down_deg = _field_deg(lens)
    count = min(3, max(1, int(np.ceil((right_deg - left_deg) / _WIDEST_DEG))))
    if lens.model == "brown" and count == 1:
        return (_kept(name, lens),)
    edges = np.linspace(left_deg, right_deg, count + 1)
    return tuple(
        _turned(name + suffix, lens, (float(first), float(last)), (up_deg, down_deg))
        for suffix, first, last in zip(_VIEW_NAMES[count], edges[:-1], edges[1:], strict=True)
    )


def _kept(name: str, lens: Lens) -> View:
    size = (lens.width_px, lens.height_px)
    camera = PinholeCamera(name, *size, lens.fx, lens.fy, lens.cx, lens.cy)
    return View(camera, lens, np.eye(3))


def _turned(
    name: str, lens: Lens, across_deg: tuple[float, float], up_down_deg: tuple[float, float]
) -> View:
    """Return a view turned about the camera's y axis, between two azimuths (right is positive) and
    two elevations (down is positive)."""
    centre = np.radians(sum(across_deg) / 2)
    half = np.radians(across_deg[1] - across_deg[0]) / 2
    c, s = np.cos(centre), np.sin(centre)
    camera_from_view = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    focal_px = _focal_px(lens)
    top, bottom = (focal_px * np.tan(np.radians(deg)) for deg in up_down_deg)
    width, height = (max(1, round(size)) for size in (2 * focal_px * np.tan(half), bottom - top))
    camera = PinholeCamera(name, width, height, focal_px, focal_px, width / 2, float(-top))
    return View(camera, lens, camera_from_view)


def _focal_px(lens: Lens) -> float:
    """Return the pixels per radian in the centre of the picture, the mean of both axes."""
    small = 1e-3
    near = np.array([[0.0, 0.0, 1.0], [small, 0.0, 1.0], [0.0, small, 1.0]])
    uv, _ = lens.project(near)
    return float((np.linalg.norm(uv[1:] - uv[0], axis=1) / np.arctan(small)).mean())


def _field_deg(lens: Lens) -> tuple[float, float, float, float]:
    """Return the azimuths of the left and right edge and the elevations of the top and bottom edge
    of what a lens sees."""
    azimuth = np.arange(-180.0, 180.0, _STEP_DEG)
    elevation = np.arange(-_STEEPEST_DEG, _STEEPEST_DEG + _STEP_DEG / 2, _STEP_DEG)
    a, e = (np.radians(grid).ravel() for grid in np.meshgrid(azimuth, elevation))
    directions = np.stack([np.sin(a) * np.cos(e), np.sin(e), np.cos(a) * np.cos(e)], axis=1)
    _, is_inside = lens.project(directions)
    a_deg, e_deg = np.degrees(a[is_inside]), np.degrees(e[is_inside])
    if not len(a_deg):
        return -1.0, 1.0, -1.0, 1.0
    return float(a_deg.min()), float(a_deg.max()), float(e_deg.min()), float(e_deg.max())
