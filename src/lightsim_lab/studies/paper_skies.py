"""Table A4 of the paper: sky networks on all PandaSet logs by day, trained, built and compared as
needed; resumable."""

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

_LAST_STAGE = "sky"
"""What the networks are given and compared with; nothing behind it is built."""


@dataclass(frozen=True, kw_only=True)
class PaperSkyOptions:
    """What table A4 is made from."""

    pandaset: Path
    """PandaSet's folder: 001, 002, ... in it; all that are there are used, but for those by
    night."""
    out: Path
    """Folder for works, trained networks and logs of the commands; what is there is kept."""
    data: Path | None = None
    """File that lightsim train prepare lighting wrote: the paper's network, SOLD-Net and both forms
    of NLFE are trained on it; without it the shipped network stands alone."""
    train: str = ""
    """Options for all trainings, in one text behind an equals sign: --train="--steps 20000"."""
    build: str = ""
    """Options for all builds, likewise."""
    jobs: int = 1
    """Processes at a time."""


def paper_skies(options: PaperSkyOptions, progress: Progress) -> NetworksReport:
    """Builds the logs that are there up to their skies, trains the methods to compare with, and
    compares them. Started again, it goes on; a log that fails is left out and named.

    Raises:
        InputError: the folder holds no log, or none of them counts.
    """
    from lightsim.build.workspace import Workspace
    from lightsim_lab.studies.sky_networks import compare_sky_networks

    logs = sorted(path.parents[1] for path in options.pandaset.glob(f"*/camera/{CAMERA}"))
    if not logs:
        raise InputError(
            "there is no log", where=options.pandaset, expected="PandaSet's folders 001, 002, ..."
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
    """The completion first, which two of the others look through."""
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
    return [[("inpaint", *out["inpaint"], *more)], [paper, *baselines]]
