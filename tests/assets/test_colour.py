"""Gains, visibility, robust colours and the removal of light, on scenes with known answers."""

from __future__ import annotations

import numpy as np
import pytest

from lightsim.assets.build import AssetConfig
from lightsim.assets.colour import fill_unseen, mean_radiance, paint
from lightsim.assets.delight import DelightConfig, base_colour_from_radiance
from lightsim.assets.gains import solve_gains
from lightsim.assets.observe import Samples, collect_samples
from lightsim.assets.surface import make_mesh
from lightsim.core.actors import ActorTrack
from lightsim.core.camera import PinholeCamera
from lightsim.core.colour import srgb8_from_linear
from lightsim.core.frames import RigidTransform, Trajectory
from lightsim.core.log import DrivingLog
from lightsim.core.mesh import TriMesh
from lightsim.core.sensors import CameraFrame
from lightsim.errors import InputError
from lightsim.progress import SilentProgress
from lightsim.render.embree import make_embree_caster

GAINS = {"a": np.array([1.3, 1.0, 0.9]), "b": np.array([0.8, 0.7, 1.1]), "c": np.array([1, 1.2, 1])}
DOWN = np.diag([1.0, -1.0, -1.0])


def _plane(side_m: float, step_m: float, z: float = 0.0) -> TriMesh:
    n = round(side_m / step_m) + 1
    x, y = np.meshgrid(*[np.linspace(-side_m / 2, side_m / 2, n)] * 2, indexing="ij")
    index = np.arange(n * n).reshape(n, n)
    a, b, c, d = (
        index[:-1, :-1].ravel(),
        index[1:, :-1].ravel(),
        index[1:, 1:].ravel(),
        index[:-1, 1:].ravel(),
    )
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    points = np.stack([x.ravel(), y.ravel(), np.full(n * n, z)], axis=1)
    return make_mesh("world", points, faces)


def _pattern(xy: np.ndarray) -> np.ndarray:
    """A smooth radiance on the ground."""
    x, y = xy[..., 0], xy[..., 1]
    return np.stack([0.3 + 0.1 * np.sin(x), 0.35 + 0.1 * np.cos(y), 0.3 + 0.02 * x], axis=-1)


def _log(actors: tuple[ActorTrack, ...], occluder: np.ndarray | None) -> DrivingLog:
    """Three cameras with unequal gains look straight down from 5 m, shifted along x."""
    cameras, frames = {}, []
    for i, (name, gain) in enumerate(GAINS.items()):
        camera = PinholeCamera(name, 160, 160, 120.0, 120.0, 80.0, 80.0)
        centre = np.array([1.0 * i - 1.0, 0.0, 5.0])
        pose = RigidTransform.from_rotation("world", "camera", DOWN, centre)
        uv = camera.pixel_centres()
        ray = pose.rotate(camera.directions(uv))
        radiance = _pattern((centre + ray * (-5.0 / ray[..., 2:]))[..., :2])
        if occluder is not None:
            top = (centre + ray * (-4.0 / ray[..., 2:]))[..., :2]
            radiance[(np.abs(top - occluder) < 0.5).all(axis=-1)] = [0.8, 0.02, 0.02]
        image = srgb8_from_linear(radiance * gain)
        cameras[name] = camera
        frames.append(CameraFrame(name, "0", 0, pose, lambda image=image: image))
    ego = Trajectory("world", "ego", np.array([0], dtype=np.int64), np.eye(4)[None])
    return DrivingLog("toy", cameras, tuple(frames), (), ego, actors, None, {})


def _box_track() -> tuple[ActorTrack, TriMesh]:
    matrix = np.eye(4)
    matrix[2, 3] = 0.5
    pose = Trajectory("world", "actor", np.array([0], dtype=np.int64), matrix[None])
    track = ActorTrack("box", "car", np.array([1.0, 1.0, 1.0]), pose, True)
    lid = _plane(1.0, 0.25, 0.5)
    return track, make_mesh("actor", lid.vertices, lid.faces.astype(np.int64))


def _gain_array() -> np.ndarray:
    gains = np.array(list(GAINS.values()))
    return gains / np.exp(np.log(gains).mean(axis=0))


def test_gains_and_colours_come_back() -> None:
    """Known gains within 1 %, known radiance within 2 %, the moving box not on the ground."""
    track, lid = _box_track()
    log = _log((track,), np.zeros(2))
    plane = _plane(8.0, 0.2)
    config = AssetConfig(occlusion_tolerance_m=0.05)
    samples = collect_samples(
        log,
        plane,
        {"box": lid},
        config,
        make_caster=make_embree_caster,
        progress=SilentProgress(),
    )
    gains = solve_gains(samples.colours, samples.weights, samples.cameras, 3, 10.0)
    np.testing.assert_allclose(gains, _gain_array(), rtol=0.01)
    np.testing.assert_allclose(np.log(gains).mean(axis=0), 0, atol=1e-6)
    radiance, is_seen = mean_radiance(samples, gains, 1.4)
    ground, top = paint([plane, lid], radiance, is_seen)
    scale = np.exp(np.log(np.array(list(GAINS.values()))).mean(axis=0))
    expected = _pattern(plane.vertices[:, :2]) * scale
    inner = (np.abs(plane.vertices[:, :2]) < 3).all(axis=1)
    inner &= ~(np.abs(plane.vertices[:, :2]) < 1.4).all(axis=1)
    np.testing.assert_allclose(ground.base_colour[inner], expected[inner], rtol=0.03)
    middle = (np.abs(lid.vertices[:, :2]) < 0.3).all(axis=1)
    assert top.base_colour[middle, 0].min() > 4 * top.base_colour[middle, 1].max()
    hidden = (np.abs(plane.vertices[:, :2]) < 0.3).all(axis=1)
    assert not is_seen[: len(plane.vertices)][hidden].any()
    np.testing.assert_allclose(ground.base_colour[hidden], expected[hidden], rtol=0.2)


def test_cameras_without_overlap_keep_gain_one() -> None:
    colours = np.full((100, 2, 3), 0.3, dtype=np.float32)
    colours[50:] = 0.6
    cameras = np.zeros((100, 2), dtype=np.int16)
    cameras[50:] = 1
    gains = solve_gains(colours, np.ones((100, 2), np.float32), cameras, 2, 10.0)
    np.testing.assert_allclose(gains, 1.0, atol=1e-6)


def test_outliers_do_not_enter_the_mean() -> None:
    colours = np.full((1, 5, 3), 0.2, dtype=np.float32)
    colours[0, 4] = 0.9
    samples = Samples(colours, np.ones((1, 5), np.float32), np.zeros((1, 5), np.int16))
    radiance, is_seen = mean_radiance(samples, np.ones((1, 3), np.float32), 1.4)
    assert is_seen.all()
    np.testing.assert_allclose(radiance, 0.2, rtol=1e-5)


def test_unseen_vertices_take_the_colour_around_them() -> None:
    plane = _plane(4.0, 0.2)
    colour = (0.4 + 0.05 * plane.vertices[:, :1] * np.ones(3)).astype(np.float32)
    is_known = np.linalg.norm(plane.vertices, axis=1) > 0.7
    holed = np.where(is_known[:, None], colour, 0).astype(np.float32)
    filled = fill_unseen(plane, holed, is_known, np.zeros(3, np.float32))
    np.testing.assert_allclose(filled, colour, atol=0.02)
    usual = np.array([0.1, 0.2, 0.3], dtype=np.float32)
    nothing = fill_unseen(plane, holed, np.zeros(len(holed), dtype=bool), usual)
    np.testing.assert_array_equal(nothing, np.broadcast_to(usual, nothing.shape))


def test_baked_shadows_disappear() -> None:
    """A pole's shadow at a quarter of the light: albedo ratio 4 before, under 1.2 after, with
    the shadow edge two vertices off."""
    plane = _plane(10.0, 0.1)
    x, y = plane.vertices[:, 0], plane.vertices[:, 1]
    albedo = (0.3 + 0.1 * np.sin(3 * y))[:, None] * np.array([1.0, 0.9, 0.8])
    is_shadow = (np.abs(x) < 1.0) & (y > -2)
    believed = (np.abs(x - 0.2) < 1.0) & (y > -2)
    light = np.where(is_shadow, 0.25, 1.0)[:, None] * np.array([1.0, 1.0, 1.1])
    source = np.where(believed, 0.25, 1.0)[:, None] * np.array([1.0, 1.0, 1.1])
    baked = TriMesh("world", plane.vertices, plane.faces, (albedo * light).astype(np.float32))
    result = base_colour_from_radiance(baked, source.astype(np.float32), DelightConfig())
    inside, outside = (np.abs(x) < 1.0) & (y > -1.8), (np.abs(x) > 1.5) & (y > -1.8)
    truth = albedo[outside].mean() / albedo[inside].mean()
    before = baked.base_colour[outside].mean() / baked.base_colour[inside].mean()
    after = result.base_colour[outside].mean() / result.base_colour[inside].mean()
    assert before / truth > 3.8
    assert 1 / 1.2 < after / truth < 1.2
    wrong = np.abs(result.base_colour - albedo).max(axis=1) > 0.1
    assert float(wrong.mean()) < 0.01


def test_light_must_fit_the_mesh() -> None:
    plane = _plane(1.0, 0.5)
    with pytest.raises(InputError, match="every vertex"):
        base_colour_from_radiance(plane, np.ones((2, 3), np.float32), DelightConfig())
    dark = np.zeros((len(plane.vertices), 3), np.float32)
    result = base_colour_from_radiance(plane, dark, DelightConfig())
    assert np.isfinite(result.base_colour).all()
    assert result.base_colour.min() >= np.float32(0.02)
