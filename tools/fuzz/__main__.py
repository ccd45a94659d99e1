"""python -m tools.fuzz LOG COUNT SEED [--kinds K,K] [--case N] [--out FILE]

LOG is the folder of a PandaSet sequence, or "synthetic". Exit code 1 if a case failed.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from pathlib import Path

# One thread a library: the parent forks, and cases share the machine.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(_name, "1")


def main() -> int:
    from .campaign import prepare, run
    from .kinds import ROUND
    from .report import Report
    from .runner import FAILURES, Limits, Outcome

    options = _parse()
    names = {kind.name for kind in ROUND}
    wanted = set(options.kinds.split(",")) if options.kinds else names
    if wanted - names:
        raise SystemExit(f"unknown kinds {sorted(wanted - names)}; there are {sorted(names)}")
    numbers = range(options.count) if options.case is None else [options.case]
    numbers = [n for n in numbers if ROUND[n % len(ROUND)].name in wanted]
    source = None if options.log == "synthetic" else Path(options.log)

    def on_outcome(number: int, kind: str, outcome: Outcome) -> None:
        if options.case is not None or options.verbose or outcome.result in FAILURES:
            text = f"{number} {kind}: {outcome.result} {outcome.place} | {outcome.damage}"
            sys.stdout.write(f"{text} | {outcome.detail}\n")
            sys.stdout.flush()

    with tempfile.TemporaryDirectory(prefix="lightsim-fuzz-") as folder:
        root = Path(folder)
        report: Report = run(
            root, prepare(root, source), numbers, options.seed, Limits(), on_outcome
        )
    command = f"python -m tools.fuzz {options.log} {options.count} {options.seed}"
    text = report.to_table() + "\n"
    sys.stdout.write("\n" + text + "\n" + report.to_failures(command) + "\n")
    if options.out is not None:
        Path(options.out).write_text(text)
    return 1 if report.failures else 0


def _parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tools.fuzz", description=__doc__)
    parser.add_argument("log", help='folder of a PandaSet sequence, or "synthetic"')
    parser.add_argument("count", type=int)
    parser.add_argument("seed", type=int)
    parser.add_argument("--kinds", default="", help="names of kinds, with commas; all by default")
    parser.add_argument("--case", type=int, help="only this case; prints what became of it")
    parser.add_argument("--out", help="a file for the table, in Markdown")
    parser.add_argument("--verbose", action="store_true", help="a line for every case")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
