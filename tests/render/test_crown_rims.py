"""Leaves that a twin's crown lacks, against the closed form of a disc before a wall."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float32
from scipy.ndimage import maximum_filter, minimum_filter

from lightsim.core.camera import PinholeCamera
from lightsim.core.colour import srgb8_from_linear
from lightsim.core.foliage import crown_beside, excess_green, leaves_before
from lightsim.core.frames import RigidTransform
from lightsim.core.sensors import CameraFrame
from lightsim.render.image_based import (
    RecordedView,
    ViewRays,
    blended,
    observed_rims,
    recorded_view,
)

CAMERA = PinholeCamera("front", 192, 128, 160.0, 160.0, 96.0, 64.0)
WALL_M, CROWN_M, TRUE_M, TWIN_M = 10.0, 6.0, 1.0, 0.6
WALL, LEAVES, GRASS = np.array([[0.4, 0.38, 0.36], [0.05, 0.12, 0.03], [0.2, 0.4, 0.1]])
# Camera axes (right, down, ahead) in frame world, which looks along x.
AXES = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def inside(y_m: float, radius_m: float) -> Bool[np.ndarray, "h w"]:
    """Pixels that show a disc of leaves of this radius."""
    d = CAMERA.directions(CAMERA.pixel_centres().reshape(-1, 2)) @ AXES.T
    at = CROWN_M / d[:, :1] * d + [0.0, y_m, 0.0]
    return (np.hypot(at[:, 1], at[:, 2]) < radius_m).reshape(CAMERA.height_px, CAMERA.width_px)


def painted(y_m: float) -> np.ndarray:
    """What a camera sees: the wall, a green sign on it far from the crown, and the true crown."""
    image = np.tile(WALL, (CAMERA.height_px, CAMERA.width_px, 1))
    image[:12, :12] = GRASS
    image[inside(y_m, TRUE_M)] = LEAVES
    return image


def frame_at(y_m: float) -> CameraFrame:
    pose = RigidTransform.from_rotation("world", "camera", AXES, np.array([0.0, y_m, 0.0]))
    return CameraFrame("front", "00", 0, pose, lambda: srgb8_from_linear(painted(y_m)))


def twin(y_m: float) -> tuple[Bool[np.ndarray, "h w"], Float32[np.ndarray, "h w"]]:
    """Where the twin, whose crown is smaller, shows leaves, and its distances."""
    d = CAMERA.directions(CAMERA.pixel_centres().reshape(-1, 2)) @ AXES.T
    is_leaf = inside(y_m, TWIN_M)
    depth = np.where(is_leaf, CROWN_M, WALL_M)
    along = np.linalg.norm(d, axis=1) / d[:, 0]
    return is_leaf, (depth * along.reshape(depth.shape)).astype(np.float32)


def picture(y_m: float) -> RecordedView:
    is_leaf, distance = twin(y_m)
    frame = frame_at(y_m)
    srgb8, crown_m = frame.load_srgb8(), crown_beside(is_leaf, distance, CAMERA.fx)
    leaves_m = leaves_before(srgb8, is_leaf, crown_m, CAMERA.fx, has_twigs=True)
    everywhere = np.ones(distance.shape, dtype=bool)
    gain = np.ones(3, np.float32)
    matte = np.zeros(distance.shape, np.float32)
    return recorded_view(frame, srgb8, CAMERA, gain, matte, distance, everywhere, leaves_m)


def test_greenness_is_free_of_exposure_and_white() -> None:
    image = np.tile(WALL, (20, 20, 1))
    image[:4, :4] = LEAVES
    green = excess_green(srgb8_from_linear(image))
    assert abs(np.median(green)) < 1e-6
    expected = np.log2(0.121) - 0.5 * (np.log2(0.051) + np.log2(0.031))
    usual = np.log2(0.381) - 0.5 * (np.log2(0.401) + np.log2(0.361))
    assert np.allclose(green[:4, :4], expected - usual, atol=0.1)


def test_leaves_of_a_picture_hang_together_with_the_crown() -> None:
    is_leaf, distance = twin(0.0)
    crown_m = crown_beside(is_leaf, distance, CAMERA.fx)
    assert not np.isfinite(crown_m[is_leaf]).any()
    leaves_m = leaves_before(
        frame_at(0.0).load_srgb8(), is_leaf, crown_m, CAMERA.fx, has_twigs=True
    )
    found, rim = np.isfinite(leaves_m), inside(0.0, TRUE_M) & ~is_leaf
    assert found[rim].all()
    # But for the pale edge, no wall; and no green sign far away.
    assert not (found & ~np.asarray(maximum_filter(inside(0.0, TRUE_M), 15), dtype=bool)).any()
    assert np.allclose(leaves_m[found], CROWN_M, rtol=0.02)
    nothing = np.zeros_like(is_leaf)
    assert np.isinf(crown_beside(nothing, distance, CAMERA.fx)).all()


def test_a_view_from_elsewhere_has_the_whole_crown_and_no_leaves_on_the_wall() -> None:
    pictures = [picture(-0.8), picture(0.8)]
    is_leaf, distance = twin(0.0)
    origins, directions = frame_at(0.0).pixel_rays(CAMERA, CAMERA.pixel_centres().reshape(-1, 2))
    rays = ViewRays("front", 0, CAMERA.fx, origins, directions, distance.reshape(-1))
    seen = blended(rays, ((p, rays.points_world) for p in pictures))
    crown_m = crown_beside(is_leaf, distance, CAMERA.fx).reshape(-1)
    beside = np.flatnonzero(np.isfinite(crown_m))
    past = ViewRays("front", 0, CAMERA.fx, origins, directions, crown_m).part(beside)
    leaves = observed_rims(past, ((p, past.points_world) for p in pictures))
    radiance, rows = seen.radiance.copy(), beside[leaves.is_observed]
    radiance[rows] = leaves.radiance[leaves.is_observed]
    is_known = seen.is_observed.copy()
    is_known[rows] = True
    truth, true_crown = painted(0.0).reshape(-1, 3), inside(0.0, TRUE_M)
    inner = np.asarray(minimum_filter(true_crown, 5), dtype=bool)
    is_edge = np.asarray(maximum_filter(true_crown, 15), dtype=bool) & ~inner
    is_plain = is_known & ~is_edge.reshape(-1)
    is_plain[: 24 * CAMERA.width_px] = False
    assert np.abs(radiance - truth)[is_plain].max() < 0.02
    assert is_known[inner.reshape(-1)].all()
    # The pictures alone, through the twin, paint leaves on the wall or show nothing there.
    assert not seen.is_observed[(inner & ~is_leaf).reshape(-1)].all()
