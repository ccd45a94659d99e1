"""Search for a free position of a generated scene that the front cameras observe."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from lightsim.build.workspace import Workspace
from lightsim.core.actors import ActorTrack
from lightsim.core.scenario import Scenario
from lightsim.scenario.apply import apply_edits
from lightsim.scenario.asset_library import AssetLibrary
from lightsim.scenario.conflicts import Conflict, ConflictSearch
from lightsim.scenario.edits import VERSION, parse_scenario
from lightsim.scenario.front_view import FrontView
from lightsim.scenario.generators import Edits
from lightsim.scenario.layouts import Layout
from lightsim.scenario.replay import replay
from lightsim.simulation.edited import edited_tracks, standing_ground


@dataclass(frozen=True)
class PlacedScene:
    """A scene at one place.

    Args:
        edits: in the form of SCENARIO.json.
        options: command-line options that reproduce this place.
        blockers: actors of the log that overlap the scene and can be removed.
        fixed: conflicts with walls, unmeasured ground, the ego vehicle or another part of the
            scene, which cannot be removed.
        unseen: vehicles and persons of the scene that are visible in no forward camera at any time.
    """

    edits: Edits
    options: str
    blockers: tuple[str, ...] = ()
    fixed: tuple[Conflict, ...] = ()
    unseen: tuple[str, ...] = ()

    @property
    def is_free(self) -> bool:
        """True if the scene has no conflict and is visible in cameras."""
        return not (self.blockers or self.fixed or self.unseen)

    @property
    def _faults(self) -> tuple[int, int, int]:
        """Counts of faults, compared in order of severity: fixed conflicts remain, an invisible
        scene is useless, blockers can be removed."""
        return len(self.fixed), len(self.unseen), len(self.blockers)

    def is_better_than(self, other: PlacedScene | None) -> bool:
        """Return True if the scene has less severe faults than the other, or there is no other."""
        return other is None or self._faults < other._faults

    def with_conflict(self, conflict: Conflict, edited: Collection[str]) -> PlacedScene:
        """Return the scene with one conflict more.

        Args:
            edited: ids of new and moved actors, which are parts of the scene.
        """
        if conflict.cause != "actor" or conflict.other_id in edited:
            return replace(self, fixed=(*self.fixed, conflict))
        return replace(self, blockers=tuple(dict.fromkeys((*self.blockers, conflict.other_id))))

    def without_blockers(self) -> PlacedScene:
        """Return the same scene after its blockers are removed from the log."""
        removals: Edits = [{"do": "remove", "actor": actor_id} for actor_id in self.blockers]
        return replace(self, edits=[*removals, *self.edits], blockers=())


class PlaceSearch:
    """Tests layouts of scenes in one twin; geometry, actors and views are set up once."""

    def __init__(self, workspace: Workspace, library: AssetLibrary, source: Path) -> None:
        """
        Args:
            workspace: with the twin.
            library: with the assets.
            source: path of the SCENARIO.json, for error messages.
        """
        self._log, self._library, self._source = workspace.log, library, source
        self._ground = standing_ground(workspace)
        assert self._ground.background is not None
        self._view = FrontView(self._log, self._ground.background, self._log.actors)
        self._every = replay(workspace.twin, source.stem, self._log.frames)
        # The times of one camera show nearly all conflicts; a layout that is free at these times is
        # tested at all times.
        seen = self._log.frames_of(self._view.camera_names[0])
        self._some = replay(workspace.twin, source.stem, seen)
        self._search_every, self._search_some = (
            ConflictSearch(scenario.frames, self._ground) for scenario in (self._every, self._some)
        )

    def find(self, make: Callable[..., Edits], layouts: Iterable[Layout]) -> PlacedScene:
        """Return the first free layout; if none is, the one with the fewest faults.

        Args:
            make: returns the edits of a layout's values.

        Raises:
            InputError: an asset or actor is unknown.
        """
        best: PlacedScene | None = None
        for layout in layouts:
            edits = make(**layout.values)
            found = self._tried(edits, layout.options, self._some, self._search_some, best)
            if found is not None and found.is_better_than(best):
                # Other cameras expose between these times.
                found = self._tried(edits, layout.options, self._every, self._search_every, best)
                best = found if found is not None and found.is_better_than(best) else best
            if best is not None and best.is_free:
                break
        assert best is not None, "a scene has one layout or more"
        return best

    def _tried(
        self,
        edits: Edits,
        options: str,
        recorded: Scenario,
        search: ConflictSearch,
        best: PlacedScene | None,
    ) -> PlacedScene | None:
        """Return the scene at one place; None if it is not better than the best place."""
        scene: dict[str, Any] = {"version": VERSION, "edits": edits}
        request = parse_scenario(scene, self._source)
        scenario = apply_edits(recorded, request.edits, self._library.load, self._ground, self._log)
        edited = edited_tracks(recorded, scenario)
        # Conflicts between parts of the scene cannot be resolved by removing actors of the log.
        names = {track.actor_id for track in edited}
        found = PlacedScene(edits, options)
        for conflict in search.each(scenario, edited):
            found = found.with_conflict(conflict, names)
            # Faults only accumulate, so the search ends as soon as a place is worse than the best.
            if not found.is_better_than(best):
                return None
        if not found.is_better_than(best):
            return None
        blockers = set(found.blockers)
        return replace(found, unseen=self._unseen(edited, blockers | scenario.removed))

    def _unseen(self, edited: Sequence[ActorTrack], removed: set[str]) -> tuple[str, ...]:
        """Return the vehicles and persons that are visible in no camera; for a scene without them,
        all invisible parts if they are more than half."""
        about = [t for t in edited if t.kind.is_vehicle or not t.kind.is_rigid_body]
        hidden = [t.actor_id for t in about or edited if not self._view.sees(t, removed)]
        return tuple(hidden) if about or 2 * len(hidden) > len(edited) else ()
