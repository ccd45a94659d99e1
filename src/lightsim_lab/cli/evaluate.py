"""Command `lightsim evaluate`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from lightsim.cli.options import Verbose, WorkFolder, print_line, show
from lightsim.core.checks import check_choice
from lightsim.core.option_types import Names
from lightsim.errors import InputError
from lightsim.progress import terminal_progress
from lightsim_lab.baselines.methods import ALL_METHODS, NETWORKS
from lightsim_lab.cli.evaluate_detector import EvaluateDetector
from lightsim_lab.metrics.options import MeasureOptions
from lightsim_lab.studies.benchmark_options import BenchmarkOptions, weights_by_method
from lightsim_lab.studies.paper_ablations import PaperAblationOptions
from lightsim_lab.studies.paper_skies import PaperSkyOptions
from lightsim_lab.studies.paper_table import PaperTableOptions

if TYPE_CHECKING:
    from lightsim.simulation.options import RelightOptions


@dataclass(frozen=True)
class EvaluateFrames:
    """Score held-out images of a twin against the camera, or any two folders of frames."""

    work: tyro.conf.Positional[Path | None] = None
    """Work folder built with --hold-out; with --predicted, the work folder of the log that the
    frames show, which permits comparisons between cameras and successive frames."""
    predicted: Path | None = None
    """Folder with <camera>/<frame>.png to score instead of the twin's held-out images."""
    truth: Path | None = None
    """Folder with the true frames."""
    source: Path | None = None
    """Folder with the recorded frames; also score the trivial baselines on them."""
    masks: Path | None = None
    """Folder with masks <camera>/<frame>.png, bright where a pixel is scored."""
    with_field: Annotated[bool, tyro.conf.arg(name="field")] = False
    """Also volume-render the neural field (seconds per frame)."""
    options: Annotated[MeasureOptions, tyro.conf.arg(name="")] = field(
        default_factory=MeasureOptions
    )
    out: Path | None = None
    """JSON file to write the table to."""
    verbose: Verbose = False
    """Show the stack trace of an error."""

    def run(self) -> None:
        """Score held-out frames, or the frames of a folder."""
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
                "no frames to score were given",
                expected="a work folder, or --predicted DIR with --truth DIR",
            )
        show(report, self.out)


@dataclass(frozen=True)
class EvaluateRelight:
    """Score relit frames against ground truth, together with the trivial baselines."""

    work: WorkFolder
    """Work folder."""
    truth: Path
    """Ground truth of a synthetic log: folder `truth`, written by `lightsim synthesize`."""
    method: Names = ("network",)
    """Comma-separated relighting methods."""
    weights: tuple[str, ...] = ()
    """METHOD=FILE for networks with other weights than those of the package; with a single method,
    FILE is sufficient."""
    name: str = "truth"
    """Name of the relit frames: WORK/scenarios/NAME, or NAME-METHOD for several methods. They are
    overwritten."""
    source_sky: Path | None = None
    """True sky of the recording as input of the method (TRUTH/skies/source.exr)."""
    allow_stale: bool = False
    """Continue although the recording has changed since the build."""
    scores: bool = True
    """Score the frames; --no-scores only relights them and records the cost, for a later run."""
    options: Annotated[MeasureOptions, tyro.conf.arg(name="")] = field(
        default_factory=MeasureOptions
    )
    out: Path | None = None
    """JSON file to write the table to."""
    verbose: Verbose = False
    """Show the stack trace of an error."""

    def run(self) -> None:
        """Score relit frames."""
        from lightsim_lab.studies.evaluation import evaluate_relit, relit_with_cost

        progress, relighting = terminal_progress(), self._relighting()
        if self.scores:
            report = evaluate_relit(self.work, self.truth, relighting, self.options, progress)
            show(report, self.out)
            return
        for one in relighting:
            relit_with_cost(self.work, self.truth, one, progress)

    def _relighting(self) -> list[RelightOptions]:
        """Return the options of each method."""
        from lightsim.simulation.options import RelightOptions

        for method in self.method:
            check_choice("--method", method, tuple(ALL_METHODS))
        methods: Sequence[str] = self.method
        is_alone, words = len(methods) == 1, self.weights
        # A path may contain an equals sign.
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
    """Score edited frames against ground truth, where the edit changes them."""

    work: WorkFolder
    """Work folder."""
    truth: Path
    """Ground truth of a synthetic log, made with --edits."""
    options: Annotated[MeasureOptions, tyro.conf.arg(name="")] = field(
        default_factory=MeasureOptions
    )
    out: Path | None = None
    """JSON file to write the table to."""
    verbose: Verbose = False
    """Show the stack trace of an error."""

    def run(self) -> None:
        """Score edited frames."""
        from lightsim_lab.studies.edit_evaluation import evaluate_edits

        show(evaluate_edits(self.work, self.truth, self.options, terminal_progress()), self.out)


@dataclass(frozen=True)
class EvaluateGeometry:
    """Measure the LiDAR error of the twin, on held-out sweeps if any, and the F-score if a truth is
    given."""

    work: WorkFolder
    """Work folder."""
    truth: Path | None = None
    """Ground truth of a synthetic log."""
    out: Path | None = None
    """JSON file to write the table to."""
    verbose: Verbose = False
    """Show the stack trace of an error."""

    def run(self) -> None:
        """Measure the geometry."""
        from lightsim.build.workspace import Workspace
        from lightsim_lab.studies.twin_error import geometry

        report, is_held_out = geometry(Workspace(self.work), self.truth, terminal_progress())
        print_line("held-out sweeps" if is_held_out else "ALL sweeps, including those of the build")
        show(report, self.out)


@dataclass(frozen=True)
class EvaluateSky:
    """Compare the estimated sky with ephemeris, the visible sun, and a truth if given."""

    work: tyro.conf.Positional[tuple[Path, ...]]
    """Work folder; any number of them with --networks."""
    truth: Path | None = None
    """Ground truth of a synthetic log."""
    networks: bool = False
    """Compute table A4 of the paper instead: sky networks on all logs against the sun by GPS."""
    runs: Path | None = None
    """With --networks: folder with runs of lightsim train sky and baseline to compare as well."""
    out: Path | None = None
    """JSON file to write the table to."""
    verbose: Verbose = False
    """Show the stack trace of an error."""

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
                "more than one work folder was given",
                got=f"{len(logs)} work folders",
                expected="one work folder, or --networks",
            )


@dataclass(frozen=True)
class EvaluateBaseColour:
    """Measure errors of base colour, and remaining shadows in it, against a synthetic log's
    truth."""

    work: WorkFolder
    """Work folder."""
    truth: Path
    """Ground truth of a synthetic log."""
    out: Path | None = None
    """JSON file to write the table to."""
    verbose: Verbose = False
    """Show the stack trace of an error."""

    def run(self) -> None:
        """Measure base colour."""
        from lightsim_lab.studies.against_truth import base_colour

        report = base_colour(self.work, self.truth, terminal_progress())
        show(report, self.out)


@dataclass(frozen=True)
class EvaluateClosure:
    """Compare base colour x light with observed radiance; 1 is ideal. Needs no ground truth."""

    work: WorkFolder
    """Work folder."""
    out: Path | None = None
    """JSON file to write the table to."""
    verbose: Verbose = False
    """Show the stack trace of an error."""

    def run(self) -> None:
        """Measure the closure."""
        from lightsim.build.workspace import Workspace
        from lightsim_lab.studies.closure import closure

        show(closure(Workspace(self.work), terminal_progress()), self.out)


@dataclass(frozen=True)
class EvaluateCompare:
    """Test the differences between two evaluations of the same frames for significance."""

    first: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="FIRST")]]
    """JSON file that evaluate frames or relight wrote with --out, or a folder with one file per
    log."""
    second: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="SECOND")]]
    """Second evaluation; its values minus those of the first are printed."""
    methods: Names = ()
    """A,B: compare method A of the first with method B of the second; by default methods of equal
    names."""
    out: Path | None = None
    """JSON file to write the table to."""
    verbose: Verbose = False
    """Show the stack trace of an error."""

    def run(self) -> None:
        """Compare the evaluations."""
        from lightsim_lab.metrics.compare import compare_evaluations

        show(compare_evaluations(self.first, self.second, self.methods), self.out)


@dataclass(frozen=True)
class EvaluatePaperTable:
    """Make tables 1 and A1 of the paper: FID and KID of PandaSet logs, built and relit as
    needed."""

    options: Annotated[PaperTableOptions, tyro.conf.arg(name="")]
    verbose: Verbose = False
    """Show the stack trace of an error."""

    def run(self) -> None:
        """Run the unfinished builds and relights, and measure."""
        from lightsim_lab.studies.paper_table import paper_table

        show(paper_table(self.options, terminal_progress()), self.options.out / "table1.json")


@dataclass(frozen=True)
class EvaluatePaperAblations:
    """Make table A2 of the paper: train networks without one part each, and relight a sequence."""

    options: Annotated[PaperAblationOptions, tyro.conf.arg(name="")]
    verbose: Verbose = False
    """Show the stack trace of an error."""

    def run(self) -> None:
        """Run the unfinished trainings, builds and relights, and measure."""
        from lightsim_lab.studies.paper_ablations import paper_ablations

        show(paper_ablations(self.options, terminal_progress()), self.options.out / "tableA2.json")


@dataclass(frozen=True)
class EvaluatePaperSkies:
    """Make table A4 of the paper: sky networks on all PandaSet logs by day, trained as needed."""

    options: Annotated[PaperSkyOptions, tyro.conf.arg(name="")]
    verbose: Verbose = False
    """Show the stack trace of an error."""

    def run(self) -> None:
        """Run the unfinished builds and trainings, and compare."""
        from lightsim_lab.studies.paper_skies import paper_skies

        show(paper_skies(self.options, terminal_progress()), self.options.out / "tableA4.json")


@dataclass(frozen=True)
class EvaluateBenchmark:
    """Make the leaderboard: every method on held-out synthetic streets with true pictures."""

    options: Annotated[BenchmarkOptions, tyro.conf.arg(name="")]
    verbose: Verbose = False
    """Show the stack trace of an error."""

    def run(self) -> None:
        """Run the unfinished steps of all streets, and write the leaderboard."""
        from lightsim_lab.studies.benchmark import benchmark

        show(benchmark(self.options, terminal_progress()), None)
        print_line(f"page: {self.options.root / 'index.html'}")


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
    | Annotated[EvaluateDetector, tyro.conf.subcommand("detector")]
)


@dataclass(frozen=True)
class EvaluateGroup:
    """Measure frames, relighting, geometry, the sky, base colour or closure; compare
    evaluations."""

    measure: tyro.conf.OmitSubcommandPrefixes[tyro.conf.OmitArgPrefixes[Evaluate]]

    def run(self) -> None:
        """Run the chosen command."""
        self.measure.run()
