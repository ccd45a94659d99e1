"""Scenarios from a twin: which frames, and which actors follow which tracks."""

from __future__ import annotations

from lightsim.core.scenario import ActorPlacement, Scenario
from lightsim.core.sensors import CameraFrame
from lightsim.core.twin import DigitalTwin


def replay(twin: DigitalTwin, name: str, frames: tuple[CameraFrame, ...]) -> Scenario:
    """The log as it was: every reconstructed actor on its own track."""
    placements = tuple(
        ActorPlacement(twin.assets.actors[track.actor_id], track)
        for track in twin.log.actors
        if track.actor_id in twin.assets.actors
    )
    return Scenario(name, frames, placements, tracks=twin.log.actors)
