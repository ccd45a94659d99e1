"""Known errors of path, mounting and clock are found; a right log stays as it is."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.align.scene import CAMERA, SPEED_M_S, make_log, mounting

from lightsim.align.build import align_log, large_notes
from lightsim.align.cameras import CameraFit
from lightsim.align.config import AlignConfig
from lightsim.align.edges import depth_edges
from lightsim.core.actors import ActorKind
from lightsim.core.alignment import Alignment, CameraCorrection
from lightsim.core.frames import RigidTransform, rotation_from_vector
from lightsim.core.log import DrivingLog
from lightsim.errors import InputError
from lightsim.progress import SilentProgress
from lightsim.store.alignment import read_alignment, write_alignment

COUNT = 12


def aligned(log: DrivingLog, *parts: str) -> Alignment:
    others = {"lidar_poses", "camera_poses", "actor_tracks"} - set(parts)
    config = AlignConfig().without(tuple(others))
    return align_log(
        log,
        config,
        rng=np.random.default_rng(0),
        progress=SilentProgress(),
    )


@pytest.mark.slow
def test_a_wandering_path_is_straightened() -> None:
    phase = np.linspace(0.0, np.pi, COUNT)
    error = 0.06 * np.stack([np.zeros(COUNT), np.sin(phase), 0.7 * np.cos(phase)], axis=1)
    found = aligned(make_log(COUNT, path_error_m=error), "lidar_poses")
    assert found.path is not None
    left = found.path.shifts_m[:COUNT] + error
    before = error - error.mean(axis=0)
    after = left - left.mean(axis=0)
    assert np.abs(after[:, 1:]).max() < 0.35 * np.abs(before[:, 1:]).max()
    assert found.numbers["path residual after, m"] < 0.6 * found.numbers["path residual before, m"]


@pytest.mark.parametrize(
    ("turn_deg", "shift_m", "is_kept", "words"),
    [
        (0.29, 0.09, True, ""),
        (0.31, 0.0, True, "front_camera was rotated by up to 0.31 degrees and moved by up to 0.0"),
        (0.0, 0.11, True, "front_camera was rotated by up to 0.00 degrees and moved by up to 11.0"),
        (0.4, 0.2, False, ""),
    ],
)
def test_a_large_correction_has_a_note(
    turn_deg: float, shift_m: float, is_kept: bool, words: str
) -> None:
    axis = np.array([0.6, 0.0, 0.8])
    correction = CameraCorrection(np.radians(turn_deg) * axis, shift_m * axis, 0.0)
    fit = CameraFit("front_camera", correction, 0.1, 0.2, is_kept)
    notes = large_notes(None, [fit])
    assert [words in note and "--no-refine camera_poses" in note for note in notes] == (
        [True] if words else []
    )


@pytest.mark.slow
def test_a_turned_camera_is_turned_back() -> None:
    turn = np.radians([0.2, 0.3, -0.1])
    wrong = RigidTransform.from_rotation(
        "camera", "camera", rotation_from_vector(turn), np.zeros(3)
    )
    log = make_log(COUNT, ego_from_camera=mounting() @ wrong)
    found = aligned(log, "camera_poses")
    assert misplaced_px(found.applied_to(log), log, wrong) < 0.3 * misplaced_px(log, log, wrong)


def misplaced_px(log: DrivingLog, recorded: DrivingLog, wrong: RigidTransform) -> float:
    """How far depth edges appear from where the true camera saw them, median."""
    apart = []
    for sweep, frame, claimed in zip(log.sweeps, log.frames, recorded.frames, strict=True):
        points = depth_edges(sweep.load(), (), np.random.default_rng(0))
        true = replace(claimed, world_from_camera=claimed.world_from_camera @ wrong)
        expected, is_seen = true.project(CAMERA, points)
        uv, _ = frame.project(CAMERA, points)
        apart.append(np.linalg.norm(uv - expected, axis=1)[is_seen])
    return float(np.median(np.concatenate(apart)))


@pytest.mark.slow
def test_a_right_log_stays_nearly_as_it_is() -> None:
    log = make_log(COUNT)
    same = aligned(log, "lidar_poses", "camera_poses").applied_to(log)
    pairs = [
        *zip(log.ego.matrices, same.ego.matrices, strict=True),
        *(
            (before.world_from_camera.matrix, after.world_from_camera.matrix)
            for before, after in zip(log.frames, same.frames, strict=True)
        ),
    ]
    for before, after in pairs:
        moved = np.linalg.inv(before) @ after
        assert np.abs(moved[:3, 3]).max() < 0.01
        assert np.degrees(np.linalg.norm(moved[:3, :3] - np.eye(3)) / np.sqrt(2)) < 0.1


@pytest.mark.slow
def test_alignments_survive_the_disk(tmp_path: Path) -> None:
    error = np.zeros((COUNT, 3))
    error[:, 2] = 0.05 * np.sin(np.arange(COUNT))
    made = aligned(make_log(COUNT, path_error_m=error), "lidar_poses")
    made = replace(made, actors={"a/b": np.tile(np.eye(4), (3, 1, 1))})
    write_alignment(tmp_path, made)
    read = read_alignment(tmp_path)
    assert made.path is not None
    assert read.path is not None
    np.testing.assert_array_equal(read.path.shifts_m, made.path.shifts_m)
    assert list(read.actors) == ["a/b"]
    assert (read.notes, read.numbers) == (made.notes, dict(made.numbers))


def test_parked_boxes_stop_jittering() -> None:
    log = make_log(COUNT)
    jitter = np.random.default_rng(1).normal(0.0, 0.03, (len(log.actors[0].trajectory), 3))
    poses = log.actors[0].trajectory.matrices.copy()
    poses[:, :3, 3] += jitter
    shaken = replace(log.actors[0], trajectory=replace(log.actors[0].trajectory, matrices=poses))
    moving = replace(shaken, actor_id="moving", is_moving=True)
    walker = replace(shaken, actor_id="walker", kind=ActorKind.PEDESTRIAN)
    found = aligned(replace(log, actors=(shaken, moving, walker)), "actor_tracks")
    assert list(found.actors) == ["none"]
    assert np.ptp(found.actors["none"], axis=0).max() == 0.0
    np.testing.assert_allclose(found.actors["none"][0, :3, 3], [500.0, 0.0, 0.0], atol=0.05)


def test_physics_can_be_switched_off() -> None:
    log = make_log(4)
    masks = {"side": np.ones((CAMERA.height_px, CAMERA.width_px), dtype=bool)}
    log = replace(log, ego_vehicle_masks=masks)
    plain = Alignment(has_point_times=False, has_ego_vehicle_masks=False).applied_to(log)
    assert not plain.ego_vehicle_masks
    sweep = plain.sweeps[1].load()
    assert not sweep.time_offset_s.any()
    assert np.ptp(sweep.origins_world, axis=0).max() == 0.0
    assert Alignment().applied_to(log).ego_vehicle_masks is masks


def test_unknown_parts_are_refused() -> None:
    with pytest.raises(InputError, match="lidar_poses"):
        AlignConfig().without(("wheels",))


@pytest.mark.slow
def test_planar_poses_get_pitch_roll_and_height() -> None:
    """The car pitches by a degree, rolls and rises on a slope of 3 %; its recorded path is planar.

    Every sweep is stored as it looks in the recorded, planar pose. The corrections must undo the
    motion, up to one tilt and height of the whole log that no sweep reveals.
    """
    log = make_log(COUNT)
    pitch = np.radians(1.0) * np.sin(np.arange(COUNT) * 0.9)
    roll = np.radians(0.5) * np.cos(np.arange(COUNT) * 0.7)
    height_m = 0.03 * SPEED_M_S * 0.1 * np.arange(COUNT)
    sweeps = []
    for i, lazy in enumerate(log.sweeps):
        sweep = lazy.load()
        ego = log.ego.at(sweep.time_ns)
        turn = rotation_from_vector(np.array([roll[i], pitch[i], 0.0]))
        body = RigidTransform.from_rotation("ego", "ego", turn, np.array([0, 0, height_m[i]]))
        # True pose: ego @ body. Points in the body frame are recorded as if the body were level.
        recorded = ego @ body.inverse() @ ego.inverse()
        moved = replace(
            sweep,
            points_world=recorded.apply(sweep.points_world.astype(np.float64)).astype(np.float32),
            origins_world=recorded.apply(sweep.origins_world.astype(np.float64)).astype(np.float32),
        )
        sweeps.append(replace(lazy, load=lambda moved=moved: moved))
    shaken = replace(log, sweeps=tuple(sweeps), has_heights=False)
    found = aligned(shaken, "lidar_poses")
    corrected = found.applied_to(shaken)
    before = _spread_of_ground_m(shaken)
    after = _spread_of_ground_m(corrected)
    assert before > 0.07
    assert after < 0.015


def _spread_of_ground_m(log: DrivingLog) -> float:
    """Standard deviation of the height of road returns about their common plane."""
    road = [sweep.load() for sweep in log.sweeps]
    points = np.concatenate(
        [s.points_world[(np.abs(s.points_world[:, 1] - 3.0) < 2.0)].astype(float) for s in road]
    )
    points = points[np.abs(points[:, 2]) < 1.0]
    columns = np.column_stack([points[:, :2], np.ones(len(points))])
    plane = np.linalg.lstsq(columns, points[:, 2], rcond=None)[0]
    rest = points[:, 2] - columns @ plane
    # Kerb stones and boxes stand on the road: outliers are cut once.
    keep = np.abs(rest) < 3 * np.std(rest)
    return float(np.std(rest[keep]))
