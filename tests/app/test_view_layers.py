"""Pictures as the viewer shows them: wipe, expected error, padding for the 3D window."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lightsim.app.picture_layers import FARTHEST_M, ShownPicture, fitted, layered
from lightsim.core.camera import PinholeCamera
from lightsim.core.frames import RigidTransform
from lightsim.core.sensors import CameraFrame

HEIGHT, WIDTH = 40, 60
PADDING = 24


def shown(**values: object) -> ShownPicture:
    camera = PinholeCamera("front", WIDTH, HEIGHT, 50.0, 50.0, WIDTH / 2, HEIGHT / 2)
    pose = RigidTransform.from_rotation("world", "camera", np.eye(3), np.zeros(3))
    recorded = np.full((HEIGHT, WIDTH, 3), 10, np.uint8)
    relit = np.full((HEIGHT, WIDTH, 3), 200, np.uint8)
    frame = CameraFrame("front", "00", 0, pose, lambda: recorded)
    return replace(ShownPicture(recorded, relit, True, (camera, frame)), **values)


@pytest.mark.parametrize(("wipe", "column"), [(0.0, 0), (0.25, 15), (0.5, 30), (1.0, WIDTH)])
def test_the_recorded_picture_is_left_of_the_wipe(wipe: float, column: int) -> None:
    image = layered(shown(), wipe, is_error_shown=False)
    assert (image[:, :column] == 10).all()
    assert (image[:, column + 1 :] == 200).all()
    if 0 < column < WIDTH:
        assert (image[:, column] == 255).all()
    else:
        assert not (image == 255).any()


def test_the_expected_error_colours_the_relit_side_alone() -> None:
    error = np.zeros((HEIGHT, WIDTH), np.float32)
    error[:, WIDTH // 2 :] = 1.0
    picture = shown(expected_error=error)
    image = layered(picture, 0.25, is_error_shown=True)
    assert (image[:, :15] == 10).all()
    assert (image[:, 16:30] == 200).all()
    assert (image[:, 30:] == (255, 40, 0)).all()
    np.testing.assert_array_equal(layered(picture, 0.0, is_error_shown=False), picture.relit)
    # A preview has no estimate.
    np.testing.assert_array_equal(layered(shown(), 0.0, is_error_shown=True), picture.relit)


@pytest.mark.parametrize("aspect", [0.4, 1.0, 1.5, 3.0])
@pytest.mark.parametrize("principal_px", [(240.0, 160.0), (200.0, 190.0), (300.0, 100.0)])
@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_the_principal_point_is_in_the_middle_and_the_focal_length_is_kept(
    aspect: float, principal_px: tuple[float, float], scale: float
) -> None:
    cx, cy = principal_px
    camera = PinholeCamera("front", 480, 320, 400.0, 400.0, cx, cy)
    width, height = round(480 * scale), round(320 * scale)
    image = np.full((height, width, 3), 200, np.uint8)
    depth = np.full((height, width), 30.0, np.float32)
    depth[0, 0] = np.inf
    window = fitted(image, depth, camera, aspect)
    rows, columns = window.image.shape[:2]
    inside = (window.image == 200).all(axis=-1)
    assert inside.sum() == width * height  # nothing is cut off
    top, left = (int(np.flatnonzero(inside.any(axis=axis))[0]) for axis in (1, 0))
    assert left + scale * cx == pytest.approx(columns / 2, abs=1.0)
    assert top + scale * cy == pytest.approx(rows / 2, abs=1.0)
    focal_px = rows / 2 / np.tan(window.vertical_fov_rad / 2)
    assert focal_px == pytest.approx(scale * 400.0, rel=1.0 / rows)
    assert columns / rows == pytest.approx(aspect, rel=2.0 / min(rows, columns))
    assert (window.image[~inside] == PADDING).all()
    assert window.depth_m is not None
    assert window.depth_m[top, left] == np.float32(FARTHEST_M)
    assert window.depth_m[top + 1, left + 1] == 30.0
    assert (window.depth_m[~inside] == np.float32(FARTHEST_M)).all()
