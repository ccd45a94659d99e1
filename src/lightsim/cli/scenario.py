"""`lightsim scenario`: common scenes as a SCENARIO.json, to be simulated or changed by hand."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from lightsim.arguments import Names
from lightsim.cli.options import Verbose, say

if TYPE_CHECKING:
    from lightsim.core.log import DrivingLog
    from lightsim.scenario.generators import EgoLane


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

    def _write(self, make: Callable[[EgoLane, DrivingLog], list[dict[str, Any]]]) -> None:
        from lightsim.pipeline.workspace import Workspace
        from lightsim.scenario.edits import VERSION, parse_scenario
        from lightsim.scenario.generators import EgoLane
        from lightsim.scenario.replay import replay
        from lightsim.simulation.edited import asset_library, edited_scenario
        from lightsim.store.artefact import write_json

        workspace = Workspace(self.work)
        log = workspace.log
        edits = make(EgoLane.of(log, self.lane_width_m), log)
        scenario = {"version": VERSION, "name": self.out.stem, "sky": self.sky, "edits": edits}
        request = parse_scenario(scenario, self.out)
        # A missing asset, or who stands in the way, is told now and not when frames are made.
        recorded = replay(workspace.twin, request.name, log.frames)
        library = asset_library(None, self.out.parent)
        odd = edited_scenario(workspace, recorded, request, library).notes
        self.out.parent.mkdir(parents=True, exist_ok=True)
        write_json(self.out, scenario)
        say(f"{len(edits)} edits: {self.out}")
        if odd:
            say("change the edits (take out who is in the way), or move the scene by its options")
        say(f"next: lightsim simulate {self.work} {self.out}")


@dataclass(frozen=True, kw_only=True)
class CutIn(_Generator):
    """A car of the next lane changes into the ego's."""

    asset: str = "car-red"
    """What drives: a file, a library name, or WORK#actor_id."""
    gap_m: float = 10.0
    """Ahead of the ego vehicle at the start, centre to centre."""
    from_right: bool = False
    """It comes from the right."""
    actor: str = ""
    """Who of the log cuts in, instead of an asset."""

    def run(self) -> None:
        """Write the scenario."""
        from lightsim.scenario.generators import cut_in

        self._write(
            lambda lane, _: cut_in(lane, self.asset, self.gap_m, not self.from_right, self.actor)
        )


@dataclass(frozen=True, kw_only=True)
class LaneChange(_Generator):
    """The car ahead leaves the ego's lane."""

    asset: str = "car"
    """What drives."""
    gap_m: float = 15.0
    """Ahead of the ego vehicle at the start, centre to centre."""
    to_right: bool = False
    """It goes to the right."""

    def run(self) -> None:
        """Write the scenario."""
        from lightsim.scenario.generators import lane_change

        self._write(lambda lane, _: lane_change(lane, self.asset, self.gap_m, not self.to_right))


@dataclass(frozen=True, kw_only=True)
class HardBrake(_Generator):
    """The car ahead brakes to a stop."""

    asset: str = "car"
    """What drives."""
    gap_m: float = 15.0
    """Ahead of the ego vehicle at the start, centre to centre."""
    after_s: float = 0.5
    """When it begins to brake."""

    def run(self) -> None:
        """Write the scenario."""
        from lightsim.scenario.generators import hard_brake

        self._write(lambda lane, _: hard_brake(lane, self.asset, self.gap_m, self.after_s))


@dataclass(frozen=True, kw_only=True)
class Stalled(_Generator):
    """A vehicle stands in the ego's lane, cones behind it."""

    asset: str = "van"
    """What stands there."""
    ahead_m: float = 20.0
    """Ahead of where the ego vehicle is at the end."""

    def run(self) -> None:
        """Write the scenario."""
        from lightsim.scenario.generators import stalled

        self._write(lambda lane, _: stalled(lane, self.asset, self.ahead_m))


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
            lambda lane, _: construction(
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
            lambda lane, log: replaced(lane, log.actors, self.assets, self.actors, self.count)
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

        self._write(lambda lane, _: parked_row(lane, self.assets, self.count, self.left_m))


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
