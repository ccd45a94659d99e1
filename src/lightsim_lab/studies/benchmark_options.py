"""Options and streets of `lightsim evaluate benchmark`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Literal

from lightsim.core.checks import check_choice
from lightsim.core.option_types import Names
from lightsim.errors import InputError
from lightsim_lab.baselines.methods import ALL_METHODS, NETWORKS
from lightsim_lab.studies.detector_options import SIZES
from lightsim_lab.synthetic.plan import RendererName, Style, street_name

SourceSky = Literal["estimated", "true"]
BenchmarkSize = Literal["small", "full"]
HeldOutSide = Literal["validation", "test"]
# Method with which all others are compared: the default of `lightsim relight`.
REFERENCE = "network"
# Seeds of the streets for training of relighting networks.
TRAINING = (77, 412, 1203, 3001, 4007, 5021, 6143, 7351, 8209, *range(201, 213), *range(221, 231))
# Checksums of the benchmark's streets by seed. Validation streets serve model selection and may be
# inspected; test streets serve releases only and must not be inspected.
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
# Validation streets of the other styles, which no network may learn from; test streets are missing.
STYLE_VALIDATION: Mapping[Style, Mapping[int, str]] = MappingProxyType(
    {
        "suburban": {21: "5f8c318e76c6e771", 22: "9012423a1e32162a"},
        "boulevard": {21: "57dac21de5e6b28f", 22: "287eb2a9ee5160b7"},
        "industrial": {21: "172311ecb62bcf6d", 22: "fc2e370bfa25bed7"},
    }
)
# Streets rendered by Blender's Cycles, one of each style, which measure the methods on pictures of
# another renderer and camera. Nothing is chosen on them.
CYCLES_STREETS: Mapping[Style, Mapping[int, str]] = MappingProxyType(
    {
        "city": {31: "3beef8d9bb21c7d9"},
        "suburban": {31: "d754521058665abd"},
        "boulevard": {31: "8e037c9b7b0d396b"},
        "industrial": {31: "fb16f6378d1c587d"},
    }
)


@dataclass(frozen=True, kw_only=True)
class BenchmarkOptions:
    """Options of the benchmark."""

    out: Path
    """Folder for streets, twins, scores, leaderboard.json and index.html; finished results are
    reused."""
    size: BenchmarkSize = "small"
    """small: 480 x 270, one relit frame per camera, for two cores; full: 960 x 540, 40 frames, five
    of them relit, for clusters."""
    side: HeldOutSide = "validation"
    """Side of the split: validation for model selection, test for releases only."""
    style: Style = "city"
    """Style of the streets; styles other than city have a validation side only."""
    renderer: RendererName = "mitsuba"
    """Renderer of the streets. cycles: streets of their own (seed 31 of each style) with other
    materials, exposure and noise, on which nothing is chosen; not with --side test."""
    blender_python: Path | None = None
    """Python 3.11 interpreter that has bpy 4.5, for --renderer cycles."""
    methods: Names = ()
    """Comma-separated methods of relight; by default all with weights. network is always
    included."""
    weights: tuple[str, ...] = ()
    """METHOD=FILE for networks with other weights than those of the package."""
    source_sky: SourceSky = "estimated"
    """Sky of the recording as input of the methods: estimated by the twin, or true."""
    seeds: tuple[int, ...] = ()
    """Subset of the side's streets; by default all. Processes with different streets may use the
    same folder; each shows the results of all."""
    hdri: Path | None = None
    """Folder of .hdr and .exr panoramas; three panoramas of the side replace three analytic skies
    on each street."""
    split: Path | None = None
    """CSV file that assigns the panoramas to sides."""
    jobs: int = 1
    """Number of simultaneous processes."""

    def __post_init__(self) -> None:
        for method in self.methods:
            check_choice("--methods", method, tuple(ALL_METHODS))
        if self.style != "city" and self.side == "test":
            raise InputError(
                "this style has no test streets",
                where="--style",
                got=self.style,
                expected="city with --side test",
            )
        if self.renderer == "cycles" and self.side == "test":
            raise InputError(
                "the streets of --renderer cycles have no test side",
                where="--side",
                got=self.side,
                remedy="Leave --side out: nothing is chosen on these streets.",
            )
        unknown = set(self.seeds) - set(self.checksums)
        if unknown:
            raise InputError(
                "the seeds are no streets of this side",
                where="--seeds",
                got=sorted(unknown),
                expected=f"some of {', '.join(map(str, self.checksums))}",
            )
        # Raises for malformed options before any work starts.
        _ = self.weights_by_method

    @property
    def weights_by_method(self) -> dict[str, Path]:
        """Given weights by method.

        Raises:
            InputError: a word is not METHOD=FILE, or the method has no weights.
        """
        return weights_by_method(self.weights)

    @property
    def checksums(self) -> Mapping[int, str]:
        """Checksums of the streets of the side, style and renderer, by seed."""
        if self.renderer == "cycles":
            return CYCLES_STREETS[self.style]
        return HELD_OUT[self.side] if self.style == "city" else STYLE_VALIDATION[self.style]

    @property
    def root(self) -> Path:
        """Folder of one side, size and style."""
        style = "" if self.style == "city" else f"-{self.style}"
        return self.out / f"{self.what}-{self.size}{style}"

    @property
    def what(self) -> str:
        """Name of the set of streets: the side, or the renderer if it is not the usual one."""
        return self.side if self.renderer == "mitsuba" else self.renderer

    def scores(self, what: Literal["relighting", "edits"]) -> Path:
        """Return the folder of the scores, one file per street."""
        return self.root / f"scores-{self.source_sky}-sky" / what

    @property
    def scenarios(self) -> str:
        """Prefix of the names of relit frames in a work folder, before -METHOD."""
        return f"benchmark-{self.source_sky}-sky"

    def street(self, seed: int) -> Path:
        """Return the folder of log and truth."""
        return self.root / "streets" / str(seed)

    def work(self, seed: int) -> Path:
        """Return the folder of the twin."""
        return self.root / "works" / str(seed)


def held_out_names() -> set[str]:
    """Return the names of all streets that no network may learn from."""
    cities = {street_name(seed, "city") for side in HELD_OUT.values() for seed in side}
    styled = (*STYLE_VALIDATION.items(), *CYCLES_STREETS.items())
    named = {street_name(seed, style) for style, seeds in styled for seed in seeds}
    return cities | named | {name for size in SIZES.values() for name in size.streets}


def weights_by_method(words: Sequence[str]) -> dict[str, Path]:
    """Parse words of the form METHOD=FILE.

    Raises:
        InputError: a word has another form, or a method has no weights.
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
