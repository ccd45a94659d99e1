"""Camera properties that are applied to rendered actors: blur, noise and motion blur."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
from jaxtyping import Float32

from lightsim.core.buffers import GBuffers
from lightsim.core.camera import PinholeCamera
from lightsim.core.frames import Trajectory
from lightsim.core.log import DrivingLog
from lightsim.core.scenario import Scenario
from lightsim.core.sensors import CameraFrame
from lightsim.relighting.physical.blur_noise import CameraBlurNoise, estimate_blur_noise

# Pictures per camera that are measured, evenly over the log: with twice as many the variance of
# edge blur of log 002's cameras changes by less than 0.05 px^2 (no script repeats this).
_PICTURES = 8


class CamerasBlurNoise:
    """Blur and noise of a log's cameras, estimated for each camera at its first use."""

    def __init__(self, log: DrivingLog) -> None:
        self._log = log
        self._known: dict[str, CameraBlurNoise] = {}

    def of(self, camera: PinholeCamera) -> CameraBlurNoise:
        """Return the blur and noise of a camera's recorded pictures."""
        if camera.name not in self._known:
            frames = self._log.frames_of(camera.name)
            chosen = np.linspace(0, len(frames) - 1, min(_PICTURES, len(frames))).round()
            # The ego vehicle is not visible in cameras without a mask.
            nowhere = np.zeros((camera.height_px, camera.width_px), dtype=bool)
            self._known[camera.name] = estimate_blur_noise(
                (frames[int(number)].load_srgb8() for number in chosen),
                self._log.ego_vehicle_masks.get(camera.name, nowhere),
            )
        return self._known[camera.name]


def motion_in_picture(
    scenario: Scenario,
    view: tuple[CameraFrame, PinholeCamera],
    ego: Trajectory,
    buffers: GBuffers,
    numbers: Collection[int],
    exposure_s: float,
) -> Float32[np.ndarray, "h w 2"]:
    """Return the motion (u, v), in pixels, of actors' surfaces during the exposure, caused by the
    actors and by the ego vehicle.

    Args:
        scenario: poses of the actors.
        view: frame and camera.
        ego: path of the ego vehicle in the scenario.
        buffers: geometry buffers of the frame, rendered in the scenario.
        numbers: numbers of the actors in `buffers.actor_index`.
        exposure_s: exposure time, in seconds, centred on the frame's time.

    Returns:
        NaN at pixels that show none of the actors.
    """
    frame, camera = view
    motion = np.full((*buffers.depth_z_m.shape, 2), np.nan, np.float32)
    # The exposure is centred on the frame's time.
    times_ns = [frame.time_ns + round(half * exposure_s * 1e9) for half in (-0.5, 0.5)]
    # The camera is fixed to the ego vehicle, which moves during the exposure.
    ego_from_camera = ego.held(frame.time_ns).inverse() @ frame.world_from_camera
    for placement in scenario.placements_at(frame.time_ns):
        number = scenario.number_by_actor[placement.track.actor_id]
        shown = buffers.actor_index == number
        if number not in numbers or not shown.any():
            continue
        points_world = buffers.position_world[shown].astype(np.float64)
        points_actor = placement.world_from_actor(frame.time_ns).inverse().apply(points_world)
        ends = []
        for time_ns in times_ns:
            # An actor has no pose beyond the ends of its track: the pose of the frame is used.
            is_there = placement.track.is_present(time_ns)
            world = placement.world_from_actor(time_ns if is_there else frame.time_ns)
            camera_from_world = (ego.held(time_ns) @ ego_from_camera).inverse()
            ends.append(camera.project((camera_from_world @ world).apply(points_actor))[0])
        motion[shown] = ends[1] - ends[0]
    return motion
