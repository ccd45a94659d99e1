"""Sky mattes: truth on drawn streets, nothing where no sky is, known places in a real log."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from lightsim.core.camera import PinholeCamera
from lightsim.core.frames import RigidTransform
from lightsim.errors import InputError
from lightsim.masks.sky import _before_colours, _gather, _segment, estimate_sky_matte
from lightsim.masks.sky_regions import ColourCounts, colour_bins

CAMERA = PinholeCamera("front", 480, 270, 240.0, 240.0, 240.0, 135.0)
# Looks along world +y from 1.6 m: camera x is world x, camera y is world -z.
POSE = RigidTransform.from_rotation(
    "world",
    "camera",
    np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
    np.array([0.0, 0.0, 1.6]),
)
NO_POINTS = np.zeros((0, 3), np.float32)


def wall_returns(x_m: np.ndarray, distance_m: float) -> np.ndarray:
    """Returns of a 10-beam LiDAR (up to 15 degrees) on a wall across the view."""
    tangents = np.tan(np.radians([-10, -6, -3, -1, 0, 2, 3, 5, 8, 11, 15]))
    x, tangent = np.meshgrid(x_m, tangents)
    z = 1.6 + tangent * distance_m
    points = np.stack([x, np.full_like(x, distance_m), z], axis=-1).reshape(-1, 3)
    return points[points[:, 2] > 0].astype(np.float32)


def draw_street(rng: np.random.Generator, sky: str) -> tuple[np.ndarray, np.ndarray]:
    """A textured wall left of the centre up to row 30, road below; returns image and truth."""
    image = np.full((270, 480, 3), 70.0)
    rows = np.arange(270)[:, None, None]
    colours = {
        "blue": np.array([90.0, 140.0, 210.0]) + 40 * rows / 135 * np.array([1.0, 0.7, 0.3]),
        "grey": np.array([150.0, 155.0, 160.0]) + 30 * rows / 135,
        "clipped": np.full((270, 1, 3), 255.0),
    }
    is_sky = np.zeros((270, 480), bool)
    is_sky[:130] = True
    is_sky[30:, :200] = False
    image = np.where(is_sky[..., None], colours[sky], image)
    wall = ~is_sky & (np.arange(270) < 160)[:, None]
    image[wall] = [150.0, 120.0, 95.0]
    image[40:150:22, :200:3] = 60.0
    noisy = image + rng.normal(0.0, 2.0, image.shape)
    return np.clip(np.round(noisy), 0, 255).astype(np.uint8), is_sky


@pytest.mark.parametrize("sky", ["blue", "grey", "clipped"])
def test_sky_above_a_street(rng: np.random.Generator, sky: str) -> None:
    image, is_sky = draw_street(rng, sky)
    points = wall_returns(np.linspace(-20, -3.4, 200), 20.0)
    matte = estimate_sky_matte(image, CAMERA, POSE, points, None).expected
    assert matte.dtype == np.float32
    assert matte.min() >= 0.0
    assert matte.max() <= 1.0
    is_found = matte > 0.5
    assert (is_found & is_sky).sum() / (is_found | is_sky).sum() > 0.98


def test_a_pale_gable_is_no_cloud_where_the_log_has_none(rng: np.random.Generator) -> None:
    """High in a corner, behind the wall's roof, where no beam reaches: one picture cannot tell.
    A wall of its colour stands in the street."""
    image, is_sky = draw_street(rng, "blue")
    pale = [205, 190, 180]
    image[170:] = 140
    image[90:155, 20:180] = np.clip(pale + rng.normal(0, 5.0, (65, 160, 3)), 0, 255)
    points = wall_returns(np.linspace(-20, -3.4, 200), 20.0)
    evidence = _gather(image, CAMERA, POSE, points, None)
    labels = _segment(evidence.lab)
    _, _, first = _before_colours(evidence, labels)
    colours = ColourCounts.of(evidence, first[labels] > 3.5, evidence.has_hit)
    with_gable, _ = draw_street(rng, "blue")
    with_gable[170:] = 140
    with_gable[:30, 60:150] = np.clip(pale + rng.normal(0, 5.0, (30, 90, 3)), 0, 255)
    matte = estimate_sky_matte(with_gable, CAMERA, POSE, points, None, colours).expected
    assert (matte[2:27, 64:146] < 0.5).mean() > 0.9
    clear = is_sky.copy()
    clear[:34, 56:154] = False
    assert (matte[clear] > 0.5).mean() > 0.98
    alone = estimate_sky_matte(with_gable, CAMERA, POSE, points, None).expected
    assert alone[2:27, 64:146].mean() > 0.5


def test_colours_of_clouds_are_not_learnt_as_those_of_walls(rng: np.random.Generator) -> None:
    """A cloud that a picture takes for a wall speaks for no wall: no beam returned from it."""
    image, _ = draw_street(rng, "blue")
    image[90:155, 20:180] = 140
    image[20:60, 200:300] = 250
    points = wall_returns(np.linspace(-20, -3.4, 200), 20.0)
    evidence = _gather(image, CAMERA, POSE, points, None)
    labels = _segment(evidence.lab)
    _, _, first = _before_colours(evidence, labels)
    colours = ColourCounts.of(evidence, first[labels] > 3.5, evidence.has_hit)
    is_cloud = (evidence.lab[..., 0] > 95) & (evidence.elevation_deg > 5)
    assert is_cloud.sum() > 500
    assert (colours.log_ratio()[colour_bins(evidence.lab)][is_cloud] > -0.5).all()


def test_a_plain_white_wall_is_not_sky(rng: np.random.Generator) -> None:
    image = np.full((270, 480, 3), 235.0) + rng.normal(0, 1.5, (270, 480, 3))
    image[175:] = 60.0
    points = wall_returns(np.linspace(-10, 10, 400), 8.0)
    image = np.clip(image, 0, 255).astype(np.uint8)
    matte = estimate_sky_matte(image, CAMERA, POSE, points, None).expected
    assert not matte.any()


def test_nothing_below_the_horizon_or_on_the_ego_vehicle(rng: np.random.Generator) -> None:
    image, _ = draw_street(rng, "blue")
    own = np.zeros((270, 480), bool)
    own[:60, 300:] = True
    matte = estimate_sky_matte(image, CAMERA, POSE, NO_POINTS, own).expected
    assert not matte[136:].any()
    assert not matte[:58, 302:].any()
    assert matte[60:120, 250:280].min() > 0.8
    down = RigidTransform.from_rotation("world", "camera", np.diag([1.0, -1.0, -1.0]), np.zeros(3))
    matte = estimate_sky_matte(image, CAMERA, down, NO_POINTS, None).expected
    assert not matte.any()


def test_a_wire_takes_its_fraction_of_the_sky(rng: np.random.Generator) -> None:
    image, is_sky = draw_street(rng, "grey")
    image[60, 250:] = 40
    points = wall_returns(np.linspace(-20, -3.4, 200), 20.0)
    matte = estimate_sky_matte(image, CAMERA, POSE, points, None).expected
    assert matte[60, 260:470].max() < 0.3
    assert matte[55, 260:470].min() > 0.8
    assert is_sky[60, 300]


def test_an_even_sky_is_all_sky() -> None:
    """One region has no neighbour."""
    even = np.full((CAMERA.height_px, CAMERA.width_px, 3), (120, 160, 230), np.uint8)
    up = RigidTransform.from_rotation("world", "camera", np.diag([1.0, 1.0, 1.0]), np.zeros(3))
    assert (estimate_sky_matte(even, CAMERA, up, NO_POINTS, None).expected > 0.9).all()


def test_an_image_of_another_size_is_refused() -> None:
    with pytest.raises(InputError, match="differ in size"):
        estimate_sky_matte(np.zeros((10, 10, 3), np.uint8), CAMERA, POSE, NO_POINTS, None)


def pandaset_view(
    root: Path, name: str, index: int
) -> tuple[np.ndarray, PinholeCamera, RigidTransform]:
    from PIL import Image

    folder = root / "pandaset" / "002" / "camera" / name
    pose = json.loads((folder / "poses.json").read_text())[index]
    intrinsics = json.loads((folder / "intrinsics.json").read_text())
    camera = PinholeCamera(
        name,
        1920,
        1080,
        intrinsics["fx"],
        intrinsics["fy"],
        intrinsics["cx"] + 0.5,
        intrinsics["cy"] + 0.5,
    ).scaled(0.5)
    image = Image.open(folder / f"{index:02d}.jpg").resize((960, 540), Image.Resampling.BOX)
    world_from_camera = RigidTransform.from_quaternion(
        "world",
        "camera",
        np.array([pose["heading"][k] for k in "wxyz"]),
        np.array([pose["position"][k] for k in "xyz"]),
    )
    return np.asarray(image), camera, world_from_camera


def test_known_places_of_a_real_log(shared_data: Path) -> None:
    """Boxes (row, column) at 960x540 that are sky, and that are not, by eye."""
    import pandas as pd

    sweep = pd.DataFrame(pd.read_pickle(shared_data / "pandaset" / "002" / "lidar" / "60.pkl.gz"))
    points = sweep.loc[:, ["x", "y", "z"]].to_numpy(np.float32)
    sky = {"left_camera": (10, 120, 20, 500), "front_left_camera": (10, 120, 20, 800)}
    wall = {"right_camera": (60, 540, 0, 880), "front_right_camera": (110, 540, 300, 960)}
    for name, (top, bottom, left, right) in (sky | wall).items():
        image, camera, pose = pandaset_view(shared_data, name, 60)
        matte = estimate_sky_matte(image, camera, pose, points, None).expected
        box = matte[top:bottom, left:right]
        if name in sky:
            assert np.mean(box > 0.9) > 0.97, name
        else:
            assert np.mean(box > 0.1) < 0.01, name
        assert not matte[400:].any(), name
