"""Tables 1 and A1 of the paper: FID and KID of relit against real PandaSet frames, resumable."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from lightsim.core.checks import check_choice
from lightsim.core.option_types import Names
from lightsim.errors import InputError
from lightsim.fleet.lines import read_list
from lightsim.progress import Progress
from lightsim_lab.baselines.methods import ALL_METHODS, FIELD_METHOD
from lightsim_lab.studies.paper_pictures import (
    CAMERA,
    PaperTable,
    compare_pictures,
    front_pictures,
    logs_of,
    relit_pictures,
)
from lightsim_lab.studies.study import Study

SequenceSet = Literal["15", "47"]
_FIFTEEN = "001 002 011 021 023 024 027 028 029 030 032 033 035 040 053"
_FORTY_SEVEN = (
    "001 002 003 005 006 008 011 012 013 014 015 016 017 018 019 020 021 023 024 027 028 029 030 "
    "032 033 034 035 037 038 039 040 041 042 043 044 045 046 047 048 050 051 052 053 054 055 056 "
    "139"
)
# Sequences of the main paper and of its appendix. The appendix lists 48 names for 47 sequences;
# 004, in which the ego vehicle does not move, is omitted here as in its text.
SEQUENCES: dict[SequenceSet, tuple[str, ...]] = {
    "15": tuple(_FIFTEEN.split()),
    "47": tuple(_FORTY_SEVEN.split()),
}


@dataclass(frozen=True, kw_only=True)
class PaperTableOptions:
    """Inputs of tables 1 and A1."""

    pandaset: Path
    """Folder of PandaSet with 001, 002, ...; existing sequences are used."""
    skies: Path
    """Text file with the target skies, one per line, spelt as for --sky. The 23 skies of the paper
    are not published (11 estimated from PandaSet logs, such as OUT/works/053/sky/source.exr, and
    12 bought)."""
    out: Path
    """Folder for works, logs of the commands and features; finished results are reused."""
    sequences: SequenceSet = "15"
    """15 sequences of the main paper, or 47 of the supplement."""
    methods: Names = ("network", "physical", "colour-transfer")
    """Comma-separated methods of relight; nerf-osr trains one field per log."""
    frames: str = "6:25:6"
    """START:STOP[:STEP]; the paper uses 6, 12, 18 and 24."""
    build: str = ""
    """Options for all builds as one word: --build="--preset paper"."""
    relight: str = ""
    """Options for all relights as one word."""
    jobs: int = 1
    """Number of simultaneous processes."""
    kid_subset_size: int = 1000
    """Pictures per KID subset, at most the number of pictures. The paper gives the size only for
    its ablation (10)."""
    inception: Path | None = None
    """Weights for FID; see `lightsim evaluate frames --help`."""

    def __post_init__(self) -> None:
        check_choice("--sequences", self.sequences, get_args(SequenceSet))
        for method in self.methods:
            check_choice("--methods", method, tuple(ALL_METHODS))


def paper_table(options: PaperTableOptions, progress: Progress) -> PaperTable:
    """Build and relight the existing logs, and compare with all front pictures of PandaSet.

    A repeated call continues with the unfinished steps.

    Raises:
        InputError: no sequence exists, the skies cannot be read, or nothing was relit.
        MissingDependencyError: FID's weights are not installed.
    """
    from lightsim_lab.metrics.inception import Inception

    inception = Inception(options.inception)
    skies = [word for line in read_list(options.skies) for word in line]
    wanted = SEQUENCES[options.sequences]
    present = [name for name in wanted if (options.pandaset / name).is_dir()]
    if not skies or not present:
        raise InputError(
            "the inputs of the table are incomplete",
            where=options.pandaset,
            got=f"{len(skies)} skies, {len(present)} sequences",
            expected=f"one sky or more, and some of {', '.join(wanted)}",
        )
    notes = _run(options, present, skies, progress)
    pictures = {
        method: {
            f"{method}-{name}": relit_pictures(_work(options.out, name), _scenario(method), skies)
            for name in present
        }
        for method in options.methods
    }
    # The reference contains all logs of the folder, as in the paper, not only the sequences.
    reference = {f"real-{log.name}": front_pictures(log) for log in logs_of(options.pandaset)}
    title = f"table 1, {options.sequences} sequences"
    rows, empty = compare_pictures(
        title, pictures, reference, inception, options.out / "features", options.kid_subset_size,
        progress,
    )  # fmt: skip
    notes += empty
    if len(present) < len(wanted):
        notes.append(f"{len(present)} of {len(wanted)} sequences: {', '.join(present)}.")
    if len(skies) != 23:
        notes.append(f"{len(skies)} skies; the paper has 23.")
    return PaperTable(rows, tuple(notes))


def _run(
    options: PaperTableOptions, present: Sequence[str], skies: Sequence[str], progress: Progress
) -> list[str]:
    """Run all builds, trainings and relights; return notes on failures."""
    study = Study(options.out / "batch", options.jobs, progress)
    works = {name: str(_work(options.out, name)) for name in present}
    more = shlex.split(options.build)
    logs = {name: str(options.pandaset / name) for name in present}
    built = study.run("build", {n: (logs[n], "--work", works[n], *more) for n in present})
    if FIELD_METHOD in options.methods:
        study.run("train", {n: (FIELD_METHOD, works[n]) for n in built})
    chosen = ("--overwrite", "--cameras", CAMERA, "--frames", options.frames)
    chosen += (*shlex.split(options.relight), "--sky", *skies)
    relights = {
        (n, method): (works[n], "--name", _scenario(method), "--method", method, *chosen)
        for n in built
        for method in options.methods
    }
    study.run("relight", relights)
    return study.notes


def _work(out: Path, name: str) -> Path:
    return out / "works" / name


def _scenario(method: str) -> str:
    return f"table1-{method}"
