"""A moving box whose labels shake is placed where its returns say."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float64
from tests.align.scene import STEP_NS

from lightsim.align.config import AlignConfig
from lightsim.align.movers import settle_moving
from lightsim.align.planes import Cloud
from lightsim.core.actors import ActorKind, ActorTrack
from lightsim.core.frames import Trajectory

COUNT = 14
SIZE_LWH_M = np.array([4.4, 1.8, 1.5])


def pose(x_m: float, y_m: float, yaw_rad: float) -> Float64[np.ndarray, "4 4"]:
    cosine, sine = np.cos(yaw_rad), np.sin(yaw_rad)
    matrix = np.eye(4)
    matrix[:2, :2] = [[cosine, -sine], [sine, cosine]]
    matrix[:3, 3] = (x_m, y_m, 0.75)
    return matrix


def sides(rng: np.random.Generator) -> Float64[np.ndarray, "n 3"]:
    """Returns off the rear, the right side and the roof of the box, a centimetre of noise."""
    points = rng.uniform(-0.5, 0.5, (3, 250, 3)) * SIZE_LWH_M
    points[0, :, 0] = -SIZE_LWH_M[0] / 2
    points[1, :, 1] = -SIZE_LWH_M[1] / 2
    points[2, :, 2] = SIZE_LWH_M[2] / 2
    return points.reshape(-1, 3) + rng.normal(0.0, 0.01, (750, 3))


def _shake(rng: np.random.Generator, shift_m: float, turn_rad: float) -> np.ndarray:
    x_m, y_m, turn = rng.normal(size=3)
    matrix = pose(shift_m * x_m, shift_m * y_m, turn_rad * turn)
    matrix[2, 3] = 0.0
    return matrix


def drive(shake_m: float, shake_rad: float) -> tuple[ActorTrack, Cloud, np.ndarray]:
    """The track as labelled, the returns in frame `world`, and the true poses."""
    rng = np.random.default_rng(4)
    times = np.arange(1, COUNT + 1, dtype=np.int64) * STEP_NS
    true = np.stack([pose(0.8 * i, 0.02 * i * i, 0.05 * i) for i in range(COUNT)])
    shake = [_shake(rng, shake_m, shake_rad) for _ in times]
    labelled = true @ np.stack(shake)
    clouds = [(sides(rng) @ t[:3, :3].T + t[:3, 3]) for t in true]
    cloud = Cloud(
        np.concatenate(clouds),
        np.repeat(times, 750),
        np.repeat(np.arange(COUNT, dtype=np.int64), 750),
    )
    track = Trajectory("world", "actor", times, labelled)
    return ActorTrack("van", ActorKind.CAR, SIZE_LWH_M, track, True), cloud, true


def jitter(matrices: np.ndarray, true: np.ndarray) -> tuple[float, float]:
    """Scatter of position (m) and yaw (deg) about the mean offset of a track from the truth."""
    offset = np.linalg.inv(true) @ matrices
    yaw = np.degrees(np.arctan2(offset[:, 1, 0], offset[:, 0, 0]))
    return float(np.linalg.norm(offset[:, :2, 3].std(axis=0))), float(yaw.std())


def test_shaken_labels_are_settled_by_the_returns() -> None:
    actor, cloud, true = drive(0.04, np.radians(0.8))
    rng = np.random.default_rng(0)
    (fit,) = settle_moving((actor,), {"van": cloud}, None, AlignConfig(), rng)
    before = jitter(actor.trajectory.matrices, true)
    after = jitter(fit.matrices, true)
    assert after[0] < 0.25 * before[0], (before, after)
    assert after[1] < 0.4 * before[1], (before, after)


def test_right_labels_and_walkers_stay() -> None:
    actor, cloud, true = drive(0.0, 0.0)
    rng = np.random.default_rng(0)
    for fit in settle_moving((actor,), {"van": cloud}, None, AlignConfig(), rng):
        assert jitter(fit.matrices, true)[0] < 0.005
    actor, cloud, _ = drive(0.04, np.radians(0.8))
    walker = replace(actor, kind=ActorKind.PEDESTRIAN)
    assert settle_moving((walker,), {"van": cloud}, None, AlignConfig(), rng) == []
    assert settle_moving((actor,), {}, None, AlignConfig(), rng) == []


def test_labels_that_slide_in_a_sawtooth_become_a_drive() -> None:
    """As PandaSet's do: ahead by 0.1 m more in each sweep, and back in the fifth."""
    actor, cloud, true = drive(0.0, 0.0)
    slide = np.tile(np.eye(4), (COUNT, 1, 1))
    slide[:, 0, 3] = 0.12 * (np.arange(COUNT) % 5)
    labelled = replace(actor, trajectory=replace(actor.trajectory, matrices=true @ slide))
    rng = np.random.default_rng(0)
    (fit,) = settle_moving((labelled,), {"van": cloud}, None, AlignConfig(), rng)
    before, after = (jitter(m, true)[0] for m in (labelled.trajectory.matrices, fit.matrices))
    assert after < 0.35 * before, (before, after)
