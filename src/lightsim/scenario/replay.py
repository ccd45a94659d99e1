"""Scenarios of the log as it was recorded."""

from __future__ import annotations

from collections.abc import Sequence

from lightsim.core.scenario import ActorPlacement, FrameSource, Scenario, ScenarioFrame
from lightsim.core.sensors import CameraFrame
from lightsim.core.twin import DigitalTwin


def replay(
    twin: DigitalTwin,
    name: str,
    frames: Sequence[CameraFrame],
    source: FrameSource = "rendered",
    seed: int = 0,
) -> Scenario:
    """Return the recorded log as a scenario: every reconstructed actor on its own track, without a
    target sky."""
    log, assets = twin.log, twin.assets.actors
    return Scenario(
        name,
        tuple(ScenarioFrame.of(frame, source) for frame in frames),
        tuple(
            ActorPlacement(assets[track.actor_id], track)
            for track in log.actors
            if track.actor_id in assets
        ),
        log.actors,
        {camera: log.cameras[camera] for camera in dict.fromkeys(f.camera_name for f in frames)},
        log.ego,
        seed=seed,
    )
