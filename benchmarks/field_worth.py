"""What the neural field is worth: builds without it, with it and by the paper, over seeds.

    python benchmarks/field_worth.py OUT SOURCE ... [--rows "tsdf + texture" standard paper]
        [--seeds 0 1 2] [--scale 1 --hold-out 5] [--paper-steps 20000] [--table]

SOURCE: logs; `street` is the one that ships with the package. A folder `truth` beside the log
gives F-scores. Every row and seed is a build in OUT/<log>/<row>-<seed>, up to the assets; stages
that another one has made from the same recipe are taken over, and finished ones are kept. Behind
all of them stands the sky of one build without the field: surfaces alone differ. The table has
what is finished, mean +- standard deviation over seeds, and names what is not (--table: only
that). Gain: standard minus tsdf + texture of the same seed.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from bench_reconstruction import take_from_siblings

from lightsim.build import pipeline as pipeline
from lightsim.build.measures import held_out_tasks, observed_radiance
from lightsim.build.options import BuildOptions
from lightsim.build.quality.frames import FramesConfig, score_frames
from lightsim.build.workspace import Workspace
from lightsim.core.reading import LogReading
from lightsim.core.twin import SkyEstimate
from lightsim.progress import LineProgress, SilentProgress
from lightsim.store.artefact import read_json, write_json
from lightsim_lab.metrics.lpips import Lpips
from lightsim_lab.studies.twin_error import geometry
from lightsim_lab.synthetic import shipped_street

WITHOUT, WITH, PAPER = "tsdf + texture", "standard", "paper"
ROWS = (WITHOUT, WITH, PAPER)
SCORES_NAME = "scores.json"
SHOWN = {
    "psnr_db": ("PSNR dB", 2),
    "ssim": ("SSIM", 3),
    "lpips": ("LPIPS", 3),
    "median_cm": ("LiDAR median cm", 2),
    "percentile_90_cm": ("90 % cm", 1),
    "f_5": ("F@5 cm", 3),
    "f_10": ("F@10 cm", 3),
    "field_s": ("field, processor s", 0),
}
"""Columns: heading and decimals."""


@dataclass(frozen=True)
class Case:
    """One log of the table."""

    name: str
    log: Path
    truth: Path | None

    @classmethod
    def of(cls, source: str) -> Case:
        """The log that a word of the command names."""
        log = shipped_street() / "log" if source == "street" else Path(source).resolve()
        truth = log.parent / "truth"
        name = "street-0" if source == "street" else log.name
        return cls(name, log, truth if truth.is_dir() else None)


def main() -> None:
    options = _arguments()
    cases = [Case.of(source) for source in options.sources]
    for case in () if options.table else cases:
        # Seed by seed: an interrupted run has whole pairs.
        for seed in options.seeds:
            for row in options.rows:
                _measure(options, case, row, seed)
    for case in cases:
        sys.stdout.write(_table(options, case) + "\n")


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("sources", nargs="+")
    parser.add_argument("--rows", nargs="+", choices=ROWS, default=ROWS)
    parser.add_argument("--seeds", type=int, nargs="+", default=(0, 1, 2))
    parser.add_argument("--scale", type=float, default=1.0)
    parser.add_argument("--hold-out", type=int, default=5)
    parser.add_argument("--paper-steps", type=int)
    parser.add_argument("--table", action="store_true")
    return parser.parse_args()


def _folder(options: argparse.Namespace, case: Case, row: str, seed: int) -> Path:
    return options.out / case.name / f"{row.replace(' + ', '-')}-{seed}"


def _measure(options: argparse.Namespace, case: Case, row: str, seed: int) -> None:
    """Build one row with one seed, and write its scores."""
    work = _folder(options, case, row, seed)
    if (work / SCORES_NAME).is_file():
        return
    reading = LogReading(source=str(case.log), image_scale=options.scale, hold_out=options.hold_out)
    changes: Mapping[str, dict[str, Any]] = {
        WITHOUT: {"neural_steps": 0},
        WITH: {},
        PAPER: {"preset": "paper", "neural_steps": options.paper_steps},
    }
    build = BuildOptions(reading=reading, seed=seed, **changes[row])
    take_from_siblings(options.out / case.name, work, build)
    pipeline.build(work, build, LineProgress(), until="fields")
    was_trained, start = (work / "neural").exists(), time.process_time()
    pipeline.build(work, build, LineProgress(), until="neural")
    field_s = None if was_trained else time.process_time() - start
    pipeline.build(work, build, LineProgress(), until="assets")
    scores = _scores(work, case, _sky(options, case, reading))
    write_json(work / SCORES_NAME, scores | {"field_s": field_s})


def _sky(options: argparse.Namespace, case: Case, reading: LogReading) -> SkyEstimate:
    """Of the build without the field."""
    work, build = options.out / case.name / "sky", BuildOptions(reading=reading, neural_steps=0)
    take_from_siblings(options.out / case.name, work, build)
    return pipeline.build(work, build, LineProgress(), until="sky").sky


def _scores(work: Path, case: Case, sky: SkyEstimate) -> dict[str, float | None]:
    """Means over cameras of held-out frames without sky and ego vehicle; held-out sweeps; F-scores
    of the background."""
    workspace = Workspace(work)
    tasks = held_out_tasks(workspace, {"twin": observed_radiance(workspace, sky)})
    frames = score_frames(tasks, FramesConfig(Lpips(), with_exposure=False))
    rows = [r for r in frames.rows if (r.method, r.region) == ("twin", "masked")]
    report, _ = geometry(workspace, case.truth, SilentProgress())
    surface = [row.f_score for row in report.surface]
    return {
        **{
            key: float(np.mean([getattr(row.scores, key) for row in rows]))
            for key in ("psnr_db", "ssim", "lpips")
        },
        "median_cm": 100 * report.lidar.median_abs_m,
        "percentile_90_cm": 100 * report.lidar.percentile_90_m,
        **dict(zip(("f_5", "f_10"), surface or (None, None), strict=True)),
    }


def _table(options: argparse.Namespace, case: Case) -> str:
    found: dict[str, dict[int, dict[str, float | None]]] = {}
    missing = []
    for row in ROWS:
        paths = {s: _folder(options, case, row, s) / SCORES_NAME for s in options.seeds}
        found[row] = {s: read_json(path) for s, path in paths.items() if path.is_file()}
        missing += [f"{row} (seed {s})" for s, path in paths.items() if not path.is_file()]
    heads = [head for head, _ in SHOWN.values()]
    lines = [
        f"| {case.name} | seeds | {' | '.join(heads)} |",
        "|---|---:|" + "---:|" * len(heads),
        *(_line(row, list(by_seed.values())) for row, by_seed in found.items() if by_seed),
    ]
    both = sorted(found[WITHOUT].keys() & found[WITH].keys())
    gains = [_difference(found[WITH][s], found[WITHOUT][s]) for s in both]
    if gains:
        lines.append(_line("gain of the field", gains))
    if missing:
        lines += ["", f"Not run: {', '.join(missing)}."]
    return "\n".join(lines) + "\n"


def _difference(
    first: Mapping[str, float | None], second: Mapping[str, float | None]
) -> dict[str, float | None]:
    pairs = {key: (first[key], second[key]) for key in SHOWN}
    return {
        key: None if one is None or other is None else one - other
        for key, (one, other) in pairs.items()
    }


def _line(name: str, scores: Sequence[Mapping[str, float | None]]) -> str:
    cells = [_cell((score[key] for score in scores), digits) for key, (_, digits) in SHOWN.items()]
    return f"| {name} | {len(scores)} | {' | '.join(cells)} |"


def _cell(values: Iterable[float | None], digits: int) -> str:
    known = [value for value in values if value is not None]
    if not known:
        return "-"
    spread = f" ± {np.std(known, ddof=1):.{digits}f}" if len(known) > 1 else ""
    return f"{np.mean(known):.{digits}f}{spread}"


if __name__ == "__main__":
    main()
