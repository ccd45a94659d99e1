"""Table A4 of the paper: sky networks on all PandaSet logs by day, resumable."""

from __future__ import annotations

import shlex
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from lightsim.errors import InputError
from lightsim.progress import Progress
from lightsim_lab.studies.paper_pictures import logs_of
from lightsim_lab.studies.study import Study

if TYPE_CHECKING:
    from lightsim_lab.studies.sky_networks import NetworksReport

# Last stage of the build that the comparison needs.
_LAST_STAGE = "sky"


@dataclass(frozen=True, kw_only=True)
class PaperSkyOptions:
    """Inputs of table A4."""

    pandaset: Path
    """Folder of PandaSet with 001, 002, ...; all existing logs are used, except those at night."""
    out: Path
    """Folder for works, trained networks and logs of the commands; finished results are reused."""
    data: Path | None = None
    """File that lightsim train prepare lighting wrote. The paper's network, SOLD-Net and both forms
    of NLFE are trained on it; without it only the shipped network is measured."""
    train: str = ""
    """Options for all trainings as one word: --train="--steps 20000"."""
    build: str = ""
    """Options for all builds as one word."""
    jobs: int = 1
    """Number of simultaneous processes."""


def paper_skies(options: PaperSkyOptions, progress: Progress) -> NetworksReport:
    """Build the existing logs up to their skies, train the compared methods, and compare them.

    A repeated call continues with the unfinished steps. Failed logs are omitted and reported.

    Raises:
        InputError: the folder contains no log, or none has a sun by GPS.
    """
    from lightsim.build.workspace import Workspace
    from lightsim_lab.studies.sky_networks import compare_sky_networks

    logs = logs_of(options.pandaset)
    if not logs:
        raise InputError(
            "there is no log in the folder",
            where=options.pandaset,
            expected="PandaSet's folders 001, 002, ...",
        )
    study = Study(options.out / "batch", options.jobs, progress)
    works = {log: options.out / "works" / log.name for log in logs}
    more = ("--until", _LAST_STAGE, *shlex.split(options.build))
    lines = {log: (str(log), "--work", str(work), *more) for log, work in works.items()}
    built = study.run("build", lines)
    # Not `runs`: table A2 may use the same folder, and stores networks of another kind there.
    runs = options.out / "sky-runs"
    for step in _trainings(options, runs):
        study.run("train", step)
    report = compare_sky_networks([Workspace(works[log]) for log in built], runs)
    return replace(report, left_out=(*report.left_out, *map(str, study.failures)))


def _trainings(options: PaperSkyOptions, runs: Path) -> list[dict[str, tuple[str, ...]]]:
    """Return the trainings in two steps: first the panorama completion, which two others need."""
    if options.data is None:
        return []
    more = ("--data", str(options.data), *shlex.split(options.train))
    seen = (*more, "--inpaint", str(runs / "inpaint" / "weights.safetensors"))
    steps: list[dict[str, tuple[str, ...]]] = [
        {"inpaint": ("inpaint", *more)},
        # Trainings within a step are independent of each other.
        {
            "paper": ("sky", "--network", "lightsim_paper", *seen),
            "sold-net": ("baseline", "--which", "sold_net", *more),
            "nlfe": ("baseline", "--which", "nlfe", *more),
            "nlfe-star": ("baseline", "--which", "nlfe_panorama", *seen),
        },
    ]
    return [
        {name: (words[0], "--out", str(runs / name), *words[1:]) for name, words in step.items()}
        for step in steps
    ]
