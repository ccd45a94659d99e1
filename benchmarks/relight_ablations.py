"""The paper's table A2 and ours: relighting networks without one part each, on the same data.

    python benchmarks/relight_ablations.py DATA OUT --validation 412 [--steps 2000]
        [--network network]

DATA: of `lightsim train prepare relight`. Every row is a run of `lightsim train relight` in a
folder of OUT; what is finished stays. Scores are of the validation streets: PSNR dB and LPIPS
outside the sky, mean over the target skies; and the PSNR of a picture relit by its own sky.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np

from lightsim.store.artefact import read_json
from lightsim.training.options import RelightTrainingOptions
from lightsim.training.relight_scores import IDENTITY
from lightsim.training.run_relight import train

# Parts left out, or the weight of the edges' loss.
ROWS: dict[str, dict[str, dict[str, Any]]] = {
    "network": {
        "all": {},
        "without true pairs and physical estimate": {"without": ("truth", "physical")},
        "without identity": {"without": ("identity",)},
        "without buffers": {"without": ("buffers",)},
        "without shadow maps": {"without": ("shadow-maps",)},
        "without the physical estimate": {"without": ("physical",)},
        "without confidence": {"without": ("confidence",)},
        "edges 0": {"edge_weight": 0.0},
        "edges 1": {"edge_weight": 1.0},
    },
    "paper": {
        "all": {},
        "without sim-real": {"without": ("sim-real",)},
        "without identity": {"without": ("identity",)},
        "without buffers": {"without": ("buffers",)},
        "without shadow maps": {"without": ("shadow-maps",)},
        "edges 0": {"edge_weight": 0.0},
        "edges 200": {"edge_weight": 200.0},
        "edges 800": {"edge_weight": 800.0},
    },
}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--validation", nargs="+", required=True)
    parser.add_argument("--steps", type=int, default=2000)
    parser.add_argument("--network", choices=sorted(ROWS), default="network")
    options = parser.parse_args()
    sys.stdout.write("| row | PSNR dB | LPIPS | identity dB |\n|---|---:|---:|---:|\n")
    for name, changes in ROWS[options.network].items():
        run = options.out / f"{options.network}-{name.replace(' ', '-')}"
        if not (run / "scores.json").exists():
            train(
                RelightTrainingOptions(
                    data=options.data,
                    out=run,
                    network=options.network,
                    steps=options.steps,
                    validation=tuple(options.validation),
                    **changes,
                )
            )
        scores = read_json(run / "scores.json")
        found = {sky: row["network"] for sky, row in scores.items() if isinstance(row, dict)}
        same_db = found.pop(IDENTITY)["psnr_db"]
        psnr_db, lpips = (np.mean([s[key] for s in found.values()]) for key in ("psnr_db", "lpips"))
        sys.stdout.write(f"| {name} | {psnr_db:.2f} | {lpips:.3f} | {same_db:.1f} |\n")


if __name__ == "__main__":
    main()
