"""Rehearsal of the paper's tables 1, A1, A2 and A4 at a small size, by their documented commands.

    python benchmarks/rehearse_tables.py OUT [--logs LOG ...] [--skies 12] [--inception FILE]

LOG is a recording in PandaSet's layout; by default the shipped street, under two names. Target
skies are those that the builds of the logs estimate, and clear skies in files. All networks are
trained, for some steps. Figures of a rehearsal have no meaning. A repeated command continues.
"""

from __future__ import annotations

import argparse
import csv
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from lightsim import cli
from lightsim.core.solar import direction_enu
from lightsim.lighting.sky.clear_sky import clear_sky
from lightsim.store.exr import write_exr
from lightsim_lab.metrics.inception import find_weights
from lightsim_lab.studies.paper_table import SEQUENCES
from lightsim_lab.synthetic import shipped_street
from lightsim_lab.training.hdr_skies import COLUMNS

# Smallest builds: three frames of one camera, at a quarter of the size.
_BUILD = "--preset draft --neural-steps 20 --cameras front_camera --frames 0:3 --image-scale .25"
_SKY_ROWS = 128


def main(arguments: Sequence[str] | None = None) -> None:
    options = options_of(arguments)
    # Before hours of builds.
    inception = find_weights(options.inception)
    out: Path = options.out
    logs = linked_logs(options.logs, out / "pandaset")
    files = sky_files(options.skies, out / "skies")
    works = [out / "tables" / "works" / log.name for log in logs]
    write_list(out / "skies.txt", [*(work / "sky" / "source.exr" for work in works), *files])
    write_list(out / "unseen.txt", files[:1])
    split = write_split(files, out / "split.csv")
    measured = ("--hdri", out / "skies", "--split", split)
    tables = ("--out", out / "tables", f"--build={options.build}")
    distances = ("--kid-subset-size", 2, "--inception", inception)
    steps = f"--train=--steps {options.steps}"
    for name in SEQUENCES:
        words: tuple[object, ...] = ("--pandaset", out / "pandaset", "--skies", out / "skies.txt")
        words += ("--sequences", name, "--methods", options.methods, "--frames", options.frames)
        run("evaluate", "paper-table1", *words, *tables, *distances)
    words = ("--works", *works, "--out", out / "data", "--every", 2, "--skies-per-frame", 2)
    run("train", "prepare", "relight", *words, *measured)
    rows = ("--rows", *options.rows) if options.rows else ()
    words = ("--log", logs[0], "--data", out / "data", "--unseen", out / "unseen.txt")
    words += (f"{steps} --crops 1 --crop-px 32", "--turns", options.turns, *rows)
    run("evaluate", "paper-tableA2", *words, *tables, *distances)
    words = ("--out", out / "lighting.npz", "--streets", 3, "--positions", 1)
    run("train", "prepare", "lighting", *words, *measured)
    words = ("--pandaset", out / "pandaset", "--data", out / "lighting.npz", steps)
    run("evaluate", "paper-tableA4", *words, *tables)


def options_of(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--logs", type=Path, nargs="*", default=[shipped_street() / "log"] * 2)
    parser.add_argument("--skies", type=int, default=12, help="sky files")
    parser.add_argument("--methods", default="paper,network,physical,colour-transfer")
    parser.add_argument("--frames", default="0:3", help="frames that table 1 relights")
    parser.add_argument("--build", default=_BUILD, help="options of all builds")
    parser.add_argument("--steps", type=int, default=2, help="steps of all networks but the field")
    parser.add_argument("--rows", nargs="*", default=[], help="rows of table A2")
    parser.add_argument("--turns", type=int, default=72, help="turns of the sky in table A2")
    parser.add_argument("--inception", type=Path, help="weights for FID")
    return parser.parse_args(arguments)


def linked_logs(logs: Sequence[Path], folder: Path) -> list[Path]:
    """Link recordings under names of the paper's sequences; one that has such a name keeps it."""
    folder.mkdir(parents=True, exist_ok=True)
    kept = {log.name for log in logs} & set(SEQUENCES["15"])
    free = iter(name for name in SEQUENCES["15"] if name not in kept)
    found = []
    for log in logs:
        path = folder / (log.name if log.name in kept else next(free))
        if not path.exists():
            path.symlink_to(log.resolve(), target_is_directory=True)
        found.append(path)
    return found


def sky_files(count: int, folder: Path) -> list[Path]:
    """Write clear skies whose suns go round at several elevations."""
    folder.mkdir(parents=True, exist_ok=True)
    found = []
    for k in range(count):
        path = folder / f"clear-{k:02d}.exr"
        if not path.is_file():
            dome = clear_sky(direction_enu(360.0 * k / count, 15.0 + 45.0 * k / count), 3.0,
                             height_px=_SKY_ROWS)  # fmt: skip
            write_exr(path, dome.radiance)
        found.append(path)
    return found


def write_split(files: Sequence[Path], path: Path) -> Path:
    """Write a split with all sky files on the training side: they resemble each other."""
    with path.open("w", newline="") as handle:
        writer = csv.writer(handle)
        writer.writerow(COLUMNS)
        writer.writerows((file.stem, "train", "clear", "A", "none", "rehearsal") for file in files)
    return path


def write_list(path: Path, words: Sequence[Path]) -> None:
    """Write one file per line."""
    path.write_text("".join(f"{word}\n" for word in words))


def run(*words: object) -> None:
    """Print a command of LightSim, run it, and print its time."""
    line, began = [str(word) for word in words], time.monotonic()
    sys.stdout.write(f"lightsim {' '.join(line)}\n")
    cli.main(line)
    sys.stdout.write(f"{time.monotonic() - began:.0f} s\n")


if __name__ == "__main__":
    main()
