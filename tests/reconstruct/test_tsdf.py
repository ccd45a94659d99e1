"""Fusion against closed forms: a plane, a sphere, a parked and a moving box."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lightsim.core.actors import ActorKind, ActorTrack
from lightsim.core.fields import SceneFields
from lightsim.core.frames import Trajectory
from lightsim.core.log import DrivingLog
from lightsim.core.sensors import LazySweep, LidarSweep
from lightsim.errors import ArtefactError, InputError
from lightsim.geometry.mesh_scene import mesh_background
from lightsim.geometry.surface import extract_surface
from lightsim.progress import SilentProgress
from lightsim.reconstruct.fusion.ground import GroundBuilder
from lightsim.reconstruct.fusion.tsdf import FuseConfig, fuse_log
from lightsim.render.casters.embree import make_embree_caster

SPHERE = np.array([8.0, 4.0, 1.5])
RADIUS_M = 1.5
SENSOR_HEIGHT_M = 1.9
STEP_NS = 100_000_000
CONFIG = FuseConfig(
    voxel_m=(0.1, 0.3), radius_m=(14.0, 30.0), azimuth_step_deg=0.3, elevation_step_deg=0.2
)


def _directions() -> np.ndarray:
    """64 rings from -25 to 15 degrees, 0.4 degrees of azimuth."""
    elevation = np.radians(np.concatenate([np.linspace(-25, -6, 16), np.linspace(-5.5, 15, 48)]))
    azimuth = np.radians(np.arange(0, 360, 0.4))
    e, a = np.meshgrid(elevation, azimuth, indexing="ij")
    return np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], -1).reshape(-1, 3)


def _sphere_distance(origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
    b = directions @ (origin - SPHERE)
    under = b**2 - (np.sum((origin - SPHERE) ** 2) - RADIUS_M**2)
    return np.where(under > 0, -b - np.sqrt(np.maximum(under, 0)), np.inf)


def _box_distance(origin, directions, centre, half) -> np.ndarray:
    with np.errstate(divide="ignore", invalid="ignore"):
        near, far = (centre - half - origin) / directions, (centre + half - origin) / directions
    enter, leave = np.minimum(near, far).max(axis=1), np.maximum(near, far).min(axis=1)
    return np.where((enter < leave) & (enter > 0), enter, np.inf)


def _distance(origin: np.ndarray, directions: np.ndarray, boxes) -> np.ndarray:
    down = np.minimum(directions[:, 2], -1e-9)
    distance = np.where(directions[:, 2] < 0, -origin[2] / down, np.inf)
    distance = np.minimum(distance, _sphere_distance(origin, directions))
    for centre, size in boxes:
        distance = np.minimum(distance, _box_distance(origin, directions, centre, size / 2))
    return distance


def _track(actor_id: str, path: np.ndarray, times: np.ndarray, size: np.ndarray) -> ActorTrack:
    matrices = np.stack([np.eye(4)] * len(times))
    matrices[:, :3, 3] = path
    trajectory = Trajectory("world", "actor", times, matrices)
    return ActorTrack(
        actor_id, ActorKind.CAR, size, trajectory, bool(np.ptp(path, axis=0).max() > 1)
    )


@pytest.fixture(scope="module")
def log() -> DrivingLog:
    count = 6
    times = np.arange(count, dtype=np.int64) * STEP_NS
    ego = np.stack([np.eye(4)] * count)
    ego[:, 0, 3] = np.arange(count) * 1.2
    size = np.array([4.0, 1.8, 1.5])
    parked = np.tile([5.0, -5.0, 0.75], (count, 1))
    moving = np.array([14.0, 0.0, 0.75]) + np.arange(count)[:, None] * np.array([1.5, 0, 0])
    tracks = (_track("parked", parked, times, size), _track("moving", moving, times, size))
    rng = np.random.default_rng(0)
    sweeps = []
    for i in range(count):
        origin = np.array([1.2 * i, 0.0, SENSOR_HEIGHT_M])
        directions = _directions()
        distance = _distance(origin, directions, [(parked[i], size), (moving[i], size)])
        is_hit = distance < 40
        noisy = distance[is_hit] + rng.normal(0, 0.01, int(is_hit.sum()))
        points = (origin + directions[is_hit] * noisy[:, None]).astype(np.float32)
        n = len(points)
        sweep = LidarSweep(
            f"{i:02d}",
            int(times[i]),
            points,
            np.tile(origin, (n, 1)).astype(np.float32),
            np.full(n, 0.5, np.float32),
            np.zeros(n, np.float32),
            np.full(n, -1, np.int16),
            np.full(n, -1, np.int16),
        )
        sweeps.append(LazySweep(sweep.stem, sweep.time_ns, lambda sweep=sweep: sweep))
    trajectory = Trajectory("world", "ego", times, ego)
    return DrivingLog("closed form", {}, (), tuple(sweeps), trajectory, tracks, None, {})


@pytest.fixture(scope="module")
def fields(log: DrivingLog) -> SceneFields:
    return fuse_log(log, CONFIG, progress=SilentProgress())


def test_plane_and_sphere_lie_where_they_are(fields: SceneFields) -> None:
    mesh = extract_surface(fields.background[0], 0.03)
    near_sphere = np.linalg.norm(mesh.vertices - SPHERE, axis=1) < RADIUS_M + 0.25
    is_ground = ~near_sphere & (mesh.vertices[:, 2] < 0.3)
    towards = np.array([3.0, 0.0, SENSOR_HEIGHT_M]) - SPHERE
    facing = (mesh.vertices - SPHERE) @ towards / np.linalg.norm(towards) / RADIUS_M
    near_sphere &= facing > 0.35
    error = np.linalg.norm(mesh.vertices[near_sphere] - SPHERE, axis=1) - RADIUS_M
    error = error[mesh.vertices[near_sphere, 2] > 1.2]  # below, beams are a degree apart
    assert np.median(np.abs(error)) < 0.015
    assert np.percentile(np.abs(error), 95) < 0.06
    assert np.percentile(np.abs(mesh.vertices[is_ground, 2]), 95) < 0.02
    on_sphere = near_sphere & (mesh.vertices[:, 2] > 1.2)
    outward = (mesh.vertices[on_sphere] - SPHERE) / RADIUS_M
    assert np.median((mesh.vertex_normals()[on_sphere] * outward).sum(axis=1)) > 0.98


def test_f_score_of_the_visible_surface(fields: SceneFields) -> None:
    """Both ways at 5 cm: nothing invented, and every visible ground point near is covered."""
    mesh = extract_surface(fields.background[0], 0.03)
    v = mesh.vertices.astype(np.float64)
    truth = np.minimum(np.abs(v[:, 2]), np.abs(np.linalg.norm(v - SPHERE, axis=1) - RADIUS_M))
    precision = float((truth < 0.05).mean())
    x, y = np.meshgrid(np.arange(-8, 12, 0.23), np.arange(-2.2, 2.2, 0.23))
    top = np.stack([x, y, np.full_like(x, 0.5)], -1).reshape(-1, 3)
    top = top[np.abs(top[:, 0] - 2.8) > 7.0]
    hits = make_embree_caster([mesh]).intersect(top, np.tile([0.0, 0.0, -1.0], (len(top), 1)))
    recall = float((np.abs(hits.distance_m - 0.5) < 0.05).mean())
    assert precision > 0.97
    assert recall > 0.97


def test_actors_leave_the_background_and_get_their_own_grid(fields: SceneFields) -> None:
    mesh = extract_surface(fields.background[0], 0.03)
    for centre in ([5.0, -5.0, 0.75], [14.0, 0.0, 0.75], [20.0, 0.0, 0.75]):
        inside = np.abs(mesh.vertices - np.array(centre)) < np.array([2.2, 1.1, 0.55])
        assert not inside.all(axis=1).any()
    assert set(fields.actors) == {"parked", "moving"}
    car = extract_surface(fields.actors["moving"], 0.03)
    back = car.vertices[(car.vertices[:, 0] < -1.7) & (np.abs(car.vertices[:, 1]) < 0.7)]
    back = back[np.abs(back[:, 2]) < 0.5]
    assert abs(float(np.median(back[:, 0])) + 2.0) < 0.04


def test_no_triangle_where_no_ray_has_been(fields: SceneFields) -> None:
    """Behind the sphere, as seen from every pose, the ground stays open."""
    mesh = extract_surface(fields.background[0], 0.03)
    shadow = np.array([11.5, 6.6])
    assert np.linalg.norm(mesh.vertices[:, :2] - shadow, axis=1).min() > 0.4
    behind = (mesh.vertices - SPHERE) @ np.array([0.6, 0.8, 0.0])
    inside = np.linalg.norm(mesh.vertices - SPHERE, axis=1) < RADIUS_M - 0.2
    assert not (inside & (behind > 0)).any()


def test_ground_is_closed_in_blind_spots(fields: SceneFields) -> None:
    """Under the parked car, and in its shadow, straight down hits ground at z = 0."""
    mesh = mesh_background(fields, make_embree_caster)
    x, y = np.meshgrid(np.arange(-6, 12, 0.31), np.arange(-9, 3, 0.31))
    top = np.stack([x, y, np.full_like(x, 0.3)], -1).reshape(-1, 3)
    hits = make_embree_caster([mesh]).intersect(top, np.tile([0.0, 0.0, -1.0], (len(top), 1)))
    assert hits.is_hit.all()
    assert np.percentile(np.abs(hits.distance_m - 0.3), 98) < 0.05


@pytest.mark.slow
def test_a_ghost_is_carved_away(log: DrivingLog) -> None:
    """One sweep sees something that five others see through."""
    first = log.sweeps[0].load()
    half = first.points_world.copy()
    is_front = (np.abs(first.points_world[:, 1]) < 1.0) & (first.points_world[:, 0] > 6)
    rays = first.points_world[is_front] - first.origins_world[is_front]
    half[is_front] = first.origins_world[is_front] + 0.45 * rays
    ghost = replace(first, points_world=half)
    sweeps = (LazySweep(ghost.stem, ghost.time_ns, lambda: ghost), *log.sweeps[1:])
    mesh = extract_surface(
        fuse_log(replace(log, sweeps=sweeps), CONFIG, progress=SilentProgress()).background[0], 0.03
    )
    is_ghost = (np.abs(mesh.vertices[:, 1]) < 0.6) & (mesh.vertices[:, 2] > 0.4)
    is_ghost &= (mesh.vertices[:, 0] > 3) & (mesh.vertices[:, 0] < 12)
    assert int(is_ghost.sum()) < 20


def test_fields_survive_plain_arrays(fields: SceneFields) -> None:
    again = SceneFields.from_arrays(fields.to_arrays())
    for before, after in zip(fields.background, again.background, strict=True):
        np.testing.assert_array_equal(before.sdf_m, after.sdf_m)
        np.testing.assert_array_equal(before.block_coords, after.block_coords)
        assert before.voxel_m == after.voxel_m
    assert list(again.actors) == list(fields.actors)
    assert again.notes == fields.notes
    arrays = fields.to_arrays()
    del arrays["ground/height_m"]
    with pytest.raises(ArtefactError, match="incomplete"):
        SceneFields.from_arrays(arrays)


def test_a_log_without_sweeps_is_refused(log: DrivingLog) -> None:
    with pytest.raises(InputError, match="no LiDAR"):
        fuse_log(replace(log, sweeps=()), CONFIG, progress=SilentProgress())


def test_ground_map_ignores_walls_and_follows_slopes(rng: np.random.Generator) -> None:
    xy = rng.uniform(-15, 15, (40000, 2))
    z = 0.1 * xy[:, 0]
    is_hedge = np.abs(xy[:, 1] - 5) < 0.7
    z[is_hedge] += 1.2
    builder = GroundBuilder(np.zeros((1, 3)), 14.0, 0.5)
    builder.add(np.concatenate([xy, z[:, None]], axis=1))
    ground = builder.build()
    probe = np.array([[0.0, 0.0], [5.0, 5.0], [-8.0, -3.0], [3.2, 5.3]])
    np.testing.assert_allclose(ground.look_up(probe), 0.1 * probe[:, 0], atol=0.06)


def test_ground_behind_parked_cars_is_no_facade_and_no_mirror_image(
    rng: np.random.Generator,
) -> None:
    """Nothing returns from between the road, which climbs in rings, and a wall that is seen from
    1.5 m up; what a window mirrors lies 4 m below. Ground there once rose to the wall's returns."""
    x, y = rng.uniform(-20, 20, (2, 60000))
    is_ring = (x < 6) | (np.floor(x) % 4 == 0)
    road = np.stack([x, y, 0.15 * x], axis=1)[is_ring & (np.abs(y) < 3)]
    x = rng.uniform(-20, 20, 8000)
    wall = np.stack([x, rng.uniform(7.0, 7.2, 8000), 0.15 * x + rng.uniform(1.5, 6, 8000)], axis=1)
    few = np.stack([x, np.full(8000, -7.0), 0.15 * x + 0.9], axis=1)
    mirrored = np.stack([x[:400], rng.uniform(10, 11, 400), 0.15 * x[:400] - 4.0], axis=1)
    builder = GroundBuilder(np.linspace([-8, 0, 2], [4, 0, 2], 20), 16.0, 0.5)
    builder.add(np.concatenate([road, wall, few, mirrored]))
    ground = builder.build()
    probe = np.array([[0.0, 5.0], [-5.0, 7.1], [2.0, 10.5], [-3.0, -6.0], [16.5, 0.0]])
    np.testing.assert_allclose(ground.look_up(probe), 0.15 * probe[:, 0], atol=0.12)
    assert not ground.is_observed[:, np.abs(ground.origin_m[1] + 0.5 * np.arange(65)) > 4].any()


def test_ground_far_down_the_road_is_no_trunk(rng: np.random.Generator) -> None:
    """Rings of returns 10 m apart, and between them a trunk that beams meet from 0.4 m up: once it
    was ground, less than a tenth of its distance above the rings."""
    x, y = rng.uniform(-10, 42, 40000), rng.uniform(-3, 3, 40000)
    road = np.stack([x, y, 0 * x], axis=1)[(x < 12) | (np.floor(x) % 10 == 0)]
    trunk = np.array([35.5, 0.0, 0.4]) + rng.uniform(0, 1, (60, 3)) * [0.2, 0.2, 2.0]
    builder = GroundBuilder(np.linspace([-5, 0, 2], [5, 0, 2], 20), 42.0, 0.5)
    builder.add(np.concatenate([road, trunk]))
    probe = np.array([[35.5, 0.0], [36.5, 1.0], [25.0, 0.0]])
    np.testing.assert_allclose(builder.build().look_up(probe), 0.0, atol=0.01)
