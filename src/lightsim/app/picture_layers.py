"""Pictures as the viewer shows them: wipe, expected error, and padding for the 3D window."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, UInt8

from lightsim.core.camera import PinholeCamera
from lightsim.core.sensors import CameraFrame

# Expected error, as a fraction of the code range, that is shown in full colour. Chosen.
_FULL_ERROR = 0.15
# Colour of the largest error.
_ERROR_RGB = np.array([255, 40, 0], np.float32)
# Colour of the wipe's line.
_LINE_RGB = (255, 255, 255)
# Colour of the padding around a picture.
_PADDING_RGB = (24, 24, 24)
# Depth of pixels without a surface, in metres: the largest that viser transmits is 167.7 m.
FARTHEST_M = 160.0


@dataclass(frozen=True, eq=False)
class ShownPicture:
    """A picture of one frame.

    Args:
        recorded: under the source sky, with the edits.
        relit: under the target sky.
        is_final: made as the commands make it, not a preview.
        view: camera of the recording and its frame, which may be at another place by an edit.
        expected_error: of the relit codes, in [0, 1]; None without an estimate.
        depth_z_m: depth along the optical axis; None if it is unknown.
    """

    recorded: UInt8[np.ndarray, "h w 3"]
    relit: UInt8[np.ndarray, "h w 3"]
    is_final: bool
    view: tuple[PinholeCamera, CameraFrame]
    expected_error: Float32[np.ndarray, "h w"] | None = None
    depth_z_m: Float32[np.ndarray, "h w"] | None = None


def layered(
    shown: ShownPicture, wipe: float, *, is_error_shown: bool
) -> UInt8[np.ndarray, "h w 3"]:
    """Return the relit picture with the recorded one left of the wipe.

    Args:
        wipe: fraction of the width that shows the recorded picture; 0: none, without a line.
        is_error_shown: colour the relit pixels by their expected error.
    """
    image = shown.relit.copy()
    if is_error_shown and shown.expected_error is not None:
        weight = np.clip(shown.expected_error / _FULL_ERROR, 0.0, 1.0)[..., None]
        image = (image * (1 - weight) + _ERROR_RGB * weight).round().astype(np.uint8)
    column = round(wipe * image.shape[1])
    image[:, :column] = shown.recorded[:, :column]
    if 0 < column < image.shape[1]:
        image[:, column] = _LINE_RGB
    return image


@dataclass(frozen=True, eq=False)
class WindowPicture:
    """A picture that fills a window of another shape, for a camera without lens shift.

    Args:
        image: the picture with padding.
        depth_m: depth along the optical axis, at most `FARTHEST_M`; None if it is unknown.
        vertical_fov_rad: field of view of the whole.
    """

    image: UInt8[np.ndarray, "a b 3"]
    depth_m: Float32[np.ndarray, "a b"] | None
    vertical_fov_rad: float


def fitted(
    image: UInt8[np.ndarray, "h w 3"],
    depth_z_m: Float32[np.ndarray, "h w"] | None,
    camera: PinholeCamera,
    aspect: float,
) -> WindowPicture:
    """Pad a picture to a window, with the principal point in the middle.

    Args:
        image: may be smaller than the camera's picture.
        aspect: width over height of the window.
    """
    height, width = image.shape[:2]
    scale = width / camera.width_px
    fx, fy, cx, cy = (scale * value for value in (camera.fx, camera.fy, camera.cx, camera.cy))
    # Tangents of the angles to the farther borders.
    half_width = max(cx, width - cx) / fx
    half_height = max(cy, height - cy) / fy
    half_height = max(half_height, half_width / aspect)
    half_width = half_height * aspect
    rows, columns = round(2 * half_height * fy), round(2 * half_width * fx)
    # Padding follows the larger side of the principal point, so that corners are not negative.
    top, left = max(0, round(half_height * fy - cy)), max(0, round(half_width * fx - cx))
    rows, columns = max(rows, top + height), max(columns, left + width)
    padded = np.empty((rows, columns, 3), np.uint8)
    padded[:] = _PADDING_RGB
    padded[top : top + height, left : left + width] = image
    depth = None
    if depth_z_m is not None:
        depth = np.full((rows, columns), FARTHEST_M, np.float32)
        depth[top : top + height, left : left + width] = np.minimum(depth_z_m, FARTHEST_M)
    return WindowPicture(padded, depth, 2.0 * float(np.arctan(half_height)))
