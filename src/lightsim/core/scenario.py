"""What is rendered: which frames, with which actors where."""

from __future__ import annotations

from dataclasses import dataclass

from lightsim.core.actors import ActorTrack
from lightsim.core.frames import RigidTransform
from lightsim.core.sensors import CameraFrame
from lightsim.core.twin import ActorAsset


@dataclass(frozen=True, eq=False)
class ActorPlacement:
    """An asset and the track it follows."""

    asset: ActorAsset
    track: ActorTrack

    def world_from_actor(self, time_ns: int) -> RigidTransform:
        return self.track.world_from_actor(time_ns)


@dataclass(frozen=True, eq=False)
class Scenario:
    """Frames to render and the actors in them. `edits` names what differs from the log."""

    name: str
    frames: tuple[CameraFrame, ...]
    placements: tuple[ActorPlacement, ...]
    edits: tuple[str, ...] = ()
    seed: int = 0

    def placements_at(self, time_ns: int) -> tuple[ActorPlacement, ...]:
        """Actors present at a time, in a fixed order: actor_index of the buffers counts here."""
        return tuple(p for p in self.placements if p.track.is_present(time_ns))
