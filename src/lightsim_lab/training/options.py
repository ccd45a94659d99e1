"""Options of the training commands, as a user gives them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal


@dataclass(frozen=True)
class PrepareOptions:
    """What the data of the lighting networks are made from."""

    hdri: Path
    """Folder of .hdr and .exr panoramas."""
    out: Path
    """File to write (.npz)."""
    ldr: Path | None = None
    """Folder of LDR panoramas (.jpg, .png, .webp, in any folder below it): the inpainting trains
    on them, too."""
    split: Path | None = None
    """CSV that names train, validation and test files; without it all files train, and so do LDR
    panoramas that it does not name."""
    height: int = 64
    """Rows of the panoramas: 64 for a CPU, 128 or more for a GPU."""
    streets: int = 18
    """Synthetic streets to trace; a sixth is kept for validation, a sixth for tests."""
    positions: int = 5
    """Camera positions in each street."""
    seed: int = 0
    """Of all random numbers."""


@dataclass(frozen=True)
class PrepareRelightOptions:
    """What the data of the relighting network are made from."""

    out: Path
    """Folder to write: a folder of samples for each street."""
    streets: tuple[int, ...] = tuple(range(201, 213))
    """Seeds of the streets. Those that anything is measured on must not be among them."""
    hdri: Path | None = None
    """Folder of .hdr and .exr panoramas that are target skies, too."""
    split: Path | None = None
    """CSV that names those of the training side."""
    skies_per_street: int = 2
    """Measured skies of a street, beside its own three."""
    drawn_suns: int = 0
    """Skies of a street whose suns stand anywhere, besides: whether a wall that a sun newly lights
    is lit in truth is known of as many walls as there are suns."""
    size: Literal["small", "medium", "full", "benchmark"] = "small"
    """Of the streets' pictures; benchmark relights half as many frames as small."""
    paths: int = 16
    """Light paths a pixel, denoised: pictures as from 64 but for errors of 35 dB, in a third of the
    time."""
    keep: bool = False
    """Keep logs, truths and twins of finished streets, too."""


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """How long and where a network is trained, and where its files go."""

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
    compile: bool = False
    """Compile the networks (torch.compile), for a GPU; it needs a C compiler."""
    licence: str = "unknown"
    """Of the weights, for the record that they carry; it depends on the data they have seen."""


@dataclass(frozen=True, kw_only=True)
class TrainingOptions(RunOptions):
    """What a training of a lighting network is made from."""

    data: Path
    """File that lightsim train prepare lighting wrote."""


@dataclass(frozen=True, kw_only=True)
class RelightTrainingOptions(RunOptions):
    """What a training of the relighting network is made from."""

    data: Path
    """Folder that lightsim train prepare relight wrote."""
    network: Literal["network", "paper", "self-osr", "epe"] = "network"
    """network corrects the physical estimate; paper is the published form, with its pairs and
    losses; self-osr and epe are methods to compare with (docs/models/baselines.md)."""
    without: tuple[str, ...] = ()
    """Ablations: sim-real, identity, truth (pairs), buffers, shadow-maps, physical, confidence."""
    edge_weight: float | None = None
    """Weight of the edges' loss; by default the network's."""
    crops: int | None = None
    """Crops of a step; by default the preset's. Fewer and smaller ones let a CPU go on with the
    full network."""
    crop_px: int | None = None
    """Rows and columns of a crop; by default the preset's."""
    streets: tuple[str, ...] = ()
    """Its folders to learn from; by default all but those for validation."""
    validation: tuple[str, ...] = ()
    """Its folders that tell how good the network is; nothing is learned from them."""
    start: Path | None = None
    """Weights to go on from, of the same network and size; by default random ones."""
