"""Options of `lightsim train`; see cli.py."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

_Verbose = Annotated[bool, tyro.conf.arg(aliases=["-v"])]


@dataclass(frozen=True)
class TrainPrepare:
    """Make the file that training of the lighting networks draws from."""

    hdri: Path
    """Folder of .hdr and .exr panoramas."""
    out: Path
    """File to write (.npz)."""
    split: Path | None = None
    """CSV that names train and test files; without it all files train."""
    height: int = 64
    """Rows of the panoramas: 64 for a CPU, 128 or more for a GPU."""
    streets: int = 15
    """Synthetic streets to trace; the last fifth is kept for tests."""
    positions: int = 5
    """Camera positions in each street."""
    seed: int = 0
    """Of all random numbers."""
    verbose: _Verbose = False
    """Show the trace of an error."""


@dataclass(frozen=True)
class TrainOptions:
    data: Path
    """File that lightsim train prepare wrote."""
    out: Path
    """Folder for checkpoint, metrics.jsonl, weights.safetensors and scores.json; a run that was
    stopped goes on here."""
    preset: Literal["small", "full"] = "small"
    """small for one CPU core, full for a GPU."""
    steps: int | None = None
    """Training steps; by default the preset's."""
    minutes: float | None = None
    """Stop after this time; the same command goes on."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where to train; auto takes CUDA where there is one."""
    seed: int = 0
    """Of first weights and batches."""
    verbose: _Verbose = False
    """Show the trace of an error."""


@dataclass(frozen=True)
class TrainInpaint(TrainOptions):
    """Train the completion of panoramas."""


@dataclass(frozen=True)
class TrainSky(TrainOptions):
    """Train the estimator of sky domes."""

    inpaint: Path | None = None
    """Weights of the completion that the estimator is to work behind; without them smooth fills."""
    network: Literal["lightsim", "lightsim_paper"] = "lightsim"
    """lightsim_paper is the published form."""


@dataclass(frozen=True)
class TrainBaseline(TrainOptions):
    """Train a method to compare with."""

    which: Literal["sold_net", "nlfe", "nlfe_panorama"] = "nlfe"
    """SOLD-Net, NLFE's sky branch from one picture, or from the completed panorama."""
    inpaint: Path | None = None
    """Weights of the completion, as for sky."""


_Train = (
    Annotated[TrainPrepare, tyro.conf.subcommand("prepare")]
    | Annotated[TrainInpaint, tyro.conf.subcommand("inpaint")]
    | Annotated[TrainSky, tyro.conf.subcommand("sky")]
    | Annotated[TrainBaseline, tyro.conf.subcommand("baseline")]
)


@dataclass(frozen=True)
class TrainGroup:
    """Train the lighting networks."""

    what: tyro.conf.OmitSubcommandPrefixes[tyro.conf.OmitArgPrefixes[_Train]]
