"""Command-line options of `lightsim train`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from lightsim.core.checks import check_image_scale, check_number, check_seed
from lightsim.core.option_types import Names

# Largest number of target skies: more than any folder of panoramas has; guards against typing
# errors.
_MAX_SKIES = 10_000
# Maximum number of frames, against typing errors: more than any log has.
_MAX_FRAMES = 1_000_000


@dataclass(frozen=True)
class PrepareOptions:
    """Options of `train prepare lighting`."""

    hdri: Path
    """Folder of .hdr and .exr panoramas."""
    out: Path
    """File to write (.npz)."""
    ldr: Path | None = None
    """Folder of LDR panoramas (.jpg, .png, .webp, also in subfolders) that train the inpainting."""
    split: Path | None = None
    """CSV with the train, validation and test files. Without it all files train, and so do LDR
    panoramas that are not in it."""
    height: int = 64
    """Rows of the panoramas: 64 for a CPU, 128 or more for a GPU."""
    streets: int = 18
    """Synthetic streets to trace; a sixth is for validation, a sixth for tests."""
    positions: int = 5
    """Camera positions in each street."""
    seed: int = 0
    """Seed of all random numbers."""


@dataclass(frozen=True)
class PrepareRelightOptions:
    """Options of `train prepare relight`."""

    out: Path
    """Folder to write: one folder of samples per street or log."""
    works: tuple[Path, ...] = ()
    """Work folders of builds of any logs, with or without truth, instead of synthetic streets.
    Samples are for the pairs of the paper: rendering to rendering, rendering to recorded picture,
    and identity. Target skies are the estimated skies of the other works, and those of --hdri."""
    streets: tuple[int, ...] = tuple(range(201, 213))
    """Seeds of the streets. Exclude the seeds of streets for evaluation."""
    style: Literal["city", "suburban", "boulevard", "industrial"] = "city"
    """Style of the streets; another command with the same --out adds streets of another style."""
    hdri: Path | None = None
    """Folder of .hdr and .exr panoramas for additional target skies."""
    split: Path | None = None
    """CSV with the panoramas of the training side."""
    skies_per_street: int | None = None
    """Measured skies per street, in addition to its own three (2 by default), or per log of --works
    (10 by default, as published)."""
    drawn_suns: int = 0
    """Additional skies per street with random suns. Each one lights other walls, so that more walls
    have a true picture in sunlight."""
    size: Literal["small", "medium", "full", "benchmark"] = "small"
    """Size of the streets' images; benchmark has half as many relit frames as small."""
    paths: int = 16
    """Light paths per pixel, denoised: 35 dB PSNR against 64 paths, in a third of the time."""
    keep: bool = False
    """Do not delete the logs, truths and twins of finished streets."""
    estimated_skies: int = 10
    """Estimated skies of other works per log of --works, as published."""
    skies_per_frame: int = 4
    """Target skies that are drawn for each frame of --works; each adds some 17 MB."""
    sky_offset_deg: float = 180.0
    """Largest random turn of the target skies of --works about the vertical axis, in degrees."""
    cameras: Names = ()
    """Comma-separated cameras of --works; empty for all."""
    every: int = 1
    """Sample each n-th frame of --works."""
    image_scale: float | None = None
    """Factor on the image size of --works; by default that of the build."""
    seed: int = 0
    """Seed of the draws of target skies for --works."""
    allow_stale: bool = False
    """Continue although a recording of --works has changed since its build."""

    def __post_init__(self) -> None:
        if self.image_scale is not None:
            check_image_scale(self.image_scale)
        check_number("--every", self.every, 1, _MAX_FRAMES)
        check_number("--estimated-skies", self.estimated_skies, 0, _MAX_SKIES)
        check_number("--skies-per-frame", self.skies_per_frame, 1, _MAX_SKIES)
        check_number("--sky-offset-deg", self.sky_offset_deg, 0.0, 180.0)
        check_seed(self.seed)


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """Duration, device and output folder of a training."""

    out: Path
    """Folder for checkpoint, metrics.jsonl, weights.safetensors and scores.json; an interrupted run
    resumes from it."""
    preset: Literal["small", "full"] = "small"
    """small for one CPU core, full for a GPU."""
    steps: int | None = None
    """Training steps; by default the preset's."""
    minutes: float | None = None
    """Stop after this time; the same command resumes the training."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Device of the training; auto selects CUDA if available."""
    seed: int = 0
    """Seed of the initial weights and of the batches."""
    compile: bool = False
    """Compile the networks (torch.compile) for a GPU; requires a C compiler."""
    licence: str = "unknown"
    """Licence of the weights for their record; it depends on the training data."""


@dataclass(frozen=True, kw_only=True)
class TrainingOptions(RunOptions):
    """Options of the training of a lighting network."""

    data: Path
    """File written by lightsim train prepare lighting."""


@dataclass(frozen=True, kw_only=True)
class RelightTrainingOptions(RunOptions):
    """Options of the training of a relighting network."""

    data: Path
    """Folder written by lightsim train prepare relight."""
    network: Literal["network", "paper", "self-osr", "epe"] = "network"
    """network corrects the physical estimate; paper is the published network, with its pairs and
    losses; self-osr and epe are baselines (docs/models/baselines.md)."""
    without: tuple[str, ...] = ()
    """Ablations: sim-real, identity, truth (pairs), buffers, shadow-maps, physical, confidence."""
    edge_weight: float | None = None
    """Weight of the edge loss; by default the network's."""
    crops: int | None = None
    """Crops per step; by default the preset's. Fewer and smaller crops let a CPU continue the
    training of the full network."""
    crop_px: int | None = None
    """Rows and columns of a crop; by default the preset's."""
    streets: tuple[str, ...] = ()
    """Folders of the training streets; by default all except those for validation."""
    validation: tuple[str, ...] = ()
    """Folders of the validation streets, which score the network and do not train it."""
    start: Path | None = None
    """Initial weights, of the same network and size; by default random."""
