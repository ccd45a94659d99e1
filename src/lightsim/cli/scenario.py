"""`lightsim scenario`: common scenes as a SCENARIO.json, to be simulated or changed by hand."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from lightsim.cli.options import Verbose, say
from lightsim.core.option_types import Names

if TYPE_CHECKING:
    from lightsim.core.log import DrivingLog
    from lightsim.scenario.generators import EgoLane


_AROUND_M = (0.0, 2.0, -2.0, 4.0, -4.0, 6.0, 8.0, 10.0)
"""Places are tried this far from the usual one, until nobody stands in the way."""


def _places(asked_m: float | None, usual_m: float) -> tuple[float, ...]:
    return tuple(usual_m + step for step in _AROUND_M) if asked_m is None else (asked_m,)


@dataclass(frozen=True, kw_only=True)
class _Generator:
    work: tyro.conf.Positional[Path]
    """Work folder of a finished build."""
    out: Path
    """SCENARIO.json to write."""
    lane_width_m: float = 3.5
    """Width of the lanes."""
    sky: str = "source"
    """The sky that SCENARIO.json names."""
    verbose: Verbose = False
    """Show the trace of an error."""

    def _write(
        self,
        make: Callable[[EgoLane, DrivingLog, float], list[dict[str, Any]]],
        places_m: Sequence[float] = (0.0,),
    ) -> None:
        """Write the scene at the first place where nobody stands in the way; if there is none, at
        that with the fewest conflicts."""
        from lightsim.build.workspace import Workspace
        from lightsim.scenario.edits import VERSION, parse_scenario
        from lightsim.scenario.generators import EgoLane
        from lightsim.scenario.replay import replay
        from lightsim.simulation.edited import asset_library, edited_scenario, tell_conflicts
        from lightsim.store.artefact import write_json

        workspace = Workspace(self.work)
        log = workspace.log
        lane = EgoLane.of(log, self.lane_width_m)
        recorded = replay(workspace.twin, self.out.stem, log.frames)
        library = asset_library(None, self.out.parent)
        scenario: dict[str, Any] = {}
        conflicts: tuple[str, ...] | None = None
        for place_m in places_m:
            scene = {"version": VERSION, "name": self.out.stem, "sky": self.sky}
            scene["edits"] = make(lane, log, place_m)
            request = parse_scenario(scene, self.out)
            # A missing asset, or who stands in the way, is told now and not when frames are made.
            odd = edited_scenario(workspace, recorded, request, library).notes
            if conflicts is None or len(odd) < len(conflicts):
                scenario, conflicts = scene, odd
            if not conflicts:
                break
        tell_conflicts(conflicts or (), self.out)
        self.out.parent.mkdir(parents=True, exist_ok=True)
        write_json(self.out, scenario)
        say(f"{len(scenario['edits'])} edits: {self.out}")
        if conflicts:
            say("change the edits (take out who is in the way), or move the scene by its options")
        say(f"next: lightsim simulate {self.work} {self.out}")


@dataclass(frozen=True, kw_only=True)
class CutIn(_Generator):
    """A car of the next lane changes into the ego's."""

    asset: str = "car-red"
    """What drives: a file, a library name, or WORK#actor_id."""
    gap_m: float | None = None
    """Ahead of the ego vehicle at the start, centre to centre; by default 10, or where nobody
    stands in the way, 6 to 20."""
    from_right: bool = False
    """It comes from the right."""
    actor: str = ""
    """Who of the log cuts in, instead of an asset."""

    def run(self) -> None:
        """Write the scenario."""
        from lightsim.scenario.generators import cut_in

        self._write(
            lambda lane, _, gap_m: cut_in(lane, self.asset, gap_m, not self.from_right, self.actor),
            _places(self.gap_m, 10.0),
        )


@dataclass(frozen=True, kw_only=True)
class LaneChange(_Generator):
    """The car ahead leaves the ego's lane."""

    asset: str = "car"
    """What drives."""
    gap_m: float | None = None
    """Ahead of the ego vehicle at the start, centre to centre; by default 15, or where nobody
    stands in the way, 11 to 25."""
    to_right: bool = False
    """It goes to the right."""

    def run(self) -> None:
        """Write the scenario."""
        from lightsim.scenario.generators import lane_change

        self._write(
            lambda lane, _, gap_m: lane_change(lane, self.asset, gap_m, not self.to_right),
            _places(self.gap_m, 15.0),
        )


@dataclass(frozen=True, kw_only=True)
class HardBrake(_Generator):
    """The car ahead brakes to a stop."""

    asset: str = "car"
    """What drives."""
    gap_m: float | None = None
    """Ahead of the ego vehicle at the start, centre to centre; by default 15, or where nobody
    stands in the way, 11 to 25."""
    after_s: float = 0.5
    """When it begins to brake."""

    def run(self) -> None:
        """Write the scenario."""
        from lightsim.scenario.generators import hard_brake

        self._write(
            lambda lane, _, gap_m: hard_brake(lane, self.asset, gap_m, self.after_s),
            _places(self.gap_m, 15.0),
        )


@dataclass(frozen=True, kw_only=True)
class Stalled(_Generator):
    """A vehicle stands in the ego's lane, cones behind it."""

    asset: str = "van"
    """What stands there."""
    ahead_m: float | None = None
    """Ahead of where the ego vehicle is at the end; by default 20, or where nobody stands in the
    way, 16 to 30."""

    def run(self) -> None:
        """Write the scenario."""
        from lightsim.scenario.generators import stalled

        self._write(
            lambda lane, _, ahead_m: stalled(lane, self.asset, ahead_m),
            _places(self.ahead_m, 20.0),
        )


@dataclass(frozen=True, kw_only=True)
class Construction(_Generator):
    """Road works: cones along a taper, barriers, a sign."""

    ahead_m: float = 8.0
    """Where they begin, ahead of where the ego vehicle is at the end."""
    length_m: float = 24.0
    """How far they reach."""
    from_left: bool = False
    """They close the left half of the lane."""
    next_lane: bool = False
    """They close all of the lane beside."""

    def run(self) -> None:
        """Write the scenario."""
        from lightsim.scenario.generators import construction

        self._write(
            lambda lane, *_: construction(
                lane, self.ahead_m, self.length_m, self.from_left, self.next_lane
            )
        )


@dataclass(frozen=True, kw_only=True)
class Replace(_Generator):
    """Others drive where vehicles of the log drove."""

    assets: Names = ("car-red", "van", "car-black")
    """Who drives now, in turn: files, library names, or OTHER_WORK#actor_id."""
    actors: Names = ()
    """Whom they replace; by default the moving vehicles that come nearest to the ego."""
    count: int = 3
    """How many of the nearest."""

    def run(self) -> None:
        """Write the scenario."""
        from lightsim.scenario.generators import replaced

        self._write(
            lambda lane, log, _: replaced(lane, log.actors, self.assets, self.actors, self.count)
        )


@dataclass(frozen=True, kw_only=True)
class ParkedRow(_Generator):
    """Vehicles parked along the road."""

    assets: Names = ("car", "van", "car-black", "car-red")
    """What stands there, in turn."""
    count: int = 5
    """How many."""
    left_m: float = -4.0
    """Offset from the ego's path; negative is right."""

    def run(self) -> None:
        """Write the scenario."""
        from lightsim.scenario.generators import parked_row

        self._write(lambda lane, *_: parked_row(lane, self.assets, self.count, self.left_m))


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
class ScenarioGroup:
    """Write a SCENARIO.json of a common scene, laid out along the ego vehicle's path."""

    scene: tyro.conf.OmitSubcommandPrefixes[tyro.conf.OmitArgPrefixes[Scenarios]]

    def run(self) -> None:
        """Run the chosen command."""
        self.scene.run()
