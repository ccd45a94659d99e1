"""Rolling shutter: every row has its pose, and projecting undoes casting."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lightsim.core.camera import PinholeCamera
from lightsim.core.frames import RigidTransform
from lightsim.core.sensors import CameraFrame, RollingShutter

CAMERA = PinholeCamera("side", 96, 54, 47.0, 47.0, 48.3, 26.1)


def frame_at(shutter: RollingShutter | None) -> CameraFrame:
    pose = RigidTransform.from_quaternion(
        "world", "camera", np.array([0.4, -0.5, 0.6, -0.3]), np.array([3.0, -2.0, 1.5])
    )
    return CameraFrame("side", "00", 0, pose, lambda: np.zeros((54, 96, 3), np.uint8), shutter)


def shutter() -> RollingShutter:
    return RollingShutter(0.03, np.array([12.0, -3.0, 0.2]), np.array([0.1, -0.2, 0.6]))


def test_projecting_undoes_casting(rng: np.random.Generator) -> None:
    frame = frame_at(shutter())
    uv = rng.uniform([0, 0], [96, 54], (500, 2))
    origins, directions = frame.pixel_rays(CAMERA, uv)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0, atol=1e-12)
    found, inside = frame.project(CAMERA, origins + rng.uniform(4, 80, (500, 1)) * directions)
    assert inside.all()
    np.testing.assert_allclose(found, uv, atol=2e-3)


def test_the_middle_row_keeps_the_pose_of_the_frame() -> None:
    row = np.array([[10.0, 27.0], [80.0, 27.0]])
    still, rolling = frame_at(None), frame_at(shutter())
    for expected, found in zip(
        still.pixel_rays(CAMERA, row), rolling.pixel_rays(CAMERA, row), strict=True
    ):
        np.testing.assert_allclose(found, expected, atol=1e-12)


def test_rows_see_the_camera_move() -> None:
    motion = shutter()
    top = frame_at(motion).pixel_rays(CAMERA, np.array([[48.0, 0.0]]))
    low = frame_at(motion).pixel_rays(CAMERA, np.array([[48.0, 54.0]]))
    np.testing.assert_allclose(low[0] - top[0], [[0.36, -0.09, 0.006]], atol=1e-12)
    later = replace(
        frame_at(None),
        world_from_camera=RigidTransform.from_rotation(
            "world",
            "camera",
            motion.rotated(frame_at(None).world_from_camera.rotation.T, np.full(3, 0.015)).T,
            frame_at(None).world_from_camera.translation_m + 0.015 * motion.velocity_m_s,
        ),
    )
    expected = later.pixel_rays(CAMERA, np.array([[48.0, 54.0]]))
    np.testing.assert_allclose(low, expected, atol=1e-12)


def test_points_behind_stay_behind() -> None:
    frame = frame_at(shutter())
    behind = frame.world_from_camera.apply(np.array([[0.0, 0.0, -5.0]]))
    uv, inside = frame.project(CAMERA, behind)
    assert np.isnan(uv).all()
    assert not inside.any()
