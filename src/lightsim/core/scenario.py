"""Description of a rendering: its frames, sky and actors with their poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, Literal, get_args

import numpy as np

from lightsim.core.actors import ActorTrack
from lightsim.core.camera import PinholeCamera
from lightsim.core.checks import check_choice
from lightsim.core.frames import RigidTransform, Trajectory
from lightsim.core.mesh import TriMesh
from lightsim.core.sensors import CameraFrame
from lightsim.core.sky_choice import SkyChoice
from lightsim.core.twin import ActorAsset

FrameSource = Literal["recorded", "rendered", "composite"]
"""Source of a frame's pixels before relighting: the camera's picture, a rendering of the twin, or
the picture with rendered parts in it."""


@dataclass(frozen=True, eq=False)
class ActorPlacement:
    """An asset and the track it follows."""

    asset: ActorAsset
    track: ActorTrack

    def world_from_actor(self, time_ns: int) -> RigidTransform:
        """Pose at a time."""
        return self.track.world_from_actor(time_ns)

    def mesh_at(self, time_ns: int) -> TriMesh:
        """Return the asset's mesh in frame `world` at a time, with rotated wheels.

        The rotation corresponds to the distance travelled since the start of the track.
        """
        mesh = self.asset.mesh
        if self.asset.wheels:
            distance_m = self.track.trajectory.distance_ahead_m(time_ns)
            vertices = mesh.vertices
            for wheel in self.asset.wheels:
                vertices = wheel.turned(vertices, distance_m)
            mesh = replace(mesh, vertices=vertices)
        return mesh.transformed(self.world_from_actor(time_ns))


@dataclass(frozen=True, eq=False)
class ScenarioFrame(CameraFrame):
    """A frame to make; `load_srgb8` loads the recorded image of its stem, whatever the source.

    Raises:
        InputError: there is no such source.
    """

    source: FrameSource = field(kw_only=True)

    def __post_init__(self) -> None:
        check_choice(f"frame {self.camera_name}/{self.stem}", self.source, get_args(FrameSource))

    @staticmethod
    def of(frame: CameraFrame, source: FrameSource) -> ScenarioFrame:
        """Return a frame of the log, to be made from `source`."""
        values = {f.name: getattr(frame, f.name) for f in fields(CameraFrame)}
        return ScenarioFrame(**values, source=source)


@dataclass(frozen=True, eq=False)
class Scenario:
    """Frames to make, the sky over them and the actors in them.

    Args:
        name: of the scenario.
        frames: to make.
        placements: actors that have a shape.
        tracks: all actors, including those without a reconstruction; by default those of the
            placements. Their order is the numbering of actors in buffers and files.
        cameras: by name, those of the frames.
        ego: path of the ego vehicle, `world_from_ego`; None if it is not needed.
        sky: target sky; None where only geometry is rendered.
        edits: differences from the log in the form of SCENARIO.json; placements and ego include
            them.
        seed: of all random numbers.
        removed: ids of removed tracks; the numbers of other tracks are unchanged.
        vacated: recorded placements of actors that were moved or removed; their recorded shadows
            disappear.
        notes: unusual facts, such as two actors in one place.
    """

    name: str
    frames: tuple[ScenarioFrame, ...]
    placements: tuple[ActorPlacement, ...]
    tracks: tuple[ActorTrack, ...] = ()
    cameras: Mapping[str, PinholeCamera] = field(default_factory=dict[str, PinholeCamera])
    ego: Trajectory | None = None
    sky: SkyChoice | None = None
    edits: tuple[Mapping[str, Any], ...] = ()
    seed: int = 0
    removed: frozenset[str] = frozenset()
    vacated: tuple[ActorPlacement, ...] = ()
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not self.tracks:
            object.__setattr__(self, "tracks", tuple(p.track for p in self.placements))

    @cached_property
    def number_by_actor(self) -> dict[str, int]:
        """Number of each actor, the same in all frames."""
        return {track.actor_id: number for number, track in enumerate(self.tracks)}

    def placements_at(self, time_ns: int) -> tuple[ActorPlacement, ...]:
        """Return the placements of actors that are present at a time."""
        return tuple(p for p in self.placements if p.track.is_present(time_ns))

    def tracks_at(self, time_ns: int) -> tuple[ActorTrack, ...]:
        """Return all actors that are present at a time."""
        there = (t for t in self.tracks if t.actor_id not in self.removed)
        return tuple(track for track in there if track.is_present(time_ns))


def placed_elsewhere(
    recorded: Sequence[ActorPlacement], placements: Sequence[ActorPlacement]
) -> tuple[ActorPlacement, ...]:
    """Return the recorded placements of actors that are removed or follow another track."""
    # Tracks are compared by their poses: an edit may replace a track by an equal one.
    tracks = {p.track.actor_id: p.track for p in placements}
    return tuple(
        p
        for p in recorded
        if p.track.actor_id not in tracks or not _is_same(p.track, tracks[p.track.actor_id])
    )


def _is_same(a: ActorTrack, b: ActorTrack) -> bool:
    if a is b:
        return True
    one, other = a.trajectory, b.trajectory
    is_same = np.array_equal(one.times_ns, other.times_ns)
    return is_same and np.array_equal(one.matrices, other.matrices)


def changed_placements(
    recorded: Scenario, scenario: Scenario, time_ns: int
) -> tuple[tuple[ActorPlacement, ...], tuple[ActorPlacement, ...]] | None:
    """Return the placements at a time that only the recorded scenario has, and those that only the
    other scenario has; None if both are equal."""
    # By identity: edits leave the objects of unchanged placements as they are (scenario/apply.py),
    # and meshes are too large to compare. Presence is tested last, for the few that differ.
    kept = {id(p) for p in recorded.placements} & {id(p) for p in scenario.placements}
    removed, new = (
        tuple(p for p in every if id(p) not in kept and p.track.is_present(time_ns))
        for every in (recorded.placements, scenario.placements)
    )
    return (removed, new) if removed or new else None
