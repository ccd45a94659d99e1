"""A recording with known motion, assembled to a log: poses, times, points and frames."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lightsim.core.actors import ActorKind, ActorTrack
from lightsim.core.frames import RigidTransform, Trajectory
from lightsim.core.log import DrivingLog, without_ego_vehicle
from lightsim.core.reading import LogReading
from lightsim.datasets.assemble import assemble
from lightsim.datasets.geo import Located
from lightsim.datasets.lenses import Lens
from lightsim.datasets.recorded import (
    PointFrame,
    RawSweep,
    Readout,
    ReadoutDirection,
    RecordedCamera,
    RecordedLog,
    RecordedPicture,
    RecordedSweep,
    StampedMoment,
)
from lightsim.datasets.ticks import assigned
from lightsim.errors import InputError

SPEED_M_S = 15.0
START_NS = 1_500_000_000 * 10**9
UTM_M = np.array([5_400_123.25, 412_345.5, 210.75])
EGO_FROM_CAMERA = RigidTransform(
    "ego", "camera", np.array([[0.0, 0, 1, 1.5], [-1, 0, 0, 0.2], [0, -1, 0, 1.6], [0, 0, 0, 1]])
)
LIDAR_M = np.array([0.5, 0.0, 1.9])
READING = LogReading(source="drive", image_scale=1.0)


def ego_position(time_ns: np.ndarray | int) -> np.ndarray:
    """The ego drives along +x at constant speed."""
    seconds = (np.asarray(time_ns) - START_NS) * 1e-9
    return UTM_M + np.stack([SPEED_M_S * seconds, 0 * seconds, 0 * seconds], axis=-1)


def ego_path() -> Trajectory:
    times = START_NS + np.arange(0, 2_000_000_001, 70_000_000)
    matrices = np.tile(np.eye(4), (len(times), 1, 1))
    matrices[:, :3, 3] = ego_position(times)
    return Trajectory("world", "ego", times, matrices)


def camera(name: str, times_ns: list[int], readout: Readout = Readout()) -> RecordedCamera:  # noqa: B008
    picture = np.zeros((48, 64, 3), np.uint8)
    pictures = tuple(RecordedPicture(t, Path(f"{t}.jpg"), lambda: picture) for t in times_ns)
    lens = Lens("pinhole", 64, 48, 60.0, 60.0, 32.0, 24.0)
    return RecordedCamera(name, lens, EGO_FROM_CAMERA, pictures, readout)


def times_of(rate_hz: float, count: int, offset_s: float = 0.0) -> list[int]:
    return [START_NS + round((i / rate_hz + offset_s) * 1e9) for i in range(count)]


TARGETS_M = UTM_M + np.array([[30.0, 4.0, 1.0], [22.0, -6.0, 0.5], [45.0, 1.0, 3.0]])
OFFSETS_S = np.array([-0.09, -0.05, -0.01])


def sweep(time_ns: int, frame: PointFrame) -> RecordedSweep:
    """Returns of three fixed targets, each measured at its own time from the moving sensor."""

    def load() -> RawSweep:
        times = time_ns + np.round(OFFSETS_S * 1e9).astype(np.int64)
        at = {
            PointFrame.OWN_TIME: ego_position(times),
            PointFrame.SWEEP_TIME: ego_position(np.full(3, time_ns)),
            PointFrame.WORLD: np.zeros((3, 3)),
        }[frame]
        return RawSweep(TARGETS_M - at, frame, LIDAR_M, np.full(3, 0.5), OFFSETS_S)

    return RecordedSweep(time_ns, Path(f"{time_ns}.bin"), load)


def recorded(**changes: object) -> RecordedLog:
    cameras = (camera("front", times_of(12, 20)), camera("left", times_of(12, 20, 0.02)))
    box = ActorTrack("car", ActorKind.CAR, np.array([4.0, 2.0, 1.5]), ego_path(), True)
    base = RecordedLog(
        "drive",
        cameras,
        ego_path(),
        {"top": tuple(sweep(t, PointFrame.SWEEP_TIME) for t in times_of(20, 30, 0.1))},
        (box,),
        Located(world_x_azimuth_deg=90.0),
    )
    return replace(base, **changes)


def log_of(content: RecordedLog, **options: object) -> DrivingLog:
    return assemble(content, replace(READING, **options), without_ego_vehicle)


def test_the_world_starts_at_the_first_ego_position() -> None:
    log = log_of(recorded())
    assert np.abs(log.ego.at(START_NS).translation_m).max() <= 0.5
    np.testing.assert_array_equal(np.array(log.origin_m), np.round(UTM_M))
    np.testing.assert_allclose(
        log.actors[0].trajectory.positions_m[3] + log.origin_m, ego_path().positions_m[3]
    )


@pytest.mark.parametrize("frame", list(PointFrame))
def test_points_and_origins_are_those_of_their_own_time(frame: PointFrame) -> None:
    """Closed-form truth within a millimetre, although the sensor moves 1.2 m in the sweep."""
    time_ns = times_of(20, 30, 0.1)[7]
    log = log_of(recorded(sweeps={"top": (sweep(time_ns, frame),)}))
    loaded = log.sweeps[0].load()
    times = time_ns + np.round(OFFSETS_S * 1e9).astype(np.int64)
    np.testing.assert_allclose(loaded.points_world, TARGETS_M - log.origin_m, atol=1e-3)
    expected = ego_position(times) + LIDAR_M - log.origin_m
    np.testing.assert_allclose(loaded.origins_world, expected, atol=1e-3)
    np.testing.assert_allclose(loaded.time_offset_s, OFFSETS_S, atol=1e-7)


@pytest.mark.parametrize(
    ("direction", "pixel", "moment", "after_s"),
    [
        (ReadoutDirection.TOP_TO_BOTTOM, (32.0, 0.0), StampedMoment.START, 0.0),
        (ReadoutDirection.TOP_TO_BOTTOM, (32.0, 48.0), StampedMoment.MIDDLE, 0.02),
        (ReadoutDirection.BOTTOM_TO_TOP, (32.0, 0.0), StampedMoment.END, 0.0),
        (ReadoutDirection.LEFT_TO_RIGHT, (0.0, 10.0), StampedMoment.START, 0.0),
        (ReadoutDirection.LEFT_TO_RIGHT, (64.0, 10.0), StampedMoment.START, 0.04),
        (ReadoutDirection.RIGHT_TO_LEFT, (64.0, 10.0), StampedMoment.MIDDLE, -0.02),
    ],
)
def test_each_pixel_is_seen_from_where_the_camera_was(
    direction: ReadoutDirection,
    pixel: tuple[float, float],
    moment: StampedMoment,
    after_s: float,
) -> None:
    stamp = times_of(12, 20)[5]
    content = recorded(
        cameras=(camera("front", times_of(12, 20), Readout(0.04, direction, moment)),)
    )
    log = log_of(content)
    frame = log.frames[5]
    origins, _ = frame.pixel_rays(log.cameras["front"], np.array([pixel]))
    at = ego_position(stamp + round(after_s * 1e9)) + EGO_FROM_CAMERA.translation_m
    np.testing.assert_allclose(origins[0], at - log.origin_m, atol=1e-6)


def test_unsynchronised_cameras_share_frames() -> None:
    """A camera of half the rate joins every second frame; a lost picture leaves a gap, and says
    so."""
    front, left = times_of(12, 20), times_of(6, 10, 0.015)
    del front[4]
    log = log_of(recorded(cameras=(camera("front", front), camera("left", left))))
    assert [int(f.stem) for f in log.frames_of("left")] == list(range(0, 20, 2))
    assert 4 not in [int(f.stem) for f in log.frames_of("front")]
    assert len({s.stem for s in log.sweeps}) == len(log.sweeps)
    assert any("front: no picture for 1 of 20 frames" in note for note in log.notes)
    nearest = {f.stem: f.time_ns for f in log.frames_of("front")}
    for lazy in log.sweeps:
        if lazy.stem in nearest:
            assert abs(lazy.time_ns - nearest[lazy.stem]) <= 41_700_000


def test_frames_select_their_sweeps() -> None:
    log = log_of(recorded(), frames="4:8")
    assert log.stems == ("04", "05", "06", "07")
    times = [sweep.time_ns for sweep in log.sweeps]
    assert len(times) in (6, 7, 8)
    assert min(times) > times_of(12, 20)[3]
    assert max(times) < times_of(12, 20)[8]


def test_two_lidars_become_one_sweep() -> None:
    top = tuple(sweep(t, PointFrame.SWEEP_TIME) for t in times_of(10, 10, 0.1))
    side = tuple(sweep(t, PointFrame.OWN_TIME) for t in times_of(10, 9, 0.13))
    log = log_of(recorded(sweeps={"top": top, "side": side}))
    loaded = log.sweeps[2].load()
    assert len(log.sweeps) == 10
    assert len(loaded.points_world) == 6
    np.testing.assert_allclose(loaded.time_offset_s[3:], OFFSETS_S + 0.03, atol=1e-6)
    np.testing.assert_allclose(loaded.points_world[3:], loaded.points_world[:3], atol=1e-3)


def test_a_picture_beyond_the_path_is_noted() -> None:
    late = [*times_of(12, 20), START_NS + 9 * 10**9]
    log = log_of(recorded(cameras=(camera("front", late),)))
    assert len(log.frames) == 20
    assert any("beyond the ego path" in note for note in log.notes)


@pytest.mark.parametrize(
    ("options", "expected"),
    [({"cameras": ("rear",)}, "no such camera"), ({"frames": "90:99"}, "no frame is selected")],
)
def test_a_wrong_selection_is_one_error(options: dict[str, object], expected: str) -> None:
    with pytest.raises(InputError, match=expected):
        log_of(recorded(), **options)


def test_a_sweep_of_another_time_is_one_error() -> None:
    bad = replace(sweep(START_NS, PointFrame.OWN_TIME), load=lambda: RawSweep(
        np.ones((2, 3)), PointFrame.OWN_TIME, LIDAR_M, np.ones(2), np.array([0.0, 3.0])
    ))  # fmt: skip
    with pytest.raises(InputError, match="times are not those of the sweep"):
        log_of(recorded(sweeps={"top": (bad,)}))


def test_cameras_that_fire_half_a_period_apart_lose_no_picture() -> None:
    """The last picture is nearest to the last tick, as the one before is after a shift."""
    ticks = np.arange(4) * 100
    for phase, jitter in ((51, (0, 0, 0, 0)), (49, (0, 2, -1, 1)), (-51, (0, 0, 0, 0))):
        found = assigned(ticks, ticks + phase + np.array(jitter))
        assert sorted(found.values()) == [0, 1, 2, 3], phase
