"""`lightsim scenario`: writes a SCENARIO.json of a common scene, to be simulated or edited."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from lightsim.cli.options import CommandGroup, Verbose, WorkFolder, print_line, program
from lightsim.core.option_types import Names

if TYPE_CHECKING:
    from lightsim.core.log import DrivingLog
    from lightsim.scenario.layouts import Choice
    from lightsim.simulation.placing import PlacedScene

# Largest distance along the path of a tested place, in metres: there a car is 30 pixels wide in a
# picture of 960 pixels and 60 degrees.
_FARTHEST_M = 60.0


@dataclass(frozen=True, kw_only=True)
class _Generator:
    work: WorkFolder
    """Work folder of a finished build."""
    out: Path
    """SCENARIO.json to write."""
    remove_blockers: bool = False
    """If no place is free, remove the actors of the log that block the scene."""
    lane_width_m: float = 3.5
    """Width of the lanes."""
    sky: str = "source"
    """Sky in SCENARIO.json, as for lightsim simulate --sky."""
    verbose: Verbose = False

    def _write(
        self,
        make: Callable[..., list[dict[str, Any]]],
        choices: Callable[[DrivingLog], Mapping[str, Sequence[Choice]]],
    ) -> None:
        """Write the scene at the first free place, or at the place with the fewest faults.

        Args:
            make: returns the edits from the ego lane, the log and the values of a layout.
            choices: returns the values to test of each parameter of the scene, by name.
        """
        from lightsim.build.workspace import Workspace
        from lightsim.scenario.edits import VERSION
        from lightsim.scenario.generators import EgoLane
        from lightsim.scenario.layouts import layouts
        from lightsim.simulation.edited import asset_library
        from lightsim.simulation.placing import PlaceSearch
        from lightsim.store.artefact import write_json

        workspace = Workspace(self.work)
        log = workspace.log
        lane = EgoLane.of(log, self.lane_width_m)
        tried = layouts(choices(log))
        search = PlaceSearch(workspace, asset_library(None, self.out.parent), self.out)
        placed = search.find(partial(make, lane, log), tried)
        # The first layout tested has the default values: the usual place.
        self._print_findings(placed, is_usual=placed.options == tried[0].options)
        if self.remove_blockers:
            placed = placed.without_blockers()
        scene = {"version": VERSION, "name": self.out.stem, "sky": self.sky, "edits": placed.edits}
        self.out.parent.mkdir(parents=True, exist_ok=True)
        write_json(self.out, scene)
        count = len(placed.edits)
        print_line(f"{count} {'edit' if count == 1 else 'edits'}: {self.out}")
        print_line(f"next: {program()} {shlex.join(['simulate', str(self.work), str(self.out)])}")

    def _print_findings(self, placed: PlacedScene, *, is_usual: bool) -> None:
        """Print the place of the scene if it is not the usual one, and its conflicts."""
        from lightsim.simulation.edited import report_conflicts

        report_conflicts([str(conflict) for conflict in placed.fixed], self.out)
        in_way = (
            ["an obstacle that cannot be removed blocks every tried place"] if placed.fixed else []
        )
        if placed.blockers:
            in_way.append(_blockers_line(placed.blockers, is_removing=self.remove_blockers))
        if in_way:
            print_line("no free place; " + "; ".join(in_way))
        if placed.unseen:
            print_line(f"no forward camera sees {', '.join(placed.unseen)}")
        if not is_usual:
            print_line(f"not at the usual place, but at: {placed.options}")


def _blockers_line(blockers: Sequence[str], *, is_removing: bool) -> str:
    named = ", ".join(blockers)
    if is_removing:
        return f"removed from the log: {named}"
    if len(blockers) == 1:
        return f"1 actor blocks the place: {named}; add --remove-blockers to remove it"
    count = len(blockers)
    return f"{count} actors block the place: {named}; add --remove-blockers to remove them"


@dataclass(frozen=True, kw_only=True)
class CutIn(_Generator):
    """A car of the next lane changes into the ego's."""

    asset: str = "car-red"
    """Asset of the car: a file, a library name, or WORK#actor_id."""
    gap_m: float | None = None
    """Distance ahead of the ego vehicle at the start, centre to centre, in metres; by default 10,
    or the nearest free distance from 6 to 60."""
    from_left: bool = False
    """It comes from the left; by default from the left, or from the right if only that is free."""
    from_right: bool = False
    """It comes from the right."""
    actor: str = ""
    """Id of an actor of the log that cuts in, instead of an asset."""

    def run(self) -> None:
        """Write the scenario."""
        from lightsim.scenario.generators import cut_in
        from lightsim.scenario.layouts import outwards, sides

        self._write(
            lambda lane, _, **at: cut_in(lane, self.asset, actor_id=self.actor, **at),
            lambda _: {
                "gap_m": outwards(self.gap_m, 10.0, (6.0, _FARTHEST_M), 1.0),
                "from_left": sides(self.from_left, self.from_right, usually_left=True),
            },
        )


@dataclass(frozen=True, kw_only=True)
class LaneChange(_Generator):
    """The car ahead leaves the ego's lane."""

    asset: str = "car"
    """Asset of the car."""
    gap_m: float | None = None
    """Distance ahead of the ego vehicle at the start, centre to centre, in metres; by default 15,
    or the nearest free distance from 6 to 60."""
    to_left: bool = False
    """It goes to the left; by default to the left, or to the right if only that is free."""
    to_right: bool = False
    """It goes to the right."""

    def run(self) -> None:
        """Write the scenario."""
        from lightsim.scenario.generators import lane_change
        from lightsim.scenario.layouts import outwards, sides

        self._write(
            lambda lane, _, **at: lane_change(lane, self.asset, **at),
            lambda _: {
                "gap_m": outwards(self.gap_m, 15.0, (6.0, _FARTHEST_M), 1.0),
                "to_left": sides(self.to_left, self.to_right, usually_left=True),
            },
        )


@dataclass(frozen=True, kw_only=True)
class HardBrake(_Generator):
    """The car ahead brakes to a stop."""

    asset: str = "car"
    """Asset of the car."""
    gap_m: float | None = None
    """Distance ahead of the ego vehicle at the start, centre to centre, in metres; by default 15,
    or the nearest free distance from 6 to 60."""
    after_s: float = 0.5
    """Time at which it begins to brake, in seconds."""

    def run(self) -> None:
        """Write the scenario."""
        from lightsim.scenario.generators import hard_brake
        from lightsim.scenario.layouts import outwards

        self._write(
            lambda lane, _, **at: hard_brake(lane, self.asset, after_s=self.after_s, **at),
            lambda _: {"gap_m": outwards(self.gap_m, 15.0, (6.0, _FARTHEST_M), 1.0)},
        )


@dataclass(frozen=True, kw_only=True)
class Stalled(_Generator):
    """A vehicle is stalled in the ego's lane, cones behind it."""

    asset: str = "van"
    """Asset of the vehicle."""
    ahead_m: float | None = None
    """Distance ahead of the ego vehicle's last position, in metres; by default 20, or the nearest
    free distance from 12 to 60."""
    left_m: float | None = None
    """Offset from the middle of the lane, in metres; negative is right. By default 0, or the
    nearest free offset up to 1 on either side."""

    def run(self) -> None:
        """Write the scenario."""
        from lightsim.scenario.generators import stalled
        from lightsim.scenario.layouts import outwards

        self._write(
            lambda lane, _, **at: stalled(lane, self.asset, **at),
            lambda _: {
                "ahead_m": outwards(self.ahead_m, 20.0, (12.0, _FARTHEST_M), 1.0),
                "left_m": outwards(self.left_m, 0.0, (-1.0, 1.0), 0.5, cost_m=3.0),
            },
        )


@dataclass(frozen=True, kw_only=True)
class Construction(_Generator):
    """Road works: cones along a taper, barriers, a sign."""

    ahead_m: float | None = None
    """Distance of their start ahead of the ego vehicle's last position, in metres; by default 8, or
    the nearest free distance from 4 to 60."""
    length_m: float | None = None
    """Length in metres; by default 24, or the longest free length down to 12."""
    from_left: bool = False
    """They close the left half of the lane; by default the right half, or the left half if only
    that is free."""
    from_right: bool = False
    """They close the right half of the lane."""
    next_lane: bool = False
    """They close the whole adjacent lane."""

    def run(self) -> None:
        """Write the scenario."""
        from lightsim.scenario.generators import construction
        from lightsim.scenario.layouts import Choice, outwards, sides

        next_lane = [Choice(True)] if self.next_lane else [Choice(False), Choice(True, 12.0)]
        self._write(
            lambda lane, _, **at: construction(lane, **at),
            lambda _: {
                "ahead_m": outwards(self.ahead_m, 8.0, (4.0, _FARTHEST_M), 2.0),
                "length_m": outwards(self.length_m, 24.0, (12.0, 24.0), 4.0, cost_m=6.0),
                "from_left": sides(self.from_left, self.from_right, usually_left=False),
                "is_next_lane": next_lane,
            },
        )


@dataclass(frozen=True, kw_only=True)
class Replace(_Generator):
    """Replace vehicles of the log by others on the same paths."""

    assets: Names = ("car-red", "van", "car-black")
    """Assets of the new vehicles, in turn: files, library names, or OTHER_WORK#actor_id."""
    actors: Names = ()
    """Ids of the vehicles to replace; by default the moving vehicles that come nearest to the ego,
    or farther ones if the nearest are not visible or the assets do not fit."""
    count: int | None = None
    """Number of the nearest vehicles; by default 3, or fewer if no more are free."""

    def run(self) -> None:
        """Write the scenario."""
        from lightsim.scenario.generators import EgoLane, nearest_movers, replaced
        from lightsim.scenario.layouts import Choice

        def choices(log: DrivingLog) -> Mapping[str, Sequence[Choice]]:
            lane = EgoLane.of(log, self.lane_width_m)
            movers = [t.actor_id for t in nearest_movers(lane, log.actors)]
            chosen = [Choice(self.actors)] if self.actors else _groups(movers, self.count)
            turns = [
                Choice(self.assets[k:] + self.assets[:k], float(k))
                for k in range(max(1, len(self.assets)))
            ]
            return {"actors": chosen, "assets": turns}

        self._write(
            lambda lane, log, assets, actors: replaced(lane, log.actors, assets, actors, count=0),
            choices,
        )


def _groups(nearest: Sequence[str], count: int | None) -> list[Choice]:
    """Return groups of the nearest actors, the largest groups first; one empty group if there are
    no actors."""
    from lightsim.scenario.layouts import Choice

    most = max(0, min(3 if count is None else count, len(nearest)))
    least = most if count is not None else min(1, most)
    return [
        Choice(tuple(nearest[k : k + size]), 10.0 * (most - size) + 3.0 * k)
        for size in range(most, least - 1, -1)
        for k in range(len(nearest) - size + 1)
    ]


@dataclass(frozen=True, kw_only=True)
class ParkedRow(_Generator):
    """Vehicles parked along the road."""

    assets: Names = ("car", "van", "car-black", "car-red")
    """Assets of the vehicles, in turn."""
    count: int | None = None
    """Number of vehicles; by default 5, or fewer if no more are free."""
    ahead_m: float | None = None
    """Distance of the first vehicle ahead of the ego vehicle's first position, in metres; by
    default 6, or the nearest free distance from 0 to 60."""
    left_m: float | None = None
    """Offset from the ego's path, in metres; negative is right. By default -4, or the nearest free
    offset of 2.5 to 6 on either side."""

    def run(self) -> None:
        """Write the scenario."""
        from lightsim.scenario.generators import parked_row
        from lightsim.scenario.layouts import OTHER_SIDE_M, Choice, outwards

        right = outwards(self.left_m, -4.0, (-6.0, -2.5), 0.5, cost_m=2.0)
        left = (
            [Choice(-c.value, c.cost_m + OTHER_SIDE_M) for c in right]
            if self.left_m is None
            else []
        )
        fewer = [Choice(n, 8.0 * (5 - n)) for n in (5, 4, 3, 2)]
        self._write(
            lambda lane, _, **at: parked_row(lane, self.assets, **at),
            lambda _: {
                "ahead_m": outwards(self.ahead_m, 6.0, (0.0, _FARTHEST_M), 3.0),
                "left_m": right + left,
                "count": fewer if self.count is None else [Choice(self.count)],
            },
        )


Scenarios = (
    Annotated[CutIn, tyro.conf.subcommand("cut-in")]
    | Annotated[LaneChange, tyro.conf.subcommand("lane-change")]
    | Annotated[HardBrake, tyro.conf.subcommand("hard-brake")]
    | Annotated[Stalled, tyro.conf.subcommand("stalled")]
    | Annotated[Construction, tyro.conf.subcommand("construction")]
    | Annotated[Replace, tyro.conf.subcommand("replace")]
    | Annotated[ParkedRow, tyro.conf.subcommand("parked-row")]
)


@dataclass(frozen=True)
class ScenarioGroup(CommandGroup):
    """Write a SCENARIO.json of a common scene, laid out along the ego vehicle's path."""

    do: tyro.conf.OmitSubcommandPrefixes[tyro.conf.OmitArgPrefixes[Scenarios]]
