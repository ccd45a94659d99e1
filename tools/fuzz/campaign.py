"""Many cases: seeds made once, then one forked child a case."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import partial
from pathlib import Path

import numpy as np
from PIL import Image
from tests.store.hdr_writers import radiance_bytes

from lightsim.errors import LightSimError

from .kinds import ROUND
from .report import Report
from .runner import Limits, Outcome, import_what_was_needed, run_case
from .scenarios import read_scenario, write_scenario_case
from .seeds import Seeds, make_seeds
from .targets import (
    read_artefacts,
    read_nuscenes_log,
    read_panorama_picture,
    read_sky_file,
    read_whole_log,
    relight_with_options,
)


def prepare(root: Path, source: Path | None) -> Seeds:
    """Seeds below `root`; every reader has been imported afterwards."""
    import_what_was_needed(partial(_rehearse, root / "rehearsal", source))
    return make_seeds(_fresh(root / "seeds"), source)


def _fresh(folder: Path) -> Path:
    folder.mkdir(parents=True)
    return folder


def _rehearse(folder: Path, source: Path | None) -> None:
    """Read honest files of every kind: they must be accepted, and all is imported then."""
    seeds = make_seeds(_fresh(folder), source)
    os.chdir(folder)
    read_whole_log(folder)
    shutil.copytree(seeds.nuscenes, folder / "nuscenes_case" / "log")
    read_nuscenes_log(folder / "nuscenes_case")
    shutil.copytree(seeds.argoverse2, _fresh(folder / "argoverse") / "log")
    read_whole_log(folder / "argoverse")
    read_artefacts(folder)
    shutil.copyfile(seeds.work / "panorama" / "panorama.png", folder / "panorama.png")
    read_panorama_picture(folder)
    picture = np.full((8, 16, 3), 0.5, np.float32)
    (folder / "sky.hdr").write_bytes(radiance_bytes(picture))
    read_sky_file(folder)
    write_scenario_case(seeds, _fresh(folder / "scenario"), np.random.default_rng(0))
    with suppress(LightSimError):
        read_scenario(folder / "scenario")
    relight_with_options(seeds.work, "noon", "sun:180,60", "auto", (0.0, 1.0), ("", ""))
    Image.init()


def run(
    root: Path,
    seeds: Seeds,
    numbers: Iterable[int],
    seed: int,
    limits: Limits,
    on_outcome: Callable[[int, str, Outcome], None],
) -> Report:
    """Run cases by number; case n depends on n and `seed` alone."""
    report = Report()
    room = _fresh(root / "room")
    for number in numbers:
        kind = ROUND[number % len(ROUND)]
        rng = np.random.default_rng([seed, number])
        outcome = run_case(room, partial(_make, kind.make, seeds, rng), kind.read, limits)
        report.add(number, kind.name, outcome)
        on_outcome(number, kind.name, outcome)
    return report


def _make(
    make: Callable[[Seeds, Path, np.random.Generator], str],
    seeds: Seeds,
    rng: np.random.Generator,
    folder: Path,
) -> str:
    return make(seeds, folder, rng)
