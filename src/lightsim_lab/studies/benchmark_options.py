"""What `lightsim evaluate benchmark` is asked for, and the streets that it measures on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Literal

from lightsim.core.checks import check_choice
from lightsim.core.option_types import Names
from lightsim.errors import InputError
from lightsim.simulation.shard import Shard
from lightsim_lab.baselines.methods import ALL_METHODS, NETWORKS

SourceSky = Literal["estimated", "true"]
BenchmarkSize = Literal["small", "full"]
HeldOutSide = Literal["validation", "test"]
REFERENCE = "network"
"""Whom the others are held against: what relight does by itself."""
TRAINING = (77, 412, 1203, 3001, 4007, 5021, 6143, 7351, 8209, *range(201, 213), *range(221, 231))
"""Seeds of the streets that relighting networks learn from."""
HELD_OUT: Mapping[HeldOutSide, Mapping[int, str]] = MappingProxyType(
    {
        "validation": {
            0: "b0e6ec1f4344effa",
            1: "f2aa0f59fa866723",
            58: "1c2ed2d8aee79633",
            904: "a14e4f8defec65e0",
        },
        "test": {
            7001: "06a40f9332b6f5d8",
            7002: "f00903c790bcb129",
            7003: "be2d98f612472066",
            7004: "486b5811cbe3acb6",
        },
    }
)
"""Checksums of the streets that the benchmark measures on. Validation chooses, and its streets may
be looked at; test is for releases, and nothing of its streets is."""


@dataclass(frozen=True, kw_only=True)
class BenchmarkOptions:
    """What is measured."""

    out: Path
    """Folder for streets, twins, scores, leaderboard.json and index.html; what is there is kept."""
    size: BenchmarkSize = "small"
    """small: 480 x 270, a relit frame of six cameras, for two cores; full: 960 x 540, 40 frames,
    five of them relit, for clusters."""
    side: HeldOutSide = "validation"
    """Whose streets: validation chooses; test is for releases alone."""
    methods: Names = ()
    """Comma-separated methods of relight; by default all that have their weights. network is
    always among them."""
    weights: tuple[str, ...] = ()
    """METHOD=FILE of networks whose weights are not the package's."""
    source_sky: SourceSky = "estimated"
    """Whether methods are told the light of the recording, too."""
    seeds: tuple[int, ...] = ()
    """Some of the side's streets; by default all."""
    hdri: Path | None = None
    """Folder of .hdr and .exr panoramas: three of the side's take the place of three analytic skies
    on each street."""
    split: Path | None = None
    """CSV that names those of each side."""
    jobs: int = 1
    """Processes at a time."""
    shard: str = ""
    """I/N, I from 1 to N: take the I-th of N parts of the streets; parts may share DIR, and the
    last one, or the command without --shard, shows all."""

    def __post_init__(self) -> None:
        for method in self.methods:
            check_choice("--methods", method, tuple(ALL_METHODS))
        unknown = set(self.seeds) - set(HELD_OUT[self.side])
        if unknown:
            raise InputError(
                "these are no streets of this side",
                where="--seeds",
                got=sorted(unknown),
                expected=f"some of {', '.join(map(str, HELD_OUT[self.side]))}",
            )
        _ = self.weights_by_method
        Shard.parse(self.shard)

    @property
    def weights_by_method(self) -> dict[str, Path]:
        """Files that were given.

        Raises:
            InputError: they are not spelt METHOD=FILE, or the method has no weights.
        """
        return weights_by_method(self.weights)

    @property
    def root(self) -> Path:
        """Of one side and size."""
        return self.out / f"{self.side}-{self.size}"

    def scores(self, what: Literal["relighting", "edits"]) -> Path:
        """Folder of a file for each street."""
        return self.root / f"scores-{self.source_sky}-sky" / what

    @property
    def scenarios(self) -> str:
        """Beginning of the names of relit frames in a work folder, before -METHOD."""
        return f"benchmark-{self.source_sky}-sky"

    def street(self, seed: int) -> Path:
        """Log and truth."""
        return self.root / "streets" / str(seed)

    def work(self, seed: int) -> Path:
        """Twin."""
        return self.root / "works" / str(seed)


def weights_by_method(words: Sequence[str]) -> dict[str, Path]:
    """METHOD=FILE ...

    Raises:
        InputError: they are not spelt so, or a method has no weights.
    """
    pairs = [word.partition("=") for word in words]
    if not all(name in NETWORKS and path for name, _, path in pairs):
        raise InputError(
            "the weights cannot be read",
            where="--weights",
            got=" ".join(words),
            expected=f"METHOD=FILE, METHOD one of {', '.join(NETWORKS)}",
        )
    return {name: Path(path) for name, _, path in pairs}
