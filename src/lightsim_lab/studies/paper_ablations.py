"""Table A2 of the paper: ablation of relighting networks by FID and KID, resumable.

Networks without one part each are trained on the same data and relight one PandaSet sequence.
"""

from __future__ import annotations

import shlex
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np

from lightsim.core.checks import check_choice
from lightsim.errors import InputError
from lightsim.fleet.batch import BatchOptions, BatchResult, read_list, run_batch
from lightsim.progress import Progress
from lightsim.store.artefact import hash_file
from lightsim.store.exr import write_exr
from lightsim.store.images import read_sky
from lightsim_lab.studies.paper_pictures import (
    CAMERA,
    PaperTable,
    front_pictures,
    kept_features,
    relit_pictures,
)

if TYPE_CHECKING:
    from lightsim_lab.metrics.distribution import SetRow
    from lightsim_lab.metrics.inception import Inception

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
# Azimuths of the first sky, as in the paper: steps of 5 degrees.
_TURNS = 72


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
    batch = BatchOptions(out=options.out / "batch", jobs=options.jobs)
    weights, notes = train_rows(
        options.network, options.data, options.out / "runs", shlex.split(options.train),
        batch, progress,
    )  # fmt: skip
    build = (str(options.log), "--work", str(_work(options)), *shlex.split(options.build))
    notes += _failures(run_batch("build", [build], batch, progress))
    first = [*_turned(unseen[0], options.out / "turned"), *others]
    lines = [
        line
        for row, path in weights.items()
        for line in _relights(options, row, path, unseen, (recorded[0].stem, first))
    ]
    if lines:
        notes += _failures(run_batch("relight", lines, batch, progress))
    pictures = {
        row: [
            *relit_pictures(_work(options), _scenario(row, "frames"), unseen),
            *relit_pictures(_work(options), _scenario(row, "first"), first),
        ]
        for row in weights
    }
    notes += [f"{row}: nothing was relit." for row, paths in pictures.items() if len(paths) < 2]
    rows = _rows(options, inception, recorded, pictures, progress)
    return PaperTable(rows, (*notes, *_lacking(unseen, others)))


def _rows(
    options: PaperAblationOptions,
    inception: Inception,
    recorded: Sequence[Path],
    pictures: Mapping[str, Sequence[Path]],
    progress: Progress,
) -> tuple[SetRow, ...]:
    from lightsim_lab.metrics.distribution import compare_sets

    folder = options.out / "features"
    reference = kept_features(inception, folder / "recorded.npz", recorded)
    found = []
    for row, paths in progress.track(pictures.items(), "features of relit frames"):
        # A single picture has no covariance.
        if len(paths) > 1:
            made = kept_features(inception, folder / f"{_slug(row)}.npz", paths)
            names = (f"table A2, {options.network}", row)
            found.append(compare_sets(names, made, reference, options.kid_subset_size))
    return tuple(found)


def train_rows(
    network: AblatedNetwork,
    data: Path,
    out: Path,
    more: Sequence[str],
    batch: BatchOptions,
    progress: Progress,
    rows: Sequence[str] = (),
) -> tuple[dict[str, Path], list[str]]:
    """Train the unfinished rows in folders of `out`; return weights by row, and failures.

    Args:
        more: options for all trainings.
        rows: rows to train; empty trains all rows of the network.
    """
    runs = {row: out / f"{network}-{_slug(row)}" for row in rows or ABLATIONS[network]}
    lines = [
        ("relight", "--out", str(run), "--data", str(data), "--network", network,
         *ABLATIONS[network][row], *more)
        for row, run in runs.items()
    ]  # fmt: skip
    notes = _failures(run_batch("train", lines, batch, progress))
    made = {row: run / "weights.safetensors" for row, run in runs.items()}
    return {row: path for row, path in made.items() if path.is_file()}, notes


def _relights(
    options: PaperAblationOptions,
    row: str,
    weights: Path,
    unseen: Sequence[str],
    first: tuple[str, Sequence[str]],
) -> list[tuple[str, ...]]:
    """Return the commands for all frames under the unseen skies and the first frame under many."""
    # Weights are named by their content, so that another training gives other commands: finished
    # commands are not repeated.
    named = options.out / "weights" / f"{_slug(row)}-{hash_file(weights)[:8]}.safetensors"
    if not named.is_file():
        named.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(weights, named)
    stem, skies = first
    chosen = {
        "frames": ("--sky", *unseen),
        "first": ("--frames", f"{int(stem)}:{int(stem) + 1}", "--sky", *skies),
    }
    common = ("--method", options.network, "--weights", str(named), "--overwrite")
    more = ("--cameras", CAMERA, *shlex.split(options.relight))
    return [
        (str(_work(options)), "--name", _scenario(row, part), *common, *more, *words)
        for part, words in chosen.items()
    ]


def _turned(sky: str, folder: Path) -> list[str]:
    """Write a sky file in 72 turns by rolled columns, so that one command relights by all turns."""
    source = Path(sky)
    paths = [folder / f"{source.stem}-{360 * i // _TURNS:03d}.exr" for i in range(_TURNS)]
    if not all(path.is_file() for path in paths):
        folder.mkdir(parents=True, exist_ok=True)
        radiance = read_sky(source).radiance
        for i, path in enumerate(paths):
            # Whole columns: the sun keeps its exact radiance.
            columns = round(i * radiance.shape[1] / _TURNS)
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


def _lacking(unseen: Sequence[str], others: Sequence[str]) -> list[str]:
    # The paper uses 3 and 92 skies.
    counts = {"unseen skies": (len(unseen), 3), "other skies": (len(others), 92)}
    return [f"{n} {what}; the paper has {of}." for what, (n, of) in counts.items() if n != of]


def _failures(result: BatchResult) -> list[str]:
    return [f"Failed: {log}: {last}" for log, last in result.failed.items()]


def _work(options: PaperAblationOptions) -> Path:
    return options.out / "works" / options.log.name


def _scenario(row: str, part: str) -> str:
    return f"tableA2-{_slug(row)}-{part}"


def _slug(row: str) -> str:
    return row.replace(" ", "-")
