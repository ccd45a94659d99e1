"""Logs at another image scale, for all later stages."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from jaxtyping import UInt8

from lightsim.core.camera import PinholeCamera
from lightsim.core.checks import check_image_scale
from lightsim.core.colour import linear_from_srgb8, srgb8_from_linear
from lightsim.core.log import DrivingLog
from lightsim.core.resample import resize_area
from lightsim.core.sensors import CameraFrame

Loader = Callable[[], UInt8[np.ndarray, "h w 3"]]


def at_scale(log: DrivingLog, image_scale: float) -> DrivingLog:
    """Resize cameras, images and masks of the ego vehicle by `image_scale`; images in linear light.

    Raises:
        InputError: the scale is not in [0.01, 1].
    """
    check_image_scale(image_scale)
    if image_scale == 1.0:
        return log
    # Cameras, pictures and masks use the same rounded size; poses do not change.
    cameras = {name: camera.scaled(image_scale) for name, camera in log.cameras.items()}
    frames = tuple(
        replace(frame, load_srgb8=_resized_loader(frame, cameras[frame.camera_name]))
        for frame in log.frames
    )
    # A pixel of which more than 1 % shows the ego vehicle is masked: its colour is contaminated.
    # Chosen; sensitivity not measured.
    masks = {
        name: resize_area(
            mask[..., None].astype(np.float32), cameras[name].height_px, cameras[name].width_px
        )[..., 0]
        > 0.01
        for name, mask in log.ego_vehicle_masks.items()
    }
    return replace(log, cameras=cameras, frames=frames, ego_vehicle_masks=masks)


def _resized_loader(frame: CameraFrame, camera: PinholeCamera) -> Loader:
    def load() -> UInt8[np.ndarray, "h w 3"]:
        # Light adds linearly: means of sRGB codes would darken edges.
        linear = linear_from_srgb8(frame.load_srgb8())
        return srgb8_from_linear(resize_area(linear, camera.height_px, camera.width_px))

    return load
