"""What the sky mattes say, view by view."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float32, Int8

from lightsim.core.camera import PinholeCamera
from lightsim.core.sensors import CameraFrame
from lightsim.errors import InputError

# Views of a camera that moved less than this since its last used view are skipped by those who ask
# for walls and for the far field. Not measured alone.
MIN_BASELINE_M = 2.0

# A pixel of at least the first shows sky, of at most the second matter; between them wires, twigs
# and borders, which prove neither. Not measured alone.
SKY_ALPHA = 0.8
SOLID_ALPHA = 0.2

View = tuple[CameraFrame, PinholeCamera, Float32[np.ndarray, "h w"]]
ClassifiedView = tuple[CameraFrame, PinholeCamera, Int8[np.ndarray, "h w"]]
"""With what `classify_matte` makes of the matte."""


_FrameFirst = TypeVar("_FrameFirst", bound=tuple[Any, ...])


def spaced_views(views: Iterable[_FrameFirst], min_baseline_m: float) -> Iterator[_FrameFirst]:
    """Views, tuples that begin with a frame, without those whose camera moved less than this since
    its last used view."""
    last: dict[str, np.ndarray] = {}
    for view in views:
        frame: CameraFrame = view[0]
        position = frame.world_from_camera.translation_m
        before = last.get(frame.camera_name)
        if before is not None and np.linalg.norm(position - before) < min_baseline_m:
            continue
        last[frame.camera_name] = position
        yield view


def classified_views(views: Iterable[View]) -> Iterator[ClassifiedView]:
    """Views apart by `MIN_BASELINE_M`, classified.

    Raises:
        InputError: a matte does not fit its camera.
    """
    for frame, camera, matte in spaced_views(views, MIN_BASELINE_M):
        yield frame, camera, classify_matte(camera, matte)


def check_matte(camera: PinholeCamera, matte: Float32[np.ndarray, "h w"]) -> None:
    """Refuse a matte of another size than the camera's.

    Raises:
        InputError: they differ.
    """
    if matte.shape != (camera.height_px, camera.width_px):
        raise InputError(
            "the sky matte and the camera differ in size",
            where=f"camera '{camera.name}'",
            got=f"{matte.shape[1]}x{matte.shape[0]} px",
            expected=f"{camera.width_px}x{camera.height_px} px",
        )


def classify_matte(
    camera: PinholeCamera, matte: Float32[np.ndarray, "h w"]
) -> Int8[np.ndarray, "h w"]:
    """1 where a pixel and its neighbours are sky, -1 where it shows matter, 0 where it is mixed.

    Raises:
        InputError: matte and camera differ in size.
    """
    from scipy.ndimage import minimum_filter

    check_matte(camera, matte)
    kind = np.zeros(matte.shape, dtype=np.int8)
    kind[matte <= SOLID_ALPHA] = -1
    is_sky = np.asarray(minimum_filter(matte, 3)) >= SKY_ALPHA
    kind[is_sky] = 1
    return kind
