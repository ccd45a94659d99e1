"""`lightsim evaluate`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from lightsim.cli.options import Verbose, say, show
from lightsim.errors import InputError
from lightsim.progress import terminal_progress


@dataclass(frozen=True)
class EvaluateFrames:
    """Held-out images: the twin rendered under its source sky against the camera."""

    work: tyro.conf.Positional[Path]
    """Work folder built with --hold-out."""
    field: bool = False
    """Also volume-render the neural field (seconds a frame)."""
    out: Path | None = None
    """Also write the table as JSON here."""
    verbose: Verbose = False
    """Show the trace of an error."""

    def run(self) -> None:
        """Measure held-out frames."""
        from lightsim.pipeline.measures import held_out_frames
        from lightsim.pipeline.workspace import Workspace

        report = held_out_frames(Workspace(self.work), terminal_progress(), with_field=self.field)
        show(report, self.out)


@dataclass(frozen=True)
class EvaluateRelight:
    """Relit frames against ground truth, beside the trivial baselines."""

    work: tyro.conf.Positional[Path]
    """Work folder."""
    truth: Path
    """Ground truth of a synthetic log: the folder `truth` that `lightsim synthesize` writes."""
    out: Path | None = None
    """Also write the table as JSON here."""
    verbose: Verbose = False
    """Show the trace of an error."""

    def run(self) -> None:
        """Measure relit frames."""
        from lightsim.simulation.against_truth import relit_frames

        report = relit_frames(self.work, self.truth, terminal_progress())
        show(report, self.out)


@dataclass(frozen=True)
class EvaluateGeometry:
    """LiDAR error of the twin (held-out sweeps where there are any); F-score with a truth."""

    work: tyro.conf.Positional[Path]
    """Work folder."""
    truth: Path | None = None
    """Ground truth of a synthetic log."""
    out: Path | None = None
    """Also write the table as JSON here."""
    verbose: Verbose = False
    """Show the trace of an error."""

    def run(self) -> None:
        """Measure the geometry."""
        from lightsim.pipeline.measures import geometry
        from lightsim.pipeline.workspace import Workspace

        report, is_held_out = geometry(Workspace(self.work), self.truth, terminal_progress())
        say("held-out sweeps" if is_held_out else "ALL sweeps, those of the build included")
        show(report, self.out)


@dataclass(frozen=True)
class EvaluateSky:
    """The estimated sky against ephemeris, the visible sun, and a truth if given."""

    work: tyro.conf.Positional[tuple[Path, ...]]
    """Work folder; with --networks any number of them."""
    truth: Path | None = None
    """Ground truth of a synthetic log."""
    networks: bool = False
    """The paper's table A4 instead: sky networks on all logs, their suns by GPS as reference."""
    runs: Path | None = None
    """With --networks: folder of runs of lightsim train sky and baseline, compared as well."""
    out: Path | None = None
    """Also write the table as JSON here."""
    verbose: Verbose = False
    """Show the trace of an error."""

    def run(self) -> None:
        """Measure the sky."""
        from lightsim.pipeline.measures import sky
        from lightsim.pipeline.sky_networks import compare_sky_networks
        from lightsim.pipeline.workspace import Workspace

        logs = [Workspace(work) for work in self.work]
        if self.networks:
            show(compare_sky_networks(logs, self.runs), self.out)
        elif len(logs) == 1:
            show(sky(logs[0], self.truth), self.out)
        else:
            raise InputError(
                "one sky is measured at a time",
                got=f"{len(logs)} work folders",
                expected="one, or --networks",
            )


@dataclass(frozen=True)
class EvaluateBaseColour:
    """Base colour against a synthetic log's truth: error, and how much of the shadows is left."""

    work: tyro.conf.Positional[Path]
    """Work folder."""
    truth: Path
    """Ground truth of a synthetic log."""
    out: Path | None = None
    """Also write the table as JSON here."""
    verbose: Verbose = False
    """Show the trace of an error."""

    def run(self) -> None:
        """Measure base colour."""
        from lightsim.simulation.against_truth import base_colour

        report = base_colour(self.work, self.truth, terminal_progress())
        show(report, self.out)


@dataclass(frozen=True)
class EvaluateClosure:
    """Base colour x light against what the cameras saw: 1 closes. Needs no ground truth."""

    work: tyro.conf.Positional[Path]
    """Work folder."""
    out: Path | None = None
    """Also write the table as JSON here."""
    verbose: Verbose = False
    """Show the trace of an error."""

    def run(self) -> None:
        """Measure the closure."""
        from lightsim.pipeline.closure import closure
        from lightsim.pipeline.workspace import Workspace

        show(closure(Workspace(self.work), terminal_progress()), self.out)


Evaluate = (
    Annotated[EvaluateFrames, tyro.conf.subcommand("frames")]
    | Annotated[EvaluateRelight, tyro.conf.subcommand("relight")]
    | Annotated[EvaluateGeometry, tyro.conf.subcommand("geometry")]
    | Annotated[EvaluateSky, tyro.conf.subcommand("sky")]
    | Annotated[EvaluateBaseColour, tyro.conf.subcommand("base-colour")]
    | Annotated[EvaluateClosure, tyro.conf.subcommand("closure")]
)


@dataclass(frozen=True)
class EvaluateGroup:
    """Measure frames, relighting, geometry, the sky, base colour or closure."""

    measure: tyro.conf.OmitSubcommandPrefixes[tyro.conf.OmitArgPrefixes[Evaluate]]
