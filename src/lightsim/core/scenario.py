"""What is rendered: which frames, with which actors where."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

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
    """Frames to render and the actors in them.

    Args:
        name: of the scenario.
        frames: to render.
        placements: actors that have a shape.
        edits: what differs from the log.
        seed: of all random numbers.
        tracks: all actors, those that nobody reconstructed too; their order is the one numbering
            of actors in buffers and files. By default those of the placements.
    """

    name: str
    frames: tuple[CameraFrame, ...]
    placements: tuple[ActorPlacement, ...]
    edits: tuple[str, ...] = ()
    seed: int = 0
    tracks: tuple[ActorTrack, ...] = ()

    def __post_init__(self) -> None:
        if not self.tracks:
            object.__setattr__(self, "tracks", tuple(p.track for p in self.placements))

    @cached_property
    def number_by_actor(self) -> dict[str, int]:
        """The number of every actor, the same in all frames."""
        return {track.actor_id: number for number, track in enumerate(self.tracks)}

    def placements_at(self, time_ns: int) -> tuple[ActorPlacement, ...]:
        """Actors present at a time, in the order of the placements."""
        return tuple(p for p in self.placements if p.track.is_present(time_ns))

    def tracks_at(self, time_ns: int) -> tuple[ActorTrack, ...]:
        """All actors present at a time."""
        return tuple(track for track in self.tracks if track.is_present(time_ns))
