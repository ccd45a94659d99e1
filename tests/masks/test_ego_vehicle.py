"""The own-car search: finds a fixed bonnet, and nothing where everything wanders."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float32

from lightsim.core.frames import RigidTransform
from lightsim.core.sensors import CameraFrame
from lightsim.masks.ego_vehicle import _small_grey, find_ego_vehicle

H, W = 90, 160


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
    assert (mask & ~bonnet()).sum() <= 5 * W


def test_a_wandering_scene_gives_no_mask(rng: np.random.Generator) -> None:
    assert not find_ego_vehicle(pictures(rng, has_car=False)).any()


def test_a_kerb_along_the_motion_is_no_ego_vehicle(rng: np.random.Generator) -> None:
    images = pictures(rng, has_car=False)
    images[:, 70:73] = 250.0
    assert not find_ego_vehicle(images).any()


def test_narrow_pictures_are_not_enlarged() -> None:
    """They grew to 480 columns, and in height as much: 2x12000 pixels to five gigabytes."""
    pose = RigidTransform("world", "camera", np.eye(4))
    tall = np.zeros((320, 40, 3), dtype=np.uint8)
    assert _small_grey(CameraFrame("a", "0", 0, pose, lambda: tall)).shape == (320, 40)
    wide = np.zeros((540, 960, 3), dtype=np.uint8)
    assert _small_grey(CameraFrame("a", "0", 0, pose, lambda: wide)).shape == (270, 480)
