"""The own-car search: finds a fixed bonnet, and nothing where everything wanders."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float32

from lightsim.core.camera import PinholeCamera
from lightsim.core.frames import RigidTransform
from lightsim.core.sensors import CameraFrame
from lightsim.masks.ego_vehicle import _small_grey, find_ego_vehicle, moves_as_road

H, W = 90, 160
CAMERA = PinholeCamera("left", W, H, 80.0, 80.0, W / 2, H / 2)
POSE_ASIDE = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]], dtype=float)
"""Looks along world +y, rows downwards."""


def pictures(rng: np.random.Generator, *, has_car: bool) -> Float32[np.ndarray, "n h w"]:
    """A textured scene that slides from picture to picture, with a bonnet before it."""
    wide = rng.uniform(60, 180, (H, W + 200)).astype(np.float32)
    images = np.stack([wide[:, 15 * i : 15 * i + W] for i in range(10)])
    images[:, : H // 3] = 200.0
    if has_car:
        images[:, bonnet()] = 40.0
    return images + rng.normal(0, 1, images.shape).astype(np.float32)


def bonnet() -> Bool[np.ndarray, "h w"]:
    row = 70 + 8 * (np.linspace(-1, 1, W) ** 2)
    return np.arange(H)[:, None] >= row[None, :]


def test_a_fixed_bonnet_is_covered_to_its_margin(rng: np.random.Generator) -> None:
    mask = find_ego_vehicle(pictures(rng, has_car=True))
    assert not (bonnet() & ~mask).any()
    assert (mask & ~bonnet()).sum() <= 2.5 * W


def test_a_wandering_scene_gives_no_mask(rng: np.random.Generator) -> None:
    assert not find_ego_vehicle(pictures(rng, has_car=False)).any()


def test_a_kerb_along_the_motion_is_no_ego_vehicle(rng: np.random.Generator) -> None:
    images = pictures(rng, has_car=False)
    images[:, 70:73] = 250.0
    assert not find_ego_vehicle(images).any()


def road_pictures(*, has_bonnet: bool) -> list[CameraFrame]:
    """A camera 1.6 m above plain road with dashes, looking aside, which drives 1 m a picture; where
    it has a bonnet, that is as plain but for a line."""
    frames = []
    for i in range(10):
        pose = RigidTransform("world", "camera", POSE_ASIDE.copy())
        pose.matrix[:3, 3] = i, 0.0, 1.6
        blank = CameraFrame("left", str(i), i, pose, lambda: np.zeros((H, W, 3), np.uint8))
        origins, rays = blank.pixel_rays(CAMERA, CAMERA.pixel_centres().reshape(-1, 2))
        reach_m = np.where(rays[:, 2] < -0.05, -1.6 / np.minimum(rays[:, 2], -0.05), np.inf)
        x, y = (origins[:, k] + rays[:, k] * np.minimum(reach_m, 1e3) for k in (0, 1))
        is_dash = (np.abs(y - 2.6) < 0.3) & (x % 4.0 < 1.0)
        grey = np.where(reach_m > 20.0, 200, np.where(is_dash, 120, 60)).reshape(H, W)
        if has_bonnet:
            grey[70:] = 60
            grey[80:82] = 90
        picture = np.repeat(grey[..., None], 3, axis=-1).astype(np.uint8)
        frames.append(replace(blank, load_srgb8=lambda picture=picture: picture))
    return frames


def test_plain_road_is_no_ego_vehicle() -> None:
    """Road in even shade passed for one on two of four streets, and was not relit."""
    mask = np.arange(H)[:, None] >= np.full(W, 70)
    assert moves_as_road(mask, CAMERA, road_pictures(has_bonnet=False))
    assert not moves_as_road(mask, CAMERA, road_pictures(has_bonnet=True))


def test_narrow_pictures_are_not_enlarged() -> None:
    """They grew to 480 columns, and in height as much: 2x12000 pixels to five gigabytes."""
    pose = RigidTransform("world", "camera", np.eye(4))
    tall = np.zeros((320, 40, 3), dtype=np.uint8)
    assert _small_grey(CameraFrame("a", "0", 0, pose, lambda: tall)).shape == (320, 40)
    wide = np.zeros((540, 960, 3), dtype=np.uint8)
    assert _small_grey(CameraFrame("a", "0", 0, pose, lambda: wide)).shape == (270, 480)
