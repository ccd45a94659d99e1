"""Relighting networks without one part each, trained on the same data, against the truth: what the
paper's table A2 (`lightsim evaluate paper-tableA2`) has no figure for.

    python benchmarks/relight_ablations.py DATA OUT --validation 412 [--steps 2000]
        [--network network] [--rows all "without confidence" ...] [--jobs 1]

DATA: of `lightsim train prepare relight`. Every row is a run of `lightsim train relight` in a
folder of OUT; what is finished stays. Scores are of the validation streets: PSNR dB and LPIPS
outside the sky, mean over the target skies; and the PSNR of a picture relit by its own sky.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

from lightsim.progress import LineProgress
from lightsim.store.artefact import read_json
from lightsim_lab.studies.paper_ablations import ABLATIONS, train_rows
from lightsim_lab.studies.study import Study
from lightsim_lab.training.relight_scores import IDENTITY


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--validation", nargs="+", required=True)
    parser.add_argument("--steps", type=int, default=2000)
    parser.add_argument("--network", choices=sorted(ABLATIONS), default="network")
    parser.add_argument("--rows", nargs="+", default=[], help="all, if none is named")
    parser.add_argument("--jobs", type=int, default=1)
    options = parser.parse_args()
    if unknown := set(options.rows) - set(ABLATIONS[options.network]):
        parser.error(f"no rows of {options.network}: {', '.join(sorted(unknown))}")
    study = Study(options.out / "batch", options.jobs, LineProgress())
    more = ("--steps", str(options.steps), "--validation", *options.validation)
    weights = train_rows(study, options.network, options.data, options.out, more, options.rows)
    sys.stdout.write("| row | PSNR dB | LPIPS | identity dB |\n|---|---:|---:|---:|\n")
    for name, path in weights.items():
        scores = read_json(path.with_name("scores.json"))
        found = {sky: row["network"] for sky, row in scores.items() if isinstance(row, dict)}
        same_db = found.pop(IDENTITY)["psnr_db"]
        psnr_db, lpips = (np.mean([s[key] for s in found.values()]) for key in ("psnr_db", "lpips"))
        sys.stdout.write(f"| {name} | {psnr_db:.2f} | {lpips:.3f} | {same_db:.1f} |\n")
    sys.stdout.writelines(f"{note}\n" for note in study.notes)


if __name__ == "__main__":
    main()
