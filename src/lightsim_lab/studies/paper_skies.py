"""Table A4 of the paper: sky networks on all PandaSet logs by day, resumable."""

from __future__ import annotations

import shlex
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from lightsim.errors import InputError
from lightsim.fleet.batch import BatchOptions, log_of, run_batch
from lightsim.progress import Progress
from lightsim_lab.studies.paper_pictures import CAMERA

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

    logs = sorted(path.parents[1] for path in options.pandaset.glob(f"*/camera/{CAMERA}"))
    if not logs:
        raise InputError(
            "there is no log in the folder",
            where=options.pandaset,
            expected="PandaSet's folders 001, 002, ...",
        )
    batch = BatchOptions(out=options.out / "batch", jobs=options.jobs)
    works = {log: options.out / "works" / log.name for log in logs}
    lines = {
        log: (str(log), "--work", str(work), "--until", _LAST_STAGE, *shlex.split(options.build))
        for log, work in works.items()
    }
    failed = dict(run_batch("build", list(lines.values()), batch, progress).failed)
    built = [log for log, line in lines.items() if log_of("build", line, batch.out) not in failed]
    runs = options.out / "runs"
    for step in _trainings(options, runs):
        failed |= run_batch("train", step, batch, progress).failed
    report = compare_sky_networks([Workspace(works[log]) for log in built], runs)
    notes = tuple(f"{log}: {last}" for log, last in failed.items())
    return replace(report, left_out=(*report.left_out, *notes))


def _trainings(options: PaperSkyOptions, runs: Path) -> list[list[tuple[str, ...]]]:
    """Return the trainings in two steps: first the panorama completion, which two others need."""
    if options.data is None:
        return []
    more = ("--data", str(options.data), *shlex.split(options.train))
    inpaint = ("--inpaint", str(runs / "inpaint" / "weights.safetensors"))
    out = {
        n: ("--out", str(runs / n)) for n in ("inpaint", "paper", "sold-net", "nlfe", "nlfe-star")
    }
    baselines = [
        ("baseline", *out[name], "--which", which, *more, *seen)
        for name, which, seen in (
            ("sold-net", "sold_net", ()),
            ("nlfe", "nlfe", ()),
            ("nlfe-star", "nlfe_panorama", inpaint),
        )
    ]
    paper = ("sky", *out["paper"], "--network", "lightsim_paper", *more, *inpaint)
    # Trainings within a step are independent of each other.
    return [[("inpaint", *out["inpaint"], *more)], [paper, *baselines]]
