"""Geometry and sky scores of known errors."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from lightsim.build.quality.geometry import (
    GeometryConfig,
    GeometryReport,
    SeenSurface,
    evaluate_lidar,
    evaluate_surface,
)
from lightsim.core.casting import MISS, RayHits
from lightsim.core.dome import SkyDome, Sun, add_sun
from lightsim.core.mesh import TriMesh, concatenate_meshes
from lightsim.core.sensors import LazySweep, LidarSweep
from lightsim.core.solar import direction_enu
from lightsim.core.twin import SkyEstimate
from lightsim.errors import InputError
from lightsim_lab.metrics.sky import evaluate_sky, relative_rmse, sphere_radiance


def wall(x_m: float, half_m: float = 5.0) -> TriMesh:
    """A square facing -x."""
    corners = [[x_m, s * half_m, t * half_m] for s, t in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    return TriMesh(
        "world",
        np.array(corners, np.float32),
        np.array([[0, 2, 1], [0, 3, 2]], np.int32),
        np.full((4, 3), 0.5, np.float32),
    )


class WallCaster:
    """Intersects walls at their x by hand: the oracle needs no ray tracer."""

    def __init__(self, meshes: list[TriMesh]) -> None:
        self.meshes = meshes

    def intersect(self, origins_world: np.ndarray, directions_world: np.ndarray) -> RayHits:
        best = np.full(len(origins_world), np.inf, np.float32)
        for mesh in self.meshes:
            x, half = float(mesh.vertices[0, 0]), float(mesh.vertices[:, 1].max())
            distance = (x - origins_world[:, 0]) / directions_world[:, 0]
            hit = origins_world + distance[:, None] * directions_world
            is_hit = (distance > 0) & (np.abs(hit[:, 1:]) <= half).all(axis=1)
            best = np.where(is_hit & (distance < best), distance, best).astype(np.float32)
        face = np.where(np.isfinite(best), 0, MISS).astype(np.int32)
        return RayHits(best, face, face, np.zeros((len(best), 3), np.float32))

    def is_occluded(self, origins_world: np.ndarray, directions_world: np.ndarray) -> np.ndarray:
        return self.intersect(origins_world, directions_world).is_hit


def make_caster(meshes: object) -> WallCaster:
    return WallCaster(list(meshes))  # type: ignore[call-overload]


@pytest.fixture
def sweep(rng: np.random.Generator) -> LazySweep:
    """500 returns of a wall at x = 10 m, seen from the origin."""
    count = 500
    points = np.column_stack([np.full(count, 10.0), rng.uniform(-4, 4, (count, 2))])
    nothing = np.zeros(count, np.float32)
    sweep = LidarSweep(
        "00",
        0,
        points.astype(np.float32),
        np.zeros((count, 3), np.float32),
        nothing,
        nothing,
        np.zeros(count, np.int16),
        np.zeros(count, np.int16),
    )
    return LazySweep("00", 0, lambda: sweep)


def test_a_displaced_wall_has_its_displacement_as_error(
    sweep: LazySweep, rng: np.random.Generator
) -> None:
    scores = evaluate_lidar(
        [sweep],
        [wall(10.2)],
        lambda time_ns: [],
        make_caster=make_caster,
        rng=rng,
    )
    assert scores.hit_rate == 1.0
    assert 0.2 <= scores.median_abs_m < 0.23
    assert scores.median_signed_m == pytest.approx(scores.median_abs_m)
    assert scores.within_10_cm == 0.0


def test_the_nearer_of_actor_and_background_counts(
    sweep: LazySweep, rng: np.random.Generator
) -> None:
    scores = evaluate_lidar(
        [sweep],
        [wall(12.0)],
        lambda time_ns: [wall(10.0, half_m=20.0)],
        make_caster=make_caster,
        rng=rng,
    )
    assert scores.median_abs_m < 1e-5
    assert scores.within_10_cm == 1.0


def test_misses_lower_the_hit_rate(sweep: LazySweep, rng: np.random.Generator) -> None:
    scores = evaluate_lidar(
        [sweep], [wall(10.0, 2.0)], lambda time_ns: [], make_caster=make_caster, rng=rng,
    )  # fmt: skip
    assert scores.hit_rate == pytest.approx(0.25, abs=0.06)
    with pytest.raises(InputError, match="no LiDAR return"):
        evaluate_lidar([], [wall(10.0)], lambda time_ns: [], make_caster=make_caster, rng=rng)


def test_f_score_of_a_parallel_and_of_a_half_wall(rng: np.random.Generator) -> None:
    config = GeometryConfig(samples=4000, support_samples=4000)
    off = evaluate_surface(wall(10.07), wall(10.0), config, rng=rng)
    assert [row.f_score for row in off] == [0.0, 1.0]
    small = evaluate_surface(wall(10.0, 2.5), wall(10.0), config, rng=rng)[0]
    assert small.precision == 1.0
    assert small.recall == pytest.approx(0.255, abs=0.03)
    seen = np.array(
        [[10.0, y, z] for y in np.arange(-2, 2.1, 0.2) for z in np.arange(-2, 2.1, 0.2)]
    )
    sensor = SeenSurface(seen, np.zeros((1, 3)), make_caster)
    fair = evaluate_surface(wall(10.0, 2.5), wall(10.0), config, seen=sensor, rng=rng)
    assert fair[0].f_score > 0.99


def test_hidden_side_of_the_truth_is_not_asked_for(rng: np.random.Generator) -> None:
    """A wall 20 cm thick whose far side no beam can have met."""
    config = GeometryConfig(samples=4000, support_samples=4000)
    thick = concatenate_meshes([wall(10.0), wall(10.2)])
    seen = np.array([[10.0, y, z] for y in np.arange(-5, 5, 0.2) for z in np.arange(-5, 5, 0.2)])
    sensor = SeenSurface(seen, np.zeros((1, 3)), make_caster)
    assert evaluate_surface(wall(10.0), thick, config, seen=sensor, rng=rng)[0].recall > 0.99


def test_geometry_report_prints(sweep: LazySweep, rng: np.random.Generator) -> None:
    config = GeometryConfig(samples=100, support_samples=100)
    lidar = evaluate_lidar(
        [sweep], [wall(10.0)], lambda time_ns: [], make_caster=make_caster, rng=rng
    )
    report = GeometryReport(lidar, evaluate_surface(wall(10.0), wall(10.0), config, rng=rng))
    assert "| 0.05 | 1.000 | 1.000 | 1.000 |" in report.to_table()
    assert json.loads(report.to_json())["surface"][0]["f_score"] == 1.0


SUN = Sun(direction_enu(120.0, 40.0), np.array([5.0, 4.6, 4.0], np.float32))


def estimate(dome: SkyDome) -> SkyEstimate:
    return SkyEstimate(dome, 120.0, 40.0, "gps+time", 0.3, 0.2, np.ones(3, np.float32), 0.1, ())


def dome(sun: Sun = SUN, sky: float = 0.4) -> SkyDome:
    blue = np.array([0.6, 0.8, 1.0], np.float32) * np.float32(sky)
    return add_sun(np.broadcast_to(blue, (64, 128, 3)).astype(np.float32), sun)


def test_a_perfect_sky_has_no_error() -> None:
    report = evaluate_sky(estimate(dome()), truth=dome(), ephemeris_world=SUN.direction_world)
    assert report.sun_error_observed_deg is None
    values = [value for value in vars(report).values() if value is not None]
    np.testing.assert_allclose(values, 0.0, atol=1e-6)


def test_known_sky_errors_are_found() -> None:
    moved = Sun(direction_enu(120.0, 43.0), SUN.irradiance * np.float32(2))
    report = evaluate_sky(
        estimate(dome(moved, sky=0.2)), truth=dome(), ephemeris_world=SUN.direction_world
    )
    assert report.sun_error_ephemeris_deg == pytest.approx(3.0, abs=1e-6)
    assert report.sun_error_truth_deg == pytest.approx(3.0, abs=1e-6)
    assert report.sun_irradiance_error_ev == pytest.approx(1.0, abs=0.01)
    assert report.sky_irradiance_error_ev == pytest.approx(-1.0, abs=0.01)
    assert report.sky_colour_error_deg == pytest.approx(0.0, abs=0.1)
    assert "sun against truth" in report.to_table()
    assert json.loads(report.to_json())["sun_error_observed_deg"] is None


def test_scale_free_error_ignores_brightness_only() -> None:
    truth = sphere_radiance(dome())
    brighter = sphere_radiance(dome().scaled(np.array(1.7)))
    assert relative_rmse(brighter, truth) == pytest.approx(0.7, rel=1e-4)
    assert relative_rmse(brighter, truth, is_scale_free=True) < 1e-5
    turned = sphere_radiance(dome().rotated(90.0))
    assert relative_rmse(turned, truth, is_scale_free=True) > 0.3


def test_a_uniform_sky_gives_a_uniform_sphere() -> None:
    flat = SkyDome(np.ones((64, 128, 3), np.float32), None)
    np.testing.assert_allclose(sphere_radiance(flat), 1.0, rtol=2e-3)


def test_a_sky_needs_a_reference() -> None:
    with pytest.raises(InputError, match="no reference"):
        evaluate_sky(estimate(replace(dome(), sun=None)))
