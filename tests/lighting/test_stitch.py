"""The panorama and the evidence of a box room with known colours."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from lightsim.core.actors import ActorKind, ActorTrack
from lightsim.core.camera import PinholeCamera
from lightsim.core.colour import srgb8_from_linear
from lightsim.core.equirect import pixel_directions
from lightsim.core.frames import RigidTransform, Trajectory
from lightsim.core.log import DrivingLog
from lightsim.core.sensors import CameraFrame, RollingShutter
from lightsim.core.twin import Panorama
from lightsim.errors import InputError
from lightsim.lighting.panorama.overlaps import sky_factors
from lightsim.lighting.panorama.stitch import StitchConfig, stitch_panorama

HALF_M = 6.0
GAIN = np.array([1.2, 0.9, 1.1], np.float32)


def _truth(directions: np.ndarray) -> np.ndarray:
    """Sky above the horizon, walls and floor below: colours that vary with direction."""
    up = directions[..., 2:3]
    sky = np.concatenate([0.2 + 0.1 * up, 0.3 + 0 * up, 0.5 - 0.2 * up], axis=-1)
    ground = np.broadcast_to([0.25, 0.2, 0.15], sky.shape)
    return np.where(up > 0, sky, ground)


def _striped(directions: np.ndarray) -> np.ndarray:
    """Sky whose colour changes quickly with azimuth, over the same ground."""
    stripes = 0.5 + 0.3 * np.sin(6 * np.arctan2(directions[..., 1], directions[..., 0]))
    return np.where(directions[..., 2:3] > 0, stripes[..., None], _truth(directions))


def _log(
    gain: np.ndarray,
    actors: tuple[ActorTrack, ...] = (),
    truth: Callable[[np.ndarray], np.ndarray] = _truth,
    shutter: RollingShutter | None = None,
) -> DrivingLog:
    """Four cameras look horizontally in four directions, at two moments 1 m apart."""
    cameras, frames = {}, []
    opencv = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    for i in range(4):
        camera = PinholeCamera(f"camera_{i}", 160, 120, 75.0, 75.0, 80.0, 60.0)
        cameras[camera.name] = camera
        turn = RigidTransform.from_yaw("world", "rig", i * np.pi / 2, np.zeros(3)).rotation
        for moment in range(2):
            origin = np.array([float(moment), 0.0, 0.0])
            pose = RigidTransform.from_rotation("world", "camera", turn @ opencv, origin)
            bare = CameraFrame(camera.name, f"{moment:02d}", moment * 10**8, pose, _black, shutter)
            directions = _directions(bare, camera)
            image = srgb8_from_linear((truth(directions) * gain).astype(np.float32))
            frames.append(replace(bare, load_srgb8=lambda i=image: i))
    ego = Trajectory("world", "ego", np.array([0, 10**8]), np.stack([np.eye(4)] * 2))
    frames.sort(key=lambda f: f.time_ns)
    return DrivingLog("box", cameras, tuple(frames), (), ego, actors, None, {})


def _black() -> np.ndarray:
    return np.zeros((120, 160, 3), np.uint8)


def _directions(frame: CameraFrame, camera: PinholeCamera) -> np.ndarray:
    _, directions = frame.pixel_rays(camera, camera.pixel_centres().reshape(-1, 2))
    return directions.reshape(camera.height_px, camera.width_px, 3)


def _sky_matte(frame: CameraFrame, camera: PinholeCamera) -> np.ndarray:
    return (_directions(frame, camera)[..., 2] > 0).astype(np.float32)


def _depth(frame: CameraFrame, camera: PinholeCamera) -> np.ndarray:
    return np.full((camera.height_px, camera.width_px), HALF_M, np.float32)


def _stitch(log: DrivingLog, gain: np.ndarray = GAIN, frame_count: int = 5) -> Panorama:
    gains = {name: gain.astype(np.float32) for name in log.cameras}
    config = StitchConfig(height_px=96, frame_count=frame_count)
    return stitch_panorama(log, gains, _depth, _sky_matte, config)


def test_known_colours_come_back_with_gains_divided_out():
    panorama = _stitch(_log(GAIN))
    directions = pixel_directions(96)
    assert panorama.is_seen[48 - 14 : 48 + 14].mean() > 0.97
    clear = panorama.is_sky & (directions[..., 2] > 0.05)
    assert clear.mean() > 0.1
    np.testing.assert_allclose(panorama.radiance[clear], _truth(directions)[clear], atol=0.012)
    below = panorama.is_seen & (directions[..., 2] < -0.1)
    assert not panorama.is_sky[below].any()
    assert np.median(panorama.radiance[below], axis=0) == pytest.approx(
        [0.25, 0.2, 0.15], abs=0.005
    )
    assert not panorama.is_clipped.any()
    assert (panorama.radiance[~panorama.is_seen] == 0).all()


def test_the_cameras_of_one_moment_are_enough():
    """The middle moment alone, of a log or of K pictures without any before and after."""
    log = _log(GAIN)
    middle = tuple(frame for frame in log.frames if frame.stem == "01")
    alone = _stitch(log.with_frames(middle))
    assert alone.is_seen[48 - 14 : 48 + 14].mean() > 0.97
    chosen = _stitch(log, frame_count=1)
    np.testing.assert_array_equal(chosen.radiance, alone.radiance)
    np.testing.assert_array_equal(chosen.is_sky, _stitch(log).is_sky)
    with pytest.raises(InputError, match="0 moments"):
        _stitch(log, frame_count=0)


def test_rows_that_were_read_while_the_camera_turned_lie_where_they_looked():
    shutter = RollingShutter(0.1, np.array([10.0, 0.0, 0.0]), np.array([0.0, 0.0, 4.0]))
    panorama = _stitch(_log(GAIN, truth=_striped, shutter=shutter))
    directions = pixel_directions(96)
    clear = panorama.is_sky & (directions[..., 2] > 0.05)
    assert clear.mean() > 0.1
    error = np.abs(panorama.radiance - _striped(directions))[clear]
    # Half a pixel of the camera shifts the stripes by 0.02; 0.2 rad by 0.5.
    assert np.percentile(error, 99) < 0.04


def test_the_ego_vehicle_is_left_out():
    log = _log(GAIN)
    mask = np.zeros((120, 160), bool)
    mask[90:] = True
    hooded = _stitch(replace(log, ego_vehicle_masks={"camera_0": mask}))
    hidden = _stitch(log).is_seen & ~hooded.is_seen
    rows, columns = np.nonzero(hidden)
    assert hidden.sum() > 100
    # The mask's edge lies 15 (corner) to 22 degrees (centre) below the horizon.
    assert 54 < rows.min() < 58
    assert np.abs(columns - 96).max() < 30


def test_skies_of_overlapping_cameras_are_matched():
    """Two cameras whose gains are wrong at the brightness of sky, by factors whose mean is 1."""
    log = _log(GAIN)
    step = np.array([1.3, 1.2, 1.1], np.float32)
    gains = {n: GAIN * step ** (1 if i % 2 else -1) for i, n in enumerate(log.cameras)}
    panorama = stitch_panorama(log, gains, _depth, _sky_matte, StitchConfig(height_px=96))
    directions = pixel_directions(96)
    clear = panorama.is_sky & (directions[..., 2] > 0.05)
    ratio = panorama.radiance[clear] / _truth(directions)[clear]
    # The prior that keeps the level holds back a few percent; unmatched skies differ by 1.7.
    assert np.percentile(ratio, 98, axis=0) / np.percentile(ratio, 2, axis=0) == pytest.approx(
        [1, 1, 1], abs=0.09
    )


def test_slivers_of_overlap_change_little():
    first = np.full((50, 100, 3), 1.0, np.float32)
    seen = np.ones((50, 100), bool)
    sliver = np.zeros((50, 100), bool)
    sliver[0, 0] = True
    wide = sky_factors([first, first * 2], [seen, seen])
    np.testing.assert_allclose(wide[0] / wide[1], 2.0, rtol=1e-3)
    np.testing.assert_allclose(wide[0] * wide[1], 1.0, rtol=1e-6)
    thin = sky_factors([first, first * 2], [seen, sliver])
    assert 1.0 < thin[0, 0] / thin[1, 0] < 1.4
    np.testing.assert_array_equal(sky_factors([first], [seen]), 1.0)


def test_saturated_sky_is_marked():
    panorama = _stitch(_log(GAIN * 4), GAIN * 4)
    assert panorama.is_clipped[panorama.is_sky].mean() > 0.9


def test_moving_actors_are_left_out():
    matrix = np.eye(4)
    matrix[:3, 3] = [5.0, 0.0, -1.0]
    track = ActorTrack(
        "a",
        ActorKind.CAR,
        np.array([2.0, 2.0, 2.0]),
        Trajectory("world", "actor", np.array([0, 10**8]), np.stack([matrix, matrix])),
        True,
    )
    hidden = _stitch(_log(GAIN)).is_seen & ~_stitch(_log(GAIN, (track,))).is_seen
    rows, columns = np.nonzero(hidden)
    assert len(rows) > 20
    assert np.abs(columns - 96).max() < 30
    assert rows.min() > 40


def test_a_camera_without_gain_is_refused():
    with pytest.raises(InputError, match="gain"):
        stitch_panorama(_log(GAIN), {}, _depth, _sky_matte, StitchConfig(height_px=32))
