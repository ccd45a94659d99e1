"""Command `lightsim train`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from lightsim.cli.options import Verbose, WorkFolder, print_line
from lightsim.progress import terminal_progress
from lightsim_lab.training.options import (
    PrepareOptions,
    PrepareRelightOptions,
    RelightTrainingOptions,
    TrainingOptions,
)


@dataclass(frozen=True)
class PrepareLighting(PrepareOptions):
    """Make the training data of the lighting networks."""

    verbose: Verbose = False
    """Show the stack trace of an error."""

    def run(self) -> None:
        """Make the training data."""
        from lightsim_lab.training import run

        run.prepare(self)


@dataclass(frozen=True)
class PrepareRelight(PrepareRelightOptions):
    """Make the samples of the relighting networks, of synthetic streets or of built logs."""

    verbose: Verbose = False
    """Show the stack trace of an error."""

    def run(self) -> None:
        """Make the missing samples."""
        from lightsim_lab.studies.prepare_relight import prepare_relight

        prepare_relight(self, terminal_progress())


_Prepare = (
    Annotated[PrepareLighting, tyro.conf.subcommand("lighting")]
    | Annotated[PrepareRelight, tyro.conf.subcommand("relight")]
)


@dataclass(frozen=True)
class PrepareGroup:
    """Make training data of the lighting networks or of the relighting network."""

    data: tyro.conf.OmitSubcommandPrefixes[tyro.conf.OmitArgPrefixes[_Prepare]]

    def run(self) -> None:
        """Run the chosen command."""
        self.data.run()


@dataclass(frozen=True, kw_only=True)
class TrainInpaint(TrainingOptions):
    """Train the completion of panoramas."""

    ldr_fraction: float = 0.5
    """Fraction of samples from LDR panoramas, if the data contain any; 1 as in the paper."""
    form: Literal["lightsim", "published"] = "lightsim"
    """lightsim continues the observed pixels smoothly and corrects that; published paints holes
    anew, as DeepFill v2."""
    verbose: Verbose = False
    """Show the stack trace of an error."""

    def run(self) -> None:
        """Train, or continue an interrupted training."""
        from lightsim_lab.training import run

        is_published = self.form == "published"
        run.train_inpaint(self, self.ldr_fraction, is_published=is_published)


@dataclass(frozen=True, kw_only=True)
class TrainSky(TrainingOptions):
    """Train the estimator of sky domes."""

    network: Literal["lightsim", "lightsim_paper"] = "lightsim"
    """lightsim_paper is the published architecture."""
    inpaint: Path | None = None
    """Weights of the panorama completion for lightsim_paper; by default smooth filling."""
    start: Path | None = None
    """Initial weights, trained further at a quarter of the learning rate."""
    part: Literal["all", "direction"] = "all"
    """direction trains only the encoder of the sun direction, which has its own parameters."""
    verbose: Verbose = False
    """Show the stack trace of an error."""

    def run(self) -> None:
        """Train, or continue an interrupted training."""
        from lightsim_lab.training import run

        run.train_sky_network(self, self.network, self.inpaint, self.start, self.part)


@dataclass(frozen=True, kw_only=True)
class TrainBaseline(TrainingOptions):
    """Train a sky network of a compared method."""

    which: Literal["sold_net", "nlfe", "nlfe_panorama"] = "nlfe"
    """SOLD-Net, or the sky branch of NLFE on one picture or on the completed panorama."""
    inpaint: Path | None = None
    """Weights of the panorama completion for nlfe_panorama."""
    verbose: Verbose = False
    """Show the stack trace of an error."""

    def run(self) -> None:
        """Train, or continue an interrupted training."""
        from lightsim_lab.training import run

        run.train_sky_network(self, self.which, self.inpaint)


@dataclass(frozen=True, kw_only=True)
class TrainRelight(RelightTrainingOptions):
    """Train the network that corrects physical relighting."""

    verbose: Verbose = False
    """Show the stack trace of an error."""

    def run(self) -> None:
        """Train, or continue an interrupted training."""
        from lightsim_lab.training.run_relight import train

        train(self)


@dataclass(frozen=True)
class TrainNerfOsr:
    """Train the field of one street for relight --method nerf-osr, a compared method."""

    work: WorkFolder
    """Work folder of a finished build; the field is stored there."""
    steps: int = 2500
    """Training steps."""
    seed: int = 0
    """Seed of initial weights and rays."""
    allow_stale: bool = False
    """Continue although the recording has changed since the build."""
    verbose: Verbose = False
    """Show the stack trace of an error."""

    def run(self) -> None:
        """Train, or continue an interrupted training."""
        from lightsim_lab.baselines.nerf_osr.nerf_osr import train_nerf_osr

        path = train_nerf_osr(
            self.work, self.steps, self.seed, terminal_progress(), allow_stale=self.allow_stale
        )
        print_line(f"field: {path}")


_Train = (
    Annotated[PrepareGroup, tyro.conf.subcommand("prepare")]
    | Annotated[TrainInpaint, tyro.conf.subcommand("inpaint")]
    | Annotated[TrainSky, tyro.conf.subcommand("sky")]
    | Annotated[TrainRelight, tyro.conf.subcommand("relight")]
    | Annotated[TrainBaseline, tyro.conf.subcommand("baseline")]
    | Annotated[TrainNerfOsr, tyro.conf.subcommand("nerf-osr")]
)


@dataclass(frozen=True, kw_only=True)
class TrainGroup:
    """Train the networks."""

    what: tyro.conf.OmitSubcommandPrefixes[tyro.conf.OmitArgPrefixes[_Train]]

    def run(self) -> None:
        """Run the chosen command."""
        self.what.run()
