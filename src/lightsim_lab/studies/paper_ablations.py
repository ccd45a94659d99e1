"""Table A2 of the paper: ablation of relighting networks by FID and KID, resumable.

Networks without one part each are trained on the same data and relight one PandaSet sequence.
"""

from __future__ import annotations

import shlex
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from lightsim.core.checks import check_choice, check_number
from lightsim.errors import InputError
from lightsim.fleet.lines import read_list
from lightsim.progress import Progress
from lightsim.store.artefact import hash_file
from lightsim.store.exr import write_exr
from lightsim.store.images import read_sky
from lightsim_lab.studies.paper_pictures import (
    CAMERA,
    PaperTable,
    compare_pictures,
    front_pictures,
    relit_pictures,
)
from lightsim_lab.studies.study import Study

AblatedNetwork = Literal["network", "paper"]
# Options of `lightsim train relight` by row: the eight rows of the paper for `paper`; parts and
# possible extensions of `network`.
ABLATIONS: Mapping[AblatedNetwork, Mapping[str, tuple[str, ...]]] = {
    "paper": {
        "all": (),
        "without sim-real": ("--without", "sim-real"),
        "without identity": ("--without", "identity"),
        "without buffers": ("--without", "buffers"),
        "without shadow maps": ("--without", "shadow-maps"),
        "edges 0": ("--edge-weight", "0"),
        "edges 200": ("--edge-weight", "200"),
        "edges 800": ("--edge-weight", "800"),
    },
    "network": {
        "all": (),
        "without true pairs and physical estimate": ("--without", "truth", "physical"),
        "without identity": ("--without", "identity"),
        "without buffers": ("--without", "buffers"),
        "without shadow maps": ("--without", "shadow-maps"),
        "without the physical estimate": ("--without", "physical"),
        "without confidence": ("--without", "confidence"),
        "edges 0": ("--edge-weight", "0"),
        "edges 1": ("--edge-weight", "1"),
    },
}
"""Options of `lightsim train relight` by row: the eight published ablations, and those of
LightSim's network."""


@dataclass(frozen=True, kw_only=True)
class PaperAblationOptions:
    """Inputs of table A2."""

    log: Path
    """Sequence to relight, 001 in the paper; its front pictures are the reference."""
    data: Path
    """Folder that lightsim train prepare relight wrote."""
    unseen: Path
    """Text file with sky files that no network was trained on, one per line (the paper: 3). They
    relight all frames; 72 turns of the first sky relight the first frame."""
    out: Path
    """Folder for networks, twin, logs of the commands and features; finished results are reused."""
    others: Path | None = None
    """Text file with further skies that relight the first frame (the paper: 92)."""
    network: AblatedNetwork = "paper"
    """Network whose parts are removed."""
    rows: tuple[str, ...] = ()
    """Rows to make, such as "without buffers"; by default all."""
    turns: int = 72
    """Turns of the first unseen sky, as in the paper: steps of 5 degrees."""
    train: str = ""
    """Options for all trainings as one word: --train="--steps 5000"."""
    build: str = ""
    """Options for the build as one word."""
    relight: str = ""
    """Options for all relights as one word."""
    jobs: int = 1
    """Number of simultaneous processes."""
    kid_subset_size: int = 10
    """Pictures per KID subset, as in the paper."""
    inception: Path | None = None
    """Weights for FID; see `lightsim evaluate frames --help`."""

    def __post_init__(self) -> None:
        check_choice("--network", self.network, get_args(AblatedNetwork))
        for row in self.rows:
            check_choice("--rows", row, tuple(ABLATIONS[self.network]))
        check_number("--turns", self.turns, 1, 360)


def paper_ablations(options: PaperAblationOptions, progress: Progress) -> PaperTable:
    """Train all networks, build and relight the sequence, and compare with its front pictures.

    A repeated call continues with the unfinished steps.

    Raises:
        InputError: the sequence has no front pictures, or a list contains no sky file.
        MissingDependencyError: FID's weights are not installed.
    """
    from lightsim_lab.metrics.inception import Inception

    inception, recorded = Inception(options.inception), front_pictures(options.log)
    if not recorded:
        raise InputError(
            "the log has no front pictures",
            where=options.log,
            expected=f"a PandaSet sequence with camera/{CAMERA}",
        )
    unseen = _skies(options.unseen)
    others = [] if options.others is None else _skies(options.others)
    study = Study(options.out / "batch", options.jobs, progress)
    runs, more = options.out / "runs", shlex.split(options.train)
    weights = train_rows(study, options.network, options.data, runs, more, options.rows)
    build = (str(options.log), "--work", str(_work(options)), *shlex.split(options.build))
    first = [*_turned(unseen[0], options.turns, options.out / "turned"), *others]
    if study.run("build", {options.log.name: build}):
        study.run("relight", _relights(options, weights, unseen, (recorded[0].stem, first)))
    pictures = {
        row: {
            _slug(row): [
                *relit_pictures(_work(options), _scenario(row, "frames"), unseen),
                *relit_pictures(_work(options), _scenario(row, "first"), first),
            ]
        }
        for row in weights
    }
    rows, empty = compare_pictures(
        f"table A2, {options.network}", pictures, {"recorded": recorded}, inception,
        options.out / "features", options.kid_subset_size, progress,
    )  # fmt: skip
    return PaperTable(rows, (*study.notes, *empty, *_missing_skies_notes(unseen, others)))


def train_rows(
    study: Study,
    network: AblatedNetwork,
    data: Path,
    out: Path,
    more: Sequence[str],
    rows: Sequence[str] = (),
) -> dict[str, Path]:
    """Train the unfinished rows in folders of `out`; return the weights of finished rows.

    Args:
        more: options for all trainings.
        rows: rows to train; empty trains all rows of the network.
    """
    runs = {row: out / f"{network}-{_slug(row)}" for row in rows or ABLATIONS[network]}
    lines = {
        row: ("relight", "--out", str(run), "--data", str(data), "--network", network,
              *ABLATIONS[network][row], *more)
        for row, run in runs.items()
    }  # fmt: skip
    made = {row: runs[row] / "weights.safetensors" for row in study.run("train", lines)}
    return {row: path for row, path in made.items() if path.is_file()}


def _relights(
    options: PaperAblationOptions,
    weights: Mapping[str, Path],
    unseen: Sequence[str],
    first: tuple[str, Sequence[str]],
) -> dict[tuple[str, str], tuple[str, ...]]:
    """Return the commands for all frames under the unseen skies and the first frame under many."""
    stem, skies = first
    chosen = {
        "frames": ("--sky", *unseen),
        "first": ("--frames", f"{int(stem)}:{int(stem) + 1}", "--sky", *skies),
    }
    more = ("--overwrite", "--cameras", CAMERA, *shlex.split(options.relight))
    lines = {}
    for row, path in weights.items():
        by = ("--method", options.network, "--weights", str(_named_by_content(options, row, path)))
        for part, words in chosen.items():
            name = ("--name", _scenario(row, part))
            lines[row, part] = (str(_work(options)), *name, *by, *more, *words)
    return lines


def _named_by_content(options: PaperAblationOptions, row: str, weights: Path) -> Path:
    """Copy weights to a file named by their hash, so that changed weights change the command."""
    named = options.out / "weights" / f"{_slug(row)}-{hash_file(weights)[:8]}.safetensors"
    if not named.is_file():
        named.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(weights, named)
    return named


def _turned(sky: str, turns: int, folder: Path) -> list[str]:
    """Write a sky file in all turns by rolled columns, so that one command relights by all."""
    source = Path(sky)
    paths = [folder / f"{source.stem}-{360 * i // turns:03d}.exr" for i in range(turns)]
    if not all(path.is_file() for path in paths):
        folder.mkdir(parents=True, exist_ok=True)
        radiance = read_sky(source).radiance
        for i, path in enumerate(paths):
            # Whole columns: the sun keeps its exact radiance.
            columns = round(i * radiance.shape[1] / turns)
            write_exr(path, np.roll(radiance, columns, axis=1))
    return [str(path) for path in paths]


def _skies(path: Path) -> list[str]:
    """Read the list of sky files."""
    words = [word for line in read_list(path) for word in line]
    wrong = [word for word in words if not Path(word).is_file()]
    if wrong or not words:
        raise InputError(
            "the list contains skies that are no files" if wrong else "the list contains no sky",
            where=path,
            got=", ".join(wrong[:3]) or None,
            expected=".hdr or .exr files, one per line",
        )
    return words


def _missing_skies_notes(unseen: Sequence[str], others: Sequence[str]) -> list[str]:
    # The paper uses 3 and 92 skies.
    counts = {"unseen skies": (len(unseen), 3), "other skies": (len(others), 92)}
    return [f"{n} {what}; the paper has {of}." for what, (n, of) in counts.items() if n != of]


def _work(options: PaperAblationOptions) -> Path:
    return options.out / "works" / options.log.name


def _scenario(row: str, part: str) -> str:
    return f"tableA2-{_slug(row)}-{part}"


def _slug(row: str) -> str:
    return row.replace(" ", "-")
