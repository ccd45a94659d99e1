"""A log at another image scale: pictures, cameras and masks have one size."""

from __future__ import annotations

import math

import numpy as np
import pytest

from lightsim.core.camera import PinholeCamera
from lightsim.core.frames import RigidTransform, Trajectory
from lightsim.core.log import DrivingLog
from lightsim.core.sensors import CameraFrame
from lightsim.datasets.scale import at_scale
from lightsim.errors import InputError


def _log(width_px: int, height_px: int) -> DrivingLog:
    camera = PinholeCamera("front", width_px, height_px, 60.0, 60.0, width_px / 2, height_px / 2)
    picture = np.full((height_px, width_px, 3), 200, dtype=np.uint8)
    pose = RigidTransform.identity("world", "camera")
    frame = CameraFrame("front", "00", 0, pose, lambda: picture)
    ego = Trajectory("world", "ego", np.array([0], dtype=np.int64), np.eye(4)[None])
    masks = {"front": np.ones((height_px, width_px), dtype=bool)}
    return DrivingLog("log", {"front": camera}, (frame,), (), ego, (), None, masks)


@pytest.mark.parametrize("size", [(192, 108), (64, 36), (97, 61)])
def test_pictures_have_the_cameras_size_at_every_scale(size: tuple[int, int]) -> None:
    log = _log(*size)
    for percent in range(1, 101):
        small = at_scale(log, percent / 100)
        camera = small.cameras["front"]
        shape = (camera.height_px, camera.width_px)
        picture = small.frames[0].load_srgb8()
        assert picture.shape[:2] == shape, percent
        assert (picture == 200).all()
        assert small.ego_vehicle_masks["front"].shape == shape
        # The camera's angles stay: its picture only has fewer pixels.
        assert camera.fx / camera.width_px == pytest.approx(60.0 / size[0])
        assert camera.fy / camera.height_px == pytest.approx(60.0 / size[1])


def test_a_full_size_picture_at_a_quarter() -> None:
    assert at_scale(_log(1920, 1080), 0.27).frames[0].load_srgb8().shape == (292, 518, 3)


@pytest.mark.parametrize("scale", [0.0, -0.5, 1.01, 2.0, math.nan, math.inf, -math.inf])
def test_a_scale_that_is_none_is_refused(scale: float) -> None:
    with pytest.raises(InputError, match=r"--image-scale: .*expected a number from 0\.01 to 1"):
        at_scale(_log(8, 8), scale)
