"""Application of edits to the replayed log."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from difflib import get_close_matches

import numpy as np
from jaxtyping import Float64

from lightsim.core.actors import ActorKind, ActorTrack
from lightsim.core.frames import Trajectory
from lightsim.core.log import DrivingLog
from lightsim.core.mesh import TriMesh
from lightsim.core.scenario import (
    ActorPlacement,
    Scenario,
    ScenarioFrame,
    changed_placements,
    placed_elsewhere,
)
from lightsim.core.twin import ActorAsset
from lightsim.errors import InputError
from lightsim.scenario.edits import EVERY_ACTOR, Edit, Ego, Insert, Move, Remove
from lightsim.scenario.ground import StandingGround
from lightsim.scenario.motion import moved_along, set_on_ground, shifted

AssetSource = Callable[[str], ActorAsset]
"""Returns the asset of a name, with the origin of its mesh at the centre of its box; raises
InputError for an unknown name."""
# Number of actor ids that an error message lists.
_SHOWN = 12
EGO_BODY = (ActorKind.CAR, np.array([4.5, 1.8, 1.5]))
"""Kind and (length, width, height) in metres of the ego vehicle: a medium-sized car, since logs do
not store it. It determines the ground under the wheels and conflicts with other boxes."""
# Time for which the ends of a path are held, in seconds: cameras fire before and after its poses.
_HOLD_S = 0.1
# Largest displacement of a standing actor, in metres: labels of standing actors jitter.
_STANDING_M = 0.3
# Least side of a box, in metres: an inserted card without thickness needs a volume, too.
_THINNEST_M = 0.01


@dataclass
class _Cast:
    """Actors of a scenario while edits are applied."""

    tracks: list[ActorTrack]
    placements: list[ActorPlacement]
    removed: set[str] = field(default_factory=set[str])

    def track(self, actor_id: str, where: str) -> ActorTrack:
        """Return the track of a present actor.

        Raises:
            InputError: the id is unknown, or the actor was removed before.
        """
        by_id = {t.actor_id: t for t in self.tracks if t.actor_id not in self.removed}
        if actor_id in by_id:
            return by_id[actor_id]
        if actor_id in self.removed:
            raise InputError(
                "an edit before this one has removed the actor",
                where=where,
                got=repr(actor_id)[:80],
                remedy="Leave out one of the two edits.",
            )
        near = get_close_matches(actor_id, by_id, n=1, cutoff=0.5)
        listed = [*near, *(a for a in by_id if a not in near)][:_SHOWN]
        more = len(by_id) - len(listed)
        raise InputError(
            "there is no such actor",
            where=where,
            got=repr(actor_id)[:80],
            expected=f"one of {', '.join(listed)}" + (f" and {more} more" if more > 0 else ""),
            remedy="lightsim actors WORK lists them.",
        )

    def put(self, track: ActorTrack, asset: ActorAsset | None) -> None:
        """Add an actor, or replace the track of a present one."""
        numbers = {t.actor_id: n for n, t in enumerate(self.tracks)}
        if track.actor_id in numbers:
            self.tracks[numbers[track.actor_id]] = track
        else:
            self.tracks.append(track)
        self.placements = [p for p in self.placements if p.track.actor_id != track.actor_id]
        if asset is not None:
            self.placements.append(ActorPlacement(asset, track))

    def remove(self, actor_ids: Sequence[str]) -> None:
        """Remove actors; the numbers of all actors are unchanged."""
        # Their tracks stay in the list: numbers of actors are positions in it.
        self.removed |= set(actor_ids)
        self.placements = [p for p in self.placements if p.track.actor_id not in self.removed]


def apply_edits(
    recorded: Scenario,
    edits: Sequence[Edit],
    assets: AssetSource,
    ground: StandingGround,
    log: DrivingLog,
) -> Scenario:
    """Apply edits to the replayed log, one after the other.

    Placements that no edit changes remain the same objects. Their identity later decides which
    parts of frames stay as recorded.

    Raises:
        InputError: an actor or asset is unknown, or a trajectory leaves the time of the log; the
            message names the edit.
    """
    cast = _Cast(list(recorded.tracks), list(recorded.placements))
    times_ns = [frame.time_ns for frame in log.frames]
    span_ns = min(times_ns), max(times_ns)
    ego = recorded.ego
    for edit in edits:
        if isinstance(edit, Remove):
            _remove(cast, edit)
        elif isinstance(edit, Move):
            _move(cast, edit, ground, span_ns)
        elif isinstance(edit, Insert):
            _insert(cast, edit, assets, ground, span_ns)
        else:
            ego = _driven(edit, ego, log, ground, span_ns)
    edited = replace(
        recorded,
        placements=tuple(cast.placements),
        tracks=tuple(cast.tracks),
        removed=frozenset(cast.removed),
        vacated=placed_elsewhere(recorded.placements, cast.placements),
    )
    if ego is not None and ego is not recorded.ego:
        edited = _driven_along(edited, ego)
    return replace(edited, frames=tuple(_with_source(f, recorded, edited) for f in edited.frames))


def driven_beside(scenario: Scenario, offset_m: tuple[float, float, float]) -> Scenario:
    """Return the scenario with the ego path shifted by (ahead, left, up), in metres."""
    assert scenario.ego is not None
    return _driven_along(scenario, shifted(scenario.ego, offset_m))


def _driven_along(scenario: Scenario, ego: Trajectory) -> Scenario:
    """Return the scenario with another ego path."""
    was = scenario.ego
    if was is None:
        return replace(scenario, ego=ego)
    frames = tuple(_seen_from(frame, was, ego) for frame in scenario.frames)
    return replace(scenario, ego=ego, frames=frames)


def _remove(cast: _Cast, edit: Remove) -> None:
    if edit.actor in EVERY_ACTOR:
        there = [t for t in cast.tracks if edit.actor == "all" or t.is_moving]
        cast.remove([t.actor_id for t in there])
    else:
        cast.remove([cast.track(edit.actor, edit.where).actor_id])


def _move(cast: _Cast, edit: Move, ground: StandingGround, span_ns: tuple[int, int]) -> None:
    track = cast.track(edit.actor, edit.where)
    asset = next((p.asset for p in cast.placements if p.track is track), None)
    if asset is None:
        raise InputError(
            "the actor has no reconstructed mesh and cannot be moved",
            where=edit.where,
            got=edit.actor,
            remedy="Remove it, and insert another actor or a model in its place.",
        )
    body = (track.kind, track.size_lwh_m)
    if edit.offset_m is not None:
        path = shifted(track.trajectory, edit.offset_m)
        # Beside its recorded place the ground may have another height; a height in the
        # offset is obeyed.
        if edit.offset_m[2] == 0:
            path = set_on_ground(path, body, ground)
    else:
        path = moved_along(edit.waypoints, span_ns, body, ground, edit.where)
    # The sun visibility from the pictures is valid for the recorded place only.
    free = replace(asset, mesh=replace(asset.mesh, sun_visibility=None))
    cast.put(replace(track, trajectory=path, is_moving=_is_moving(path)), free)


def _insert(
    cast: _Cast,
    edit: Insert,
    assets: AssetSource,
    ground: StandingGround,
    span_ns: tuple[int, int],
) -> None:
    if edit.actor_id in {track.actor_id for track in cast.tracks}:
        raise InputError(
            "an actor with this id exists already",
            where=edit.where,
            got=edit.actor_id,
            expected="a unique 'id'",
        )
    try:
        asset = assets(edit.asset)
    except InputError as error:
        raise InputError(
            error.what,
            where=f"{edit.where}, asset '{edit.asset}'",
            got=error.got,
            expected=error.expected,
            remedy=error.remedy or "lightsim assets list shows all assets.",
        ) from error
    size = box_size_m(asset.mesh)
    path = moved_along(edit.waypoints, span_ns, (asset.kind, size), ground, edit.where)
    # An asset of another twin carries the shadows of that twin's recording.
    free = replace(asset, mesh=replace(asset.mesh, sun_visibility=None))
    track = ActorTrack(edit.actor_id, asset.kind, size, path, _is_moving(path), asset.label)
    cast.put(track, free)


def box_size_m(mesh: TriMesh) -> Float64[np.ndarray, "3"]:
    """Return length, width and height of the box of an inserted mesh, each at least 1 cm."""
    return np.maximum(np.ptp(mesh.vertices.astype(np.float64), axis=0), _THINNEST_M)


def _is_moving(path: Trajectory) -> bool:
    return bool(np.ptp(path.positions_m, axis=0).max() > _STANDING_M)


def _driven(
    edit: Ego,
    ego: Trajectory | None,
    log: DrivingLog,
    ground: StandingGround,
    span_ns: tuple[int, int],
) -> Trajectory:
    """Return the ego path of an edit, at the recorded height above the ground."""
    path = log.ego if ego is None else ego
    if edit.offset_m is not None:
        return shifted(path, edit.offset_m)
    driven = moved_along(edit.waypoints, span_ns, EGO_BODY, ground, edit.where)
    if edit.waypoints[0].z_m is None:
        over = path.positions_m[:, 2] - ground.height_m(path.positions_m[:, :2])
        # The frame `ego` need not lie on the road in all logs: its usual height is measured.
        up_m = float(np.median(over))
    else:
        up_m = 0.0
    # Poses of `driven` are those of the centre of a box, half of its height above the ground.
    bottom = shifted(driven, (0.0, 0.0, up_m - float(EGO_BODY[1][2]) / 2))
    return Trajectory("world", "ego", bottom.times_ns, bottom.matrices)


def _seen_from(frame: ScenarioFrame, recorded: Trajectory, ego: Trajectory) -> ScenarioFrame:
    """Return the frame of the camera on the new ego path, without a rolling shutter, whose motion
    would be that of the recorded drive."""
    where = f"frame {frame.camera_name}/{frame.stem}"
    if not ego.covers(frame.time_ns, _HOLD_S):
        raise InputError(
            "the ego's trajectory does not reach this frame",
            where=where,
            expected="a path over all chosen frames",
            remedy="Give a longer path, or choose --frames.",
        )
    was = recorded.at(frame.time_ns, _HOLD_S)
    now = ego.at(frame.time_ns, _HOLD_S)
    # The camera moves with the vehicle like a rigid body.
    pose = now @ was.inverse() @ frame.world_from_camera
    return replace(frame, world_from_camera=pose, shutter=None, source="rendered")


def _with_source(frame: ScenarioFrame, recorded: Scenario, edited: Scenario) -> ScenarioFrame:
    if frame.source == "rendered" or not changed_placements(recorded, edited, frame.time_ns):
        return frame
    return replace(frame, source="composite")
