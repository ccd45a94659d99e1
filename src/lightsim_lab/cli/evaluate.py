"""`lightsim evaluate`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from lightsim.cli.options import Verbose, say, show
from lightsim.core.checks import check_choice
from lightsim.core.option_types import Names
from lightsim.errors import InputError
from lightsim.progress import terminal_progress
from lightsim_lab.baselines.methods import ALL_METHODS, NETWORKS
from lightsim_lab.metrics.options import MeasureOptions
from lightsim_lab.studies.benchmark_options import BenchmarkOptions, weights_by_method
from lightsim_lab.studies.paper_ablations import PaperAblationOptions
from lightsim_lab.studies.paper_skies import PaperSkyOptions
from lightsim_lab.studies.paper_table import PaperTableOptions

if TYPE_CHECKING:
    from lightsim.simulation.options import RelightOptions


@dataclass(frozen=True)
class EvaluateFrames:
    """Held-out images of a twin against the camera; or any two folders of frames."""

    work: tyro.conf.Positional[Path | None] = None
    """Work folder built with --hold-out; with --predicted, the log that the frames show: lets
    cameras and successive frames be compared with each other."""
    predicted: Path | None = None
    """Folder of <camera>/<frame>.png to score instead of the twin's held-out images."""
    truth: Path | None = None
    """Folder of the true frames."""
    source: Path | None = None
    """Folder of the recorded frames: also scores what global changes of their colour reach."""
    masks: Path | None = None
    """Folder of <camera>/<frame>.png, bright where a pixel counts."""
    with_field: Annotated[bool, tyro.conf.arg(name="field")] = False
    """Also volume-render the neural field (seconds a frame)."""
    options: Annotated[MeasureOptions, tyro.conf.arg(name="")] = field(
        default_factory=MeasureOptions
    )
    out: Path | None = None
    """Also write the table as JSON here."""
    verbose: Verbose = False
    """Show the trace of an error."""

    def run(self) -> None:
        """Measure held-out frames, or those of a folder."""
        from lightsim_lab.studies.evaluation import evaluate_folders, evaluate_held_out

        progress = terminal_progress()
        if self.predicted is not None and self.truth is not None:
            folders = {"predicted": self.predicted, "truth": self.truth}
            if self.source is not None:
                folders["source"] = self.source
            report = evaluate_folders(folders, self.masks, self.work, self.options, progress)
        elif self.work is not None and (self.predicted, self.truth) == (None, None):
            report = evaluate_held_out(
                self.work, self.options, progress, with_field=self.with_field
            )
        else:
            raise InputError(
                "there is nothing to score",
                expected="a work folder, or --predicted DIR with --truth DIR",
            )
        show(report, self.out)


@dataclass(frozen=True)
class EvaluateRelight:
    """Relit frames against ground truth, beside the trivial baselines."""

    work: tyro.conf.Positional[Path]
    """Work folder."""
    truth: Path
    """Ground truth of a synthetic log: the folder `truth` that `lightsim synthesize` writes."""
    method: Names = ("network",)
    """Comma-separated: how pixels are relit."""
    weights: tuple[str, ...] = ()
    """METHOD=FILE of networks whose weights are not the package's; one method needs FILE alone."""
    name: str = "truth"
    """Of the relit frames: WORK/scenarios/NAME, which is written over; NAME-METHOD of several
    methods."""
    source_sky: Path | None = None
    """The light of the recording, where the method is told it (TRUTH/skies/source.exr)."""
    allow_stale: bool = False
    """Go on where the recording has changed since the build."""
    scores: bool = True
    """Without, frames are relit alone: a process for each method, whose cost is its own, and then
    one for all their scores, which looks at the truth once."""
    options: Annotated[MeasureOptions, tyro.conf.arg(name="")] = field(
        default_factory=MeasureOptions
    )
    out: Path | None = None
    """Also write the table as JSON here."""
    verbose: Verbose = False
    """Show the trace of an error."""

    def run(self) -> None:
        """Measure relit frames."""
        from lightsim_lab.studies.evaluation import evaluate_relit, relit_with_cost

        progress, relighting = terminal_progress(), self._relighting()
        if self.scores:
            report = evaluate_relit(self.work, self.truth, relighting, self.options, progress)
            show(report, self.out)
            return
        for one in relighting:
            relit_with_cost(self.work, self.truth, one, progress)

    def _relighting(self) -> list[RelightOptions]:
        """Of each method."""
        from lightsim.simulation.options import RelightOptions

        for method in self.method:
            check_choice("--method", method, tuple(ALL_METHODS))
        methods: Sequence[str] = self.method
        is_alone, words = len(methods) == 1, self.weights
        # A path may hold an equals sign.
        if is_alone and len(words) == 1 and words[0].partition("=")[0] not in NETWORKS:
            words = (f"{methods[0]}={words[0]}",)
        files = weights_by_method(words)
        for method in files:
            check_choice("--weights", method, methods)
        return [
            RelightOptions(
                name=self.name if is_alone else f"{self.name}-{method}",
                method=method,
                weights=files.get(method),
                source_sky=self.source_sky,
                allow_stale=self.allow_stale,
            )
            for method in methods
        ]


@dataclass(frozen=True)
class EvaluateEdits:
    """Edited frames against ground truth, where the edit changes them."""

    work: tyro.conf.Positional[Path]
    """Work folder."""
    truth: Path
    """Ground truth of a synthetic log, made with --edits."""
    options: Annotated[MeasureOptions, tyro.conf.arg(name="")] = field(
        default_factory=MeasureOptions
    )
    out: Path | None = None
    """Also write the table as JSON here."""
    verbose: Verbose = False
    """Show the trace of an error."""

    def run(self) -> None:
        """Measure edited frames."""
        from lightsim_lab.studies.edit_evaluation import evaluate_edits

        show(evaluate_edits(self.work, self.truth, self.options, terminal_progress()), self.out)


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
        from lightsim.build.workspace import Workspace
        from lightsim_lab.studies.twin_error import geometry

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
        from lightsim.build.workspace import Workspace
        from lightsim_lab.studies.sky_networks import compare_sky_networks
        from lightsim_lab.studies.twin_error import sky

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
        from lightsim_lab.studies.against_truth import base_colour

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
        from lightsim.build.workspace import Workspace
        from lightsim_lab.studies.closure import closure

        show(closure(Workspace(self.work), terminal_progress()), self.out)


@dataclass(frozen=True)
class EvaluateCompare:
    """Two evaluations of the same frames: which differences are more than chance?"""

    first: tyro.conf.Positional[Path]
    """JSON that evaluate frames or relight wrote with --out, or a folder of them, one a log."""
    second: tyro.conf.Positional[Path]
    """Another one; its values minus those of the first are printed."""
    methods: Names = ()
    """A,B: compare method A of the first with method B of the second; by default methods of equal
    names."""
    out: Path | None = None
    """Also write the table as JSON here."""
    verbose: Verbose = False
    """Show the trace of an error."""

    def run(self) -> None:
        """Compare."""
        from lightsim_lab.metrics.compare import compare_evaluations

        show(compare_evaluations(self.first, self.second, self.methods), self.out)


@dataclass(frozen=True)
class EvaluatePaperTable:
    """The paper's tables 1 and A1: FID and KID of relit PandaSet logs, built and relit as
    needed."""

    options: Annotated[PaperTableOptions, tyro.conf.arg(name="")]
    verbose: Verbose = False
    """Show the trace of an error."""

    def run(self) -> None:
        """Build, relight and measure what is not finished."""
        from lightsim_lab.studies.paper_table import paper_table

        show(paper_table(self.options, terminal_progress()), self.options.out / "table1.json")


@dataclass(frozen=True)
class EvaluatePaperAblations:
    """The paper's table A2: networks without one part each, trained, relighting one sequence."""

    options: Annotated[PaperAblationOptions, tyro.conf.arg(name="")]
    verbose: Verbose = False
    """Show the trace of an error."""

    def run(self) -> None:
        """Train, build, relight and measure what is not finished."""
        from lightsim_lab.studies.paper_ablations import paper_ablations

        show(paper_ablations(self.options, terminal_progress()), self.options.out / "tableA2.json")


@dataclass(frozen=True)
class EvaluatePaperSkies:
    """The paper's table A4: sky networks on all PandaSet logs by day, trained and built as
    needed."""

    options: Annotated[PaperSkyOptions, tyro.conf.arg(name="")]
    verbose: Verbose = False
    """Show the trace of an error."""

    def run(self) -> None:
        """Build, train and compare what is not finished."""
        from lightsim_lab.studies.paper_skies import paper_skies

        show(paper_skies(self.options, terminal_progress()), self.options.out / "tableA4.json")


@dataclass(frozen=True)
class EvaluateBenchmark:
    """The leaderboard: every method on held-out synthetic streets with true pictures, resumable."""

    options: Annotated[BenchmarkOptions, tyro.conf.arg(name="")]
    verbose: Verbose = False
    """Show the trace of an error."""

    def run(self) -> None:
        """Make, build, relight and measure what is not finished."""
        from lightsim_lab.studies.benchmark import benchmark

        show(benchmark(self.options, terminal_progress()), None)
        say(f"page: {self.options.root / 'index.html'}")


Evaluate = (
    Annotated[EvaluateFrames, tyro.conf.subcommand("frames")]
    | Annotated[EvaluateRelight, tyro.conf.subcommand("relight")]
    | Annotated[EvaluateEdits, tyro.conf.subcommand("edits")]
    | Annotated[EvaluateGeometry, tyro.conf.subcommand("geometry")]
    | Annotated[EvaluateSky, tyro.conf.subcommand("sky")]
    | Annotated[EvaluateBaseColour, tyro.conf.subcommand("base-colour")]
    | Annotated[EvaluateClosure, tyro.conf.subcommand("closure")]
    | Annotated[EvaluateCompare, tyro.conf.subcommand("compare")]
    | Annotated[EvaluatePaperTable, tyro.conf.subcommand("paper-table1")]
    | Annotated[EvaluatePaperAblations, tyro.conf.subcommand("paper-tableA2")]
    | Annotated[EvaluatePaperSkies, tyro.conf.subcommand("paper-tableA4")]
    | Annotated[EvaluateBenchmark, tyro.conf.subcommand("benchmark")]
)


@dataclass(frozen=True)
class EvaluateGroup:
    """Measure frames, relighting, geometry, the sky, base colour or closure; compare."""

    measure: tyro.conf.OmitSubcommandPrefixes[tyro.conf.OmitArgPrefixes[Evaluate]]

    def run(self) -> None:
        """Run the chosen command."""
        self.measure.run()
