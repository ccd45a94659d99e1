"""The scenario of the viewer's edits: boxes and conflicts as `lightsim simulate` has them."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from threading import Lock

import numpy as np
from jaxtyping import Float

from lightsim.app.editing import Edits, insert_asset, move_actor, path_of, remove_actor
from lightsim.build.workspace import Workspace
from lightsim.core.actors import ActorKind, ActorTrack
from lightsim.core.frames import RigidTransform
from lightsim.core.scenario import Scenario
from lightsim.errors import InputError
from lightsim.scenario.conflicts import Conflict, ConflictSearch
from lightsim.scenario.edits import (
    EVERY_ACTOR,
    VERSION,
    Path3,
    Waypoint,
    parse_scenario,
)
from lightsim.simulation.edited import (
    asset_library,
    edited_tracks,
    edited_with_conflicts,
    standing_ground,
)
from lightsim.simulation.options import RelightOptions
from lightsim.simulation.relight import replayed

_OPTIONS = RelightOptions(name="view")
# Origin of the edits in error messages.
_SOURCE = Path("edits")
# Number of edits whose scenarios are cached: those at the start of a drag, the current ones, and
# those of the preview and of the final picture in progress.
_CACHED_SCENARIOS = 4
# Number of poses that are cached, about 10 MB: interpolation takes 1 ms, and in a drag the poses of
# nearly all actors are unchanged.
_CACHED_POSES = 20_000
_Made = tuple[Scenario, tuple[Conflict, ...]]


@dataclass(frozen=True, eq=False)
class ActorBox:
    """Box of an actor at a time.

    Args:
        actor_id: id of the actor.
        world_from_actor: pose of the centre of the box.
        size_lwh_m: length, width and height.
        kind: kind of actor.
        is_edited: True if an edit has inserted or moved the actor.
        has_mesh: False if the actor was not reconstructed; it can be removed, but not moved.
        is_in_conflict: True if the actor is part of a conflict at this time.
    """

    actor_id: str
    world_from_actor: RigidTransform
    size_lwh_m: Float[np.ndarray, "3"]
    kind: ActorKind
    is_edited: bool
    has_mesh: bool
    is_in_conflict: bool


class Editor:
    """Scenarios of one twin for changing edits; log, ground and assets are read once.

    Methods may be called from several threads.
    """

    def __init__(
        self,
        workspace: Workspace,
        options: RelightOptions = _OPTIONS,
        library: Path | None = None,
        beside: Path = Path(),
    ) -> None:
        """
        Args:
            workspace: with the twin.
            options: selection of cameras and frames, image scale and seed; by default those of
                `lightsim simulate` without options.
            library: folder of the asset library; None for the user's.
            beside: folder to which relative paths of assets refer: that of the saved SCENARIO.json.
        """
        self.recorded = replayed(workspace, options)
        """The log without edits. Unchanged actors of edited scenarios are the same objects."""
        self.library = asset_library(library, beside)
        """The assets that can be inserted."""
        times_ns = [frame.time_ns for frame in workspace.log.frames]
        self.span_ns = min(times_ns), max(times_ns)
        """Times of the first and the last picture of the log."""
        self._workspace = workspace
        self._search = ConflictSearch(self.recorded.frames, standing_ground(workspace))
        self._pose = lru_cache(_CACHED_POSES)(ActorTrack.world_from_actor)
        self._lock = Lock()
        self._last: list[tuple[Edits, _Made]] = []

    @property
    def last_s(self) -> float:
        """Time of the last picture, in seconds from the first one."""
        return (self.span_ns[1] - self.span_ns[0]) / 1e9

    @cached_property
    def asset_names(self) -> tuple[str, ...]:
        """Names of the assets: stored ones, then shipped ones."""
        return self.library.names()

    def scenario(self, edits: Edits) -> Scenario:
        """Return the scenario that `lightsim simulate` makes of the edits.

        Raises:
            InputError: an actor or asset is unknown, or an entry is wrong; the message names the
                edit.
        """
        return self._edited(edits)[0]

    def conflicts(self, edits: Edits) -> tuple[str, ...]:
        """Return the conflicts as sentences with the ids of the actors; raises as `scenario`."""
        return tuple(map(str, self._edited(edits)[1]))

    def boxes(self, edits: Edits, time_ns: int) -> dict[str, ActorBox]:
        """Return the boxes of all actors that are present at a time, by id; raises as
        `scenario`."""
        scenario, conflicts = self._edited(edits)
        edited = {track.actor_id for track in edited_tracks(self.recorded, scenario)}
        with_mesh = {placement.track.actor_id for placement in scenario.placements}
        now = [conflict for conflict in conflicts if self._is_during(conflict, time_ns)]
        in_conflict = {name for conflict in now for name in (conflict.actor_id, conflict.other_id)}
        return {
            track.actor_id: ActorBox(
                track.actor_id,
                self._pose(track, time_ns),
                track.size_lwh_m,
                track.kind,
                is_edited=track.actor_id in edited,
                has_mesh=track.actor_id in with_mesh,
                is_in_conflict=track.actor_id in in_conflict,
            )
            for track in scenario.tracks_at(time_ns)
        }

    def track(self, edits: Edits, actor_id: str) -> ActorTrack:
        """Return the track of an actor, also of a removed one; raises as `scenario`.

        Raises:
            InputError: there is no such actor.
        """
        tracks = {track.actor_id: track for track in self.scenario(edits).tracks}
        if actor_id not in tracks:
            raise InputError(
                "there is no such actor",
                where="edits of the viewer",
                got=repr(actor_id)[:80],
                expected="an actor of the log or an inserted one",
            )
        return tracks[actor_id]

    def path(self, edits: Edits, actor_id: str) -> Path3:
        """Return the waypoints of an actor (`editing.path_of`); raises as `track`."""
        return path_of(edits, self.track(edits, actor_id), self.span_ns)

    def move(self, edits: Edits, actor_id: str, time_ns: int, place: Waypoint) -> Edits:
        """Return edits in which an actor has a pose at a time (`editing.move_actor`); raises as
        `track`."""
        return move_actor(edits, self.track(edits, actor_id), self.span_ns, time_ns, place)

    def insert(self, edits: Edits, asset: str, place: Waypoint) -> tuple[Edits, str]:
        """Return edits with a standing asset, and its id (`editing.insert_asset`)."""
        taken = {track.actor_id for track in self.recorded.tracks}
        return insert_asset(edits, asset, place, taken)

    def without_groups(self, edits: Edits) -> Edits:
        """Replace "all" and "all-moving" by one removal of each actor, so that single actors can be
        restored; raises as `scenario`."""
        for number, edit in enumerate(edits):
            if edit["do"] == "remove" and edit["actor"] in EVERY_ACTOR:
                before, after = edits[:number], edits[number + 1 :]
                scenario = self.scenario(before)
                there = (t for t in scenario.tracks if t.actor_id not in scenario.removed)
                for track in there:
                    if edit["actor"] == "all" or track.is_moving:
                        before = remove_actor(before, track.actor_id)
                return self.without_groups((*before, *after))
        return edits

    def _edited(self, edits: Edits) -> _Made:
        """Return the scenario of edits and its conflicts; recent results are cached."""
        if not edits:
            return self.recorded, ()
        with self._lock:
            found = next((made for key, made in self._last if key == edits), None)
            if found is None:
                found = self._made(edits)
            others = [kept for kept in self._last if kept[0] != edits]
            self._last = [(edits, found), *others][:_CACHED_SCENARIOS]
            return found

    def _made(self, edits: Edits) -> _Made:
        value = {"version": VERSION, "name": self.recorded.name, "edits": list(edits)}
        asked = parse_scenario(value, _SOURCE)
        return edited_with_conflicts(
            self._workspace, self.recorded, asked, self.library, self._search
        )

    def _is_during(self, conflict: Conflict, time_ns: int) -> bool:
        """Return whether a time lies within the frames of a conflict."""
        first, last = conflict.stems
        return self._span_by_stem[first][0] <= time_ns <= self._span_by_stem[last][1]

    @cached_property
    def _span_by_stem(self) -> Mapping[str, tuple[int, int]]:
        """First and last time of the frames of each stem."""
        times_ns: dict[str, list[int]] = defaultdict(list)
        for frame in self.recorded.frames:
            times_ns[frame.stem].append(frame.time_ns)
        return {stem: (min(times), max(times)) for stem, times in times_ns.items()}
