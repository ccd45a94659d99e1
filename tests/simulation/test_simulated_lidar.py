"""LiDAR sweeps of edited scenes against closed forms: a sensor over level ground, and a box."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.render.rendering_scenes import box, plane

from lightsim.core.actors import ActorKind, ActorTrack
from lightsim.core.alignment import PathCorrection
from lightsim.core.frames import Trajectory
from lightsim.core.scenario import ActorPlacement, Scenario
from lightsim.core.sensors import LidarSweep
from lightsim.core.twin import ActorAsset
from lightsim.export.pandaset.sweeps import written
from lightsim.lidar.beams import Beams, in_ego, returned_beams, unreturned_beams
from lightsim.lidar.ray_scene import Surfaces
from lightsim.lidar.recorded import RecordedSweep, _noise_m
from lightsim.lidar.resimulate import Change, LidarSimulator, SimulatedBeams
from lightsim.lidar.response import BeamResponses, Donors, Response, looks_of
from lightsim.lidar.scan_pattern import (
    ScanDirections,
    find_rings,
    missing_in_raster,
    missing_in_rings,
)
from lightsim.render.casters.embree import make_embree_caster

END_NS = 1_600_000_000_000_000_000
HEIGHT_M = 2.0
SIZE = np.array([4.0, 2.0, 1.5])
RINGS_DEG = np.arange(-24.0, 8.0, 2.0)
COLUMNS = 360
EGO = Trajectory("world", "ego", np.array([END_NS - 10**9, END_NS]), np.tile(np.eye(4), (2, 1, 1)))


def turning_beams() -> Beams:
    """All beams of one turn, clockwise from behind; none has come back yet."""
    azimuth = np.pi - (np.arange(COLUMNS) + 0.5) / COLUMNS * 2 * np.pi
    elevation, azimuth = (a.ravel() for a in np.meshgrid(np.radians(RINGS_DEG), azimuth))
    ago_s = 0.1 * (azimuth + np.pi) / (2 * np.pi)
    directions = ScanDirections(azimuth, elevation, END_NS - (ago_s * 1e9).astype(np.int64))
    count = len(azimuth)
    return Beams(
        np.tile([0.0, 0.0, HEIGHT_M], (count, 1)),
        directions.vectors,
        directions.times_ns,
        np.zeros(count, dtype=np.int64),
        np.full(count, np.inf),
        np.full(count, -1),
    )


def returned(beams: Beams, range_m: np.ndarray) -> Beams:
    """The same where a beam comes back whose range is finite: those first, as sweeps have them."""
    is_back = np.isfinite(range_m)
    hit, lost = beams.chosen(is_back), beams.chosen(~is_back)
    hit = replace(hit, range_m=range_m[is_back], row=np.arange(is_back.sum()))
    return Beams.joined([hit, lost])


def to_ground(beams: Beams) -> np.ndarray:
    down = -beams.directions_world[:, 2]
    return np.where(down > 0.01, HEIGHT_M / np.maximum(down, 0.01), np.inf)


def to_box(beams: Beams, centre: np.ndarray) -> np.ndarray:
    """By slabs; a centre for each beam."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = [
            (centre + side * SIZE / 2 - beams.origins_world) / beams.directions_world
            for side in (-1.0, 1.0)
        ]
    enter, leave = np.minimum(*ends).max(axis=1), np.maximum(*ends).min(axis=1)
    return np.where(leave > np.maximum(enter, 0.0), enter, np.inf)


def placement(actor_id: str, centre: np.ndarray, speed_m_s: float = 0.0) -> ActorPlacement:
    """A box that drives along world x and is at `centre` at the sweep's end."""
    times_ns = END_NS + np.array([-(10**9), 10**9])
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[:, :3, 3] = centre + np.array([[-1.0], [1.0]]) * [speed_m_s, 0.0, 0.0]
    path = Trajectory("world", "actor", times_ns, poses)
    track = ActorTrack(actor_id, ActorKind.CAR, SIZE, path, speed_m_s != 0)
    mesh = replace(box((0, 0, 0), SIZE), frame="actor")
    return ActorPlacement(ActorAsset(actor_id, ActorKind.CAR, mesh), track)


def always_answers(beams: Beams) -> Response:
    """A LiDAR that gets everything back with intensity 40, exactly."""
    found = Surfaces.nothing(len(beams))
    found.distance_m[:] = np.where(np.isfinite(to_ground(beams)), to_ground(beams), 50.0)
    responses = BeamResponses.nothing(len(beams))
    responses.is_returned[:], responses.intensity[:] = True, 40.0
    far = np.full((len(beams), 3), 1e6, np.float32)
    return Response({(0, ""): Donors(far, looks_of(beams, found), responses)}, {}, {})


def simulator(beams: Beams) -> LidarSimulator:
    ground = make_embree_caster([plane(200.0)])
    return LidarSimulator(ground, always_answers(beams), {"Car": 13}, make_embree_caster)


def scenario(*placements: ActorPlacement) -> Scenario:
    return Scenario("made", (), placements, ego=EGO)


def simulated(beams: Beams, before: Scenario, after: Scenario) -> SimulatedBeams:
    change = Change.between(before, after).at(END_NS)
    return simulator(beams).edited(beams, change, END_NS, np.random.default_rng(0))


@pytest.mark.parametrize(("ahead_m", "speed_m_s"), [(8.0, 0.0), (8.0, 20.0), (-8.0, -45.0)])
def test_an_inserted_box_is_met_and_shades_what_lies_behind(
    ahead_m: float, speed_m_s: float
) -> None:
    """A moving box is met where it is when each beam looks that way. In front of the sky it is
    met by beams that did not come back before."""
    centre = np.array([ahead_m, 3.0, 1.8])
    beams = returned(turning_beams(), to_ground(turning_beams()))
    mine = placement("mine", centre, speed_m_s)
    result = simulated(beams, scenario(), replace(scenario(mine), ego=EGO))
    ago_s = (END_NS - beams.times_ns) * 1e-9
    there = to_box(beams, centre - ago_s[:, None] * [speed_m_s, 0.0, 0.0])
    is_met = there < beams.range_m
    assert 100 < is_met.sum() < len(beams) / 4
    assert (is_met & ~beams.is_returned).any()
    np.testing.assert_allclose(result.range_m[is_met], there[is_met], atol=2e-5)
    np.testing.assert_array_equal(result.is_kept, beams.is_returned & ~is_met)
    np.testing.assert_array_equal(result.responses.is_returned, is_met)
    assert (result.responses.semantic_class[is_met] == 13).all()
    assert (result.responses.intensity[is_met] == 40.0).all()


def test_behind_a_removed_box_lies_the_ground() -> None:
    centre = np.array([0.0, -6.0, 0.75])
    beams = turning_beams()
    recorded = np.minimum(to_ground(beams), to_box(beams, centre))
    was_met = to_box(beams, centre) < to_ground(beams)
    # Dark paint: a quarter of the beams to the box did not come back.
    recorded[np.flatnonzero(was_met)[::4]] = np.inf
    beams = returned(beams, recorded)
    result = simulated(beams, scenario(placement("car", centre)), scenario())
    ground = to_ground(beams)
    was_met = to_box(beams, centre) < np.where(beams.is_returned, beams.range_m + 1e-6, ground)
    was_met &= to_box(beams, centre) < ground - 1e-3
    opened = was_met & np.isfinite(ground)
    np.testing.assert_array_equal(result.is_kept, beams.is_returned & ~was_met)
    np.testing.assert_array_equal(result.responses.is_returned, opened)
    np.testing.assert_allclose(result.range_m[opened], ground[opened], atol=2e-4)


def test_rings_and_steps_are_found_from_the_returns(rng: np.random.Generator) -> None:
    """A third of the beams is lost at random, and of the upper rings nearly half of the turn; times
    are stored in steps of four firings. Only the very ends of a sweep are uncertain."""
    beams = turning_beams()
    directions = ScanDirections.of(beams.directions_world, beams.times_ns // 10**6 * 10**6)
    is_back = rng.random(len(beams)) > 0.3
    is_back &= ~((directions.azimuth_rad > 0.3) & (directions.elevation_rad > 0.05))
    found = directions.chosen(is_back)
    rings = find_rings([found])
    np.testing.assert_allclose(np.degrees(rings), RINGS_DEG, atol=0.02)
    missing = missing_in_rings(found, rings)
    lost = directions.chosen(~is_back)
    assert abs(len(missing.times_ns) - len(lost.times_ns)) <= 2 * len(rings)
    lost = lost.chosen(np.abs(np.degrees(lost.azimuth_rad)) < 177.0)
    close = missing.vectors @ lost.vectors.T
    assert np.degrees(np.arccos(np.clip(close.max(axis=0), -1, 1))).max() < 0.05
    nearest = np.argmax(close, axis=0)
    assert np.abs(missing.times_ns[nearest] - lost.times_ns).max() < 3e6


def test_steps_of_a_sweep_that_has_one_time_are_found(rng: np.random.Generator) -> None:
    beams = turning_beams()
    found = ScanDirections.of(beams.directions_world, np.full(len(beams), END_NS))
    is_back = rng.random(len(beams)) > 0.3
    missing = missing_in_rings(found.chosen(is_back), np.radians(RINGS_DEG))
    assert (missing.times_ns == END_NS).all()
    close = (missing.vectors @ found.chosen(~is_back).vectors.T).max(axis=0)
    assert np.quantile(np.degrees(np.arccos(np.clip(close, -1, 1))), 0.98) < 0.05
    assert not len(missing_in_rings(found, np.empty(0)).times_ns)


def test_gaps_reach_to_the_ends_of_a_sweep() -> None:
    """Where it begins and ends something stands before most of the rings."""
    beams = turning_beams()
    directions = ScanDirections.of(beams.directions_world, beams.times_ns)
    rings = np.radians(RINGS_DEG)
    ring = np.argmin(np.abs(directions.elevation_rad[:, None] - rings), axis=1)
    is_lost = (np.abs(np.degrees(directions.azimuth_rad)) > 170.0) & (ring % 4 > 0)
    missing = missing_in_rings(directions.chosen(~is_lost), rings)
    lost = directions.chosen(is_lost)
    assert len(missing.times_ns) == len(lost.times_ns)
    close = missing.vectors @ lost.vectors.T
    assert np.degrees(np.arccos(np.clip(close.max(axis=0), -1, 1))).max() < 0.05


def test_the_gaps_of_a_raster_are_filled_from_other_sweeps(rng: np.random.Generator) -> None:
    """One that looks ahead, in a raster of 0.1 degrees; sweeps differ by a fifth of a step."""
    line = np.radians(np.arange(-2.0, 2.0, 0.1))
    azimuth, elevation = (a.ravel() for a in np.meshgrid(line, line))
    raster = ScanDirections(azimuth, elevation, END_NS + np.arange(len(azimuth)) * 1000)
    later = ScanDirections(azimuth + np.radians(0.02), elevation, raster.times_ns + 10**8)
    is_back = rng.random(len(azimuth)) > 0.3
    # Into the sky no sweep had a return.
    is_sky = elevation > 0.02
    missing = missing_in_raster(raster.chosen(is_back & ~is_sky), [later.chosen(~is_sky)])
    lost = raster.chosen(~is_back & ~is_sky)
    assert not raster.is_spinning
    assert len(missing.times_ns) == len(lost.times_ns)
    np.testing.assert_allclose(missing.azimuth_rad, lost.azimuth_rad + np.radians(0.02))
    assert np.abs(missing.times_ns - lost.times_ns).max() < 10**6


def test_a_place_answers_as_it_did(rng: np.random.Generator) -> None:
    """Half of the ground never answered, the other half did with its own intensity, and returns lay
    5 cm above the mesh; far from all that was seen, chance draws from all alike beams."""
    places = np.column_stack([rng.uniform(-8.0, 8.0, (4000, 2)), np.zeros(4000)])
    origin = np.array([0.0, 0.0, HEIGHT_M])
    distance = np.linalg.norm(places - origin, axis=1)
    nothing = np.zeros(len(places), dtype=np.int64)
    beams = Beams(
        np.tile(origin, (len(places), 1)), (places - origin) / distance[:, None], nothing, nothing,
        distance, nothing,
    )  # fmt: skip
    met = Surfaces.nothing(len(beams))
    met.distance_m[:], met.cosine[:] = to_ground(beams), -beams.directions_world[:, 2]
    met.body[:] = -1
    is_lit = places[:, 0] > 0
    responses = BeamResponses(
        is_lit, np.where(is_lit, 99, 0).astype(np.float32), np.where(is_lit, 7, -1)
    )
    raised = (places + [0.0, 0.0, 0.05]).astype(np.float32)
    response = Response({(0, ""): Donors(raised, looks_of(beams, met), responses)}, {}, {0: 0.0})
    found = response.respond(0, "", None, (places, looks_of(beams, met)), rng)
    is_inner = np.abs(places[:, 0]) > 2.0
    np.testing.assert_array_equal(found.is_returned[is_inner], is_lit[is_inner])
    assert (found.intensity[is_inner & is_lit] == 99).all()
    away = response.respond(0, "", None, (places + 500.0, looks_of(beams, met)), rng)
    assert 0.4 < away.is_returned.mean() < 0.6
    other = response.respond(0, "new", ActorKind.CAR, (places, looks_of(beams, met)), rng)
    assert 0.4 < other.is_returned.mean() < 0.6
    plane_m = (HEIGHT_M - 0.05) / -beams.directions_world[:, 2]
    refined = response.refined_m(0, beams, met)
    is_refined = np.abs(refined - met.distance_m) > 1e-9
    assert is_refined[is_inner & is_lit].mean() > 0.9
    np.testing.assert_allclose(refined[is_refined], plane_m[is_refined], atol=1e-3)


def test_returns_tell_how_ranges_scatter_where_there_are_enough(rng: np.random.Generator) -> None:
    beams = turning_beams()
    exact = to_ground(beams)
    exact[exact > 30.0] = np.inf
    beams = returned(beams, exact + rng.normal(0.0, 0.02, len(beams)))
    assert _noise_m(beams, 0, 0) == (pytest.approx(0.02, rel=0.2),)
    assert _noise_m(beams.chosen(np.arange(50)), 0, 0) == ()


def test_beams_keep_their_frame_and_origin() -> None:
    beams = returned(turning_beams(), to_ground(turning_beams()))
    back = beams.chosen(beams.is_returned)
    again = unreturned_beams(in_ego(back, EGO), back.times_ns, back, EGO)
    np.testing.assert_allclose(again.directions_world, back.directions_world, atol=1e-12)
    np.testing.assert_allclose(again.origins_world, back.origins_world, atol=1e-12)


def test_kept_rows_are_the_recorded_numbers_and_new_ones_stand_in_time(
    rng: np.random.Generator,
) -> None:
    """The twin's world is a corrected one: what is new goes back to the recorded world."""
    beams = returned(turning_beams(), to_ground(turning_beams()))
    order = np.argsort(beams.times_ns[beams.is_returned], kind="stable")
    hit = beams.chosen(np.flatnonzero(beams.is_returned)[order])
    beams = Beams.joined([replace(hit, row=np.arange(len(hit))), beams.chosen(~beams.is_returned)])
    count = len(hit)
    path = PathCorrection(
        np.array([END_NS - 10**9, END_NS]), np.zeros(3), np.array([[0, 0, 0.01], [0, 0, 0.02]]),
        np.array([[0.1, 0.0, 0.0], [0.0, 0.2, 0.0]]),
    )  # fmt: skip
    rows = {name: rng.random(count) for name in "xyzi"}
    rows |= {"t": hit.times_ns * 1e-9, "d": np.zeros(count, dtype=np.int64)}
    sweep = LidarSweep(
        "00", END_NS, hit.at(hit.range_m).astype(np.float32),
        hit.origins_world.astype(np.float32), np.zeros(count, np.float32),
        ((hit.times_ns - END_NS) * 1e-9).astype(np.float32), np.full(count, -1, np.int16),
        np.full(count, 7, np.int16),
    )  # fmt: skip
    made = simulated(beams, scenario(), scenario(placement("mine", np.array([8.0, 3.0, 1.2]))))
    out = written(RecordedSweep(sweep, rows, beams), made, path)
    for name, values in rows.items():
        assert out.columns[name].dtype == values.dtype
        kept = values[made.is_kept[:count]]
        np.testing.assert_array_equal(out.columns[name][out.is_recorded], kept)
    assert (np.diff(out.columns["t"]) > -1e-6).all()
    assert set(out.semantic_class[~out.is_recorded]) == {13}
    points = np.stack([out.columns[k][~out.is_recorded] for k in "xyz"], axis=1)
    times_ns = np.rint(out.columns["t"][~out.is_recorded] * 1e6).astype(np.int64) * 1000
    local = np.abs(path.transformed(points, times_ns) - [8.0, 3.0, 1.2]) - SIZE / 2
    assert np.abs(local.max(axis=1)).max() < 1e-4, "new points lie on the box"


def test_a_sweep_s_beams_are_its_returns() -> None:
    beams = returned(turning_beams(), to_ground(turning_beams()))
    hit = beams.chosen(beams.is_returned)
    sweep = LidarSweep(
        "00", END_NS, hit.at(hit.range_m).astype(np.float32),
        hit.origins_world.astype(np.float32), np.zeros(len(hit), np.float32),
        ((hit.times_ns - END_NS) * 1e-9).astype(np.float32), np.full(len(hit), -1, np.int16),
        np.full(len(hit), -1, np.int16),
    )  # fmt: skip
    again = returned_beams(sweep, hit.device)
    np.testing.assert_allclose(again.range_m, hit.range_m, rtol=1e-6)
    np.testing.assert_allclose(again.directions_world, hit.directions_world, atol=1e-6)
