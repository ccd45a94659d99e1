"""Shadows that vote for the sun, and the posterior that joins all cues."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest
from tests.render.rendering_scenes import constant_sky, look_at
from tests.tiny_world import tiny_world

from lightsim.build.options import GpsUse
from lightsim.build.source_sun import SourceSunConfig, find_source_sun
from lightsim.core.equirect import pixel_directions
from lightsim.core.frames import RigidTransform
from lightsim.core.log import Clock, GeoReference, Place
from lightsim.core.mesh import Material, Provenance, TriMesh, concatenate_meshes
from lightsim.core.solar import SolarPosition, angle_between_deg, direction_enu, solar_position
from lightsim.core.twin import Panorama
from lightsim.lighting.directions import fibonacci_hemisphere, log_vmf
from lightsim.lighting.sample import SkyPrediction
from lightsim.lighting.sun.cues import (
    BlobCue,
    GradientCue,
    NetworkCue,
    OpenSkyCue,
    ShadowCue,
    ephemeris_cue,
)
from lightsim.lighting.sun.direction import SunBlob
from lightsim.lighting.sun.posterior import sun_direction, sun_posterior
from lightsim.lighting.sun.shadow_likelihood import (
    ShadowLikelihood,
    ShadowLikelihoodConfig,
    likelihood_of_suns,
)
from lightsim.lighting.sun.surface_samples import SampleConfig, sample_surfaces
from lightsim.progress import SilentProgress
from lightsim.render.casters.embree import make_embree_caster

CONFIG = ShadowLikelihoodConfig(
    samples=SampleConfig(point_count=1500, sky_rays=16), coarse_count=500, bootstraps=60
)
TIME_NS = int(datetime(2019, 5, 11, 1, 59, 16, tzinfo=UTC).timestamp()) * 10**9


def _plane(origin: np.ndarray, u: np.ndarray, v: np.ndarray, step_m: float = 0.5) -> TriMesh:
    """A rectangle origin + a u + b v of small triangles; its normal is u x v."""
    columns = max(1, round(float(np.linalg.norm(u)) / step_m))
    rows = max(1, round(float(np.linalg.norm(v)) / step_m))
    a, b = np.meshgrid(np.linspace(0, 1, columns + 1), np.linspace(0, 1, rows + 1))
    vertices = origin + a.reshape(-1, 1) * u + b.reshape(-1, 1) * v
    i, j = np.meshgrid(np.arange(columns), np.arange(rows))
    corner = (j * (columns + 1) + i).ravel()
    lower = np.stack([corner, corner + 1, corner + columns + 2], axis=1)
    upper = np.stack([corner, corner + columns + 2, corner + columns + 1], axis=1)
    faces = np.concatenate([lower, upper]).astype(np.int32)
    white = np.full((len(vertices), 3), 0.3, np.float32)
    return TriMesh("world", vertices.astype(np.float32), faces, white, (Material(),))


def _box(corner: np.ndarray, size: np.ndarray) -> list[TriMesh]:
    x, y, z = np.diag(size)
    return [
        _plane(corner, x, z),
        _plane(corner + x, y, z),
        _plane(corner + x + y, -x, z),
        _plane(corner + y, -y, z),
        _plane(corner + z, x, y, 2.0),
    ]


def _street(sun: np.ndarray, strength: float, seed: int) -> TriMesh:
    """A ground with boxes; base colour is the radiance under a sun of known strength over a sky
    of level irradiance 1; paint varies in patches."""
    rng = np.random.default_rng(seed)
    parts = [_plane(np.array([-20.0, -12.0, 0.0]), np.array([40.0, 0, 0]), np.array([0, 24.0, 0]))]
    for _ in range(9):
        corner = np.array([*rng.uniform([-18, -10], [14, 7]), 0.0])
        parts += _box(corner, rng.uniform([1, 1, 1.5], [4, 3, 6]))
    mesh = concatenate_meshes(parts)
    caster = make_embree_caster([mesh])
    normal = mesh.vertex_normals().astype(np.float64)
    start = mesh.vertices.astype(np.float64) + 0.02 * normal
    cosine = np.maximum(normal @ sun, 0.0)
    hidden = caster.is_occluded(start, np.broadcast_to(sun, start.shape).copy())
    open_fraction = 0.5 + 0.5 * normal[:, 2]
    light = strength * cosine * ~hidden + 0.35 + 0.65 * open_fraction
    patch = np.floor(mesh.vertices / 1.5).astype(np.int64) @ [7, 13, 29]
    paint = 0.2 * np.exp(rng.normal(0, 0.15, 1009))[patch % 1009]
    paint *= np.exp(rng.normal(0, 0.1, len(paint)))
    return replace(mesh, base_colour=np.tile((paint * light)[:, None], 3).astype(np.float32))


def _votes(sun: np.ndarray, strength: float, seed: int) -> ShadowLikelihood:
    mesh = _street(sun, strength, seed)
    rng = np.random.default_rng(seed)
    path = np.column_stack([np.linspace(-10, 10, 5), np.zeros(5), np.full(5, 1.8)])
    samples, caster = sample_surfaces(mesh, [], path, make_embree_caster, CONFIG.samples, rng)
    return likelihood_of_suns(samples, caster, CONFIG, rng)


def test_cast_shadows_find_the_sun_within_three_degrees():
    sun = direction_enu(230.0, 35.0)
    votes = _votes(sun, 4.0, 1)
    assert votes.sunny_probability > 0.99
    posterior = sun_posterior([ShadowCue(votes)], None)
    assert angle_between_deg(posterior.direction_world, sun) < 3.0
    assert posterior.sunny_probability > 0.95
    assert posterior.probability_within(sun) < 0.95


def test_without_a_sun_paint_alone_does_not_vote():
    votes = _votes(direction_enu(230.0, 35.0), 0.0, 2)
    assert votes.sunny_probability < 0.2
    posterior = sun_posterior([ShadowCue(votes)], None)
    assert posterior.sunny_probability < 0.2
    assert posterior.region_90_deg > 45.0


def test_without_surfaces_nothing_is_said():
    path = np.array([[500.0, 0.0, 0.0]])
    rng = np.random.default_rng(0)
    mesh = _street(direction_enu(230.0, 35.0), 4.0, 1)
    samples, caster = sample_surfaces(mesh, [], path, make_embree_caster, CONFIG.samples, rng)
    votes = likelihood_of_suns(samples, caster, CONFIG, rng)
    assert votes.sunny_probability == 0.5
    assert (votes.log_likelihood == 0).all()


def test_guessed_surfaces_are_not_asked_whatever_their_material_is_called():
    sun, path = direction_enu(230.0, 35.0), np.array([[0.0, 0.0, 1.8]])
    mesh = _street(sun, 4.0, 1)
    is_left = mesh.vertices[mesh.faces[:, 0], 0] < 0
    number = np.where(is_left, Provenance.INFERRED, Provenance.INTERPOLATED).astype(np.uint8)
    mesh = replace(mesh, face_provenance=number)

    def asked(name: str) -> np.ndarray:
        renamed = replace(mesh, materials=(Material(name=name),))
        rng = np.random.default_rng(0)
        return sample_surfaces(
            renamed, [], path, make_embree_caster, CONFIG.samples, rng
        )[0].position_world  # fmt: skip

    found = asked("inferred facade")
    assert len(found) > 500
    assert found[:, 0].min() > -2.01
    np.testing.assert_array_equal(found, asked("far field"))


def _geo(yaw_rad: float | None, heading_std_deg: float) -> GeoReference:
    turn = (
        None if yaw_rad is None else RigidTransform.from_yaw("enu", "world", yaw_rad, np.zeros(3))
    )
    origin = "unknown" if yaw_rad is None else "given"
    return GeoReference(Place(37.77, -122.42), Clock(), turn, origin, heading_std_deg)


def _position(geo: GeoReference) -> SolarPosition:
    position = geo.sun_at(TIME_NS)
    assert position is not None
    return position


def _blob(direction: np.ndarray) -> BlobCue:
    return BlobCue([SunBlob(direction, 1.5, False)])


def test_place_time_and_heading_give_the_ephemeris_with_the_headings_uncertainty():
    geo = _geo(0.4, 0.5)
    position = _position(geo)
    posterior = sun_posterior([ephemeris_cue(geo, position)], None)
    assert geo.enu_from_world is not None
    truth = geo.enu_from_world.inverse().rotate(
        direction_enu(position.azimuth_deg, position.elevation_deg)
    )
    assert angle_between_deg(posterior.direction_world, truth) < 0.05
    # One dimension alone is uncertain: 90 % lie within 1.64 standard deviations.
    assert posterior.region_90_deg == pytest.approx(1.645 * 0.5, rel=0.15)
    assert posterior.heading_correction_deg == pytest.approx(0.0, abs=0.05)


def test_a_wrong_heading_is_corrected_by_what_is_seen():
    geo = _geo(0.4, 5.0)
    position = _position(geo)
    true_turn = RigidTransform.from_yaw("enu", "world", 0.4 + np.radians(6.0), np.zeros(3))
    sun = true_turn.inverse().rotate(direction_enu(position.azimuth_deg, position.elevation_deg))
    cues = [ephemeris_cue(geo, position), _blob(sun)]
    posterior = sun_posterior(cues, None)
    assert angle_between_deg(posterior.direction_world, sun) < 0.5
    assert posterior.heading_correction_deg == pytest.approx(-6.0, abs=0.6)


def test_an_unknown_heading_is_estimated_from_place_time_and_the_spot():
    geo = _geo(None, 0.0)
    position = _position(geo)
    sun = direction_enu(40.0, position.elevation_deg)
    posterior = sun_posterior([ephemeris_cue(geo, position), _blob(sun)], None)
    assert angle_between_deg(posterior.direction_world, sun) < 0.3
    # World +x is turned so that the sun of azimuth 283 stands where 40 was seen.
    assert posterior.heading_deg == pytest.approx((90 + position.azimuth_deg - 40) % 360, abs=0.5)
    assert sun_direction(posterior, position).origin == "time+image"


def test_without_cues_the_hemisphere_stays_uniform():
    posterior = sun_posterior([], None)
    assert posterior.sunny_probability == pytest.approx(0.5)
    assert posterior.region_90_deg > 60.0
    assert posterior.mass.sum() == pytest.approx(1.0)


def test_seen_sky_without_a_spot_rules_a_clear_sun_out():
    is_sky = pixel_directions(64)[..., 0] > 0
    nothing = np.zeros((64, 128), bool)
    panorama = Panorama(np.full((64, 128, 3), 0.3, np.float32), is_sky, is_sky, nothing)
    posterior = sun_posterior([OpenSkyCue(panorama)], panorama)
    assert posterior.visible_probability < 0.05
    assert posterior.sunny_probability < 0.4
    clear = posterior.mass[:, 0] / posterior.mass[:, 0].sum()
    assert clear[posterior.grid_world[:, 0] < 0].sum() > 0.9


def test_the_network_counts_with_its_concentration():
    sun = direction_enu(120.0, 50.0)
    prediction = SkyPrediction(
        sun.astype(np.float32), 400.0, 4.0, 0.5, 0.9, np.zeros(64, np.float32)
    )
    posterior = sun_posterior([NetworkCue(prediction)], None)
    assert angle_between_deg(posterior.direction_world, sun) < 1.0
    assert 0.7 < posterior.sunny_probability < 0.9
    both = sun_posterior([NetworkCue(prediction), _blob(sun)], None)
    assert both.region_90_deg < posterior.region_90_deg


def test_grids_are_uniform_and_densities_integrate_to_one():
    grid = fibonacci_hemisphere(4000)
    np.testing.assert_allclose(grid.mean(axis=0), [0.0, 0.0, 0.5], atol=2e-3)
    density = np.exp(log_vmf(grid @ direction_enu(10.0, 60.0), 5.0))
    assert density.mean() * 2 * np.pi == pytest.approx(1.0, rel=1e-2)


def test_the_gradient_cue_knows_a_clear_sky():
    from lightsim.lighting.sky.clear_sky import clear_sky_parts

    sun = direction_enu(130.0, 35.0)
    radiance = 0.3 * clear_sky_parts(sun, 4.0, 0.2, 64)[0]
    seen = (pixel_directions(64)[..., 2] > 0) & (pixel_directions(64) @ sun < 0.9)
    panorama = Panorama(radiance, seen, seen, np.zeros_like(seen))
    posterior = sun_posterior([GradientCue(panorama)], panorama)
    assert angle_between_deg(posterior.direction_world, sun) < 15.0


@pytest.mark.parametrize(
    ("gps", "heading_error_deg", "within_deg"),
    [("all", 0.0, 0.3), ("place", 60.0, 3.0), ("none", 60.0, 3.0)],
)
def test_the_sun_of_a_log_is_found_from_what_it_may_use(
    gps: GpsUse, heading_error_deg: float, within_deg: float
) -> None:
    """Shadows and place under one sun; a wrong heading does no harm where it may not be used."""
    work = tiny_world(constant_sky(), look_at([0.0, 0.0, 1.8], [1.0, 0.0, 1.8]))
    position = solar_position(30.0, 180.0, work.log.frames[1].time_ns)
    sun = direction_enu(position.azimuth_deg, position.elevation_deg)
    turn = RigidTransform.from_yaw("enu", "world", np.radians(heading_error_deg), np.zeros(3))
    log = replace(work.log, geo=GeoReference(Place(30.0, 180.0), Clock(), turn, "given", 0.5))
    nothing = np.zeros((64, 128), bool)
    panorama = Panorama(np.zeros((64, 128, 3), np.float32), nothing, nothing, nothing)
    assets = replace(work.assets, background=_street(sun, 4.0, 1))
    work.__dict__.update(training_log=log, panorama=panorama, assets=assets)
    config = SourceSunConfig(votes=CONFIG, gps=gps)
    found, posterior = find_source_sun(work, config, seed=0, progress=SilentProgress())
    assert angle_between_deg(found.direction_world, sun) < within_deg
    assert posterior.sunny_probability > 0.95
    elevation_deg = np.degrees(np.arcsin(found.direction_world[2]))
    if gps != "none":
        assert elevation_deg == pytest.approx(position.elevation_deg, abs=0.5)
