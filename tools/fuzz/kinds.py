"""The kinds of cases: what is copied, how it is damaged, and what reads it."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from lightsim.store.artefact import RECORD_NAME, hash_file

from .arrow_tables import mutate_feather
from .containers import mutate_glb, mutate_npz, mutate_safetensors
from .models import read_model_case, read_obj_case, write_model_case, write_obj_case
from .mutations import Rng, mutate_bytes, mutate_json, mutate_text, pick
from .options import read_options_case, write_options_case
from .pictures import mutate_picture, write_exr_case, write_hdr_case
from .runner import CANARY_NAME
from .scenarios import read_scenario, write_scenario_case
from .seeds import Seeds
from .special import any_path, replace_by_special
from .tables import mutate_table_file, write_hostile_pickle
from .targets import (
    read_artefacts,
    read_nuscenes_log,
    read_panorama_picture,
    read_sky_file,
    read_whole_log,
)
from .yaml_bombs import mutate_yaml

Damage = Callable[[Path, Path, Rng], str]
"""(folder to damage, canary, generator) -> words."""


@dataclass(frozen=True)
class Kind:
    """One row of the table.

    Args:
        name: on the command line and in the table.
        fraction: cases of this kind in each round of all kinds.
        make: fills a case's folder from the seeds, says what is damaged.
        read: reads the case; LightSimError is the only exception allowed.
    """

    name: str
    fraction: int
    make: Callable[[Seeds, Path, Rng], str]
    read: Callable[[Path], None]


def _files(folder: Path, *patterns: str) -> list[Path]:
    return sorted(p for pattern in patterns for p in folder.rglob(pattern) if p.is_file())


def _in(seed: str, name: str, damage: Damage) -> Callable[[Seeds, Path, Rng], str]:
    """Return the function that copies a seed to a folder of a name and damages the copy."""

    def make(seeds: Seeds, folder: Path, rng: Rng) -> str:
        shutil.copytree(getattr(seeds, seed), folder / name)
        return damage(folder / name, folder / CANARY_NAME, rng)

    return make


_in_log = partial(_in, "log", "log")
_in_own = partial(_in, "own", "log")
_in_work = partial(_in, "work", "work")


def _in_argoverse2(seeds: Seeds, folder: Path, rng: Rng) -> str:
    log = Path(shutil.copytree(seeds.argoverse2, folder / "log"))
    way = rng.random()
    if way < 0.1:
        return replace_by_special(any_path(log, rng), rng)
    if way < 0.2:
        return mutate_picture(pick(rng, _files(log, "*.jpg")), rng)
    return mutate_feather(pick(rng, _files(log, "*.feather")), rng)


def _in_nuscenes(seeds: Seeds, folder: Path, rng: Rng) -> str:
    shutil.copytree(seeds.nuscenes, folder / "log")
    damage = pick(rng, (_json, _json, _json, _points, _picture, _special))
    return damage(folder / "log", folder / CANARY_NAME, rng)


def _signed(damage: Damage) -> Damage:
    """In half of the cases the records tell size and hash of the damaged files, as they would
    from a stranger: else the check of hashes refuses all, and no reader behind it is tried."""

    def make(folder: Path, canary: Path, rng: Rng) -> str:
        words = damage(folder, canary, rng)
        if rng.random() < 0.5:
            return words
        for path in _files(folder, RECORD_NAME):
            record = json.loads(path.read_bytes())
            for name in record["files"]:
                file = path.parent / name
                record["files"][name] = [file.stat().st_size, hash_file(file)]
            path.write_text(json.dumps(record))
        return f"{words}; signed"

    return make


def _json(folder: Path, canary: Path, rng: Rng) -> str:
    path = pick(rng, _files(folder, "*.json", "*.jsonl"))
    if path.suffix == ".jsonl":
        text, words = mutate_text(path.read_text(), rng)
        path.write_text(text, errors="replace")
    else:
        data, words = mutate_json(path.read_bytes(), rng)
        path.write_bytes(data)
    return f"{path.relative_to(folder)}: {words}"


def _calibration(folder: Path, canary: Path, rng: Rng) -> str:
    path = pick(rng, _files(folder, "*.yaml"))
    return mutate_yaml(path, canary, rng)


def _table(folder: Path, canary: Path, rng: Rng) -> str:
    return mutate_table_file(pick(rng, _files(folder, "*.pkl.gz", "*.pkl")), rng)


def _hostile(folder: Path, canary: Path, rng: Rng) -> str:
    path = pick(rng, _files(folder, "00.pkl.gz", "01.pkl"))
    return f"{path.parent.name}/" + write_hostile_pickle(path, canary, rng)


def _picture(folder: Path, canary: Path, rng: Rng) -> str:
    return mutate_picture(pick(rng, _files(folder, "*.jpg", "*.JPG", "*.png")), rng)


def _special(folder: Path, canary: Path, rng: Rng) -> str:
    return replace_by_special(any_path(folder, rng), rng)


def _several(folder: Path, canary: Path, rng: Rng) -> str:
    """Two files damaged at once."""
    # Of two kinds, as one damage cannot read what another left; what takes a file away comes last.
    first = pick(rng, (_json, _table, _picture, _calibration))
    second = pick(
        rng, [c for c in (_json, _table, _picture, _calibration, _special) if c is not first]
    )
    words = [change(folder, canary, rng) for change in (first, second)]
    return "; and ".join(words)


def _csv(folder: Path, canary: Path, rng: Rng) -> str:
    path = pick(rng, _files(folder, "*.csv"))
    text, words = mutate_text(path.read_text(), rng)
    path.write_text(text, errors="replace")
    return f"{path.name}: {words}"


def _points(folder: Path, canary: Path, rng: Rng) -> str:
    path = pick(rng, _files(folder, "*.npz", "*.ply", "*.pcd", "*.bin"))
    if path.suffix == ".npz":
        return mutate_npz(path, rng)
    data, words = mutate_bytes(path.read_bytes(), rng)
    path.write_bytes(data)
    return f"{path.name}: {words}"


def _arrays(folder: Path, canary: Path, rng: Rng) -> str:
    return mutate_npz(pick(rng, _files(folder, "*.npz")), rng)


def _meshes(folder: Path, canary: Path, rng: Rng) -> str:
    return mutate_glb(pick(rng, _files(folder, "*.glb")), rng)


def _weights(folder: Path, canary: Path, rng: Rng) -> str:
    path = pick(rng, _files(folder, "*.safetensors", "*.pt"))
    if path.suffix == ".safetensors":
        return mutate_safetensors(path, rng)
    data, words = mutate_bytes(path.read_bytes(), rng)
    path.write_bytes(data)
    return f"{path.name}: {words}"


def _source_sky(folder: Path, canary: Path, rng: Rng) -> str:
    return write_exr_case(folder / "sky" / "source.exr", rng)


def _hdr(seeds: Seeds, folder: Path, rng: Rng) -> str:
    return write_hdr_case(folder / "sky.hdr", rng)


def _exr(seeds: Seeds, folder: Path, rng: Rng) -> str:
    return write_exr_case(folder / "sky.exr", rng)


def _model(seeds: Seeds, folder: Path, rng: Rng) -> str:
    return write_model_case(folder, rng)


def _obj(seeds: Seeds, folder: Path, rng: Rng) -> str:
    return write_obj_case(folder, rng)


def _panorama(seeds: Seeds, folder: Path, rng: Rng) -> str:
    path = folder / "panorama.png"
    shutil.copyfile(seeds.work / "panorama" / "panorama.png", path)
    return mutate_picture(path, rng)


KINDS: tuple[Kind, ...] = (
    Kind("log json", 4, _in_log(_json), read_whole_log),
    Kind("log calibration", 2, _in_log(_calibration), read_whole_log),
    Kind("log tables", 4, _in_log(_table), read_whole_log),
    Kind("hostile pickles", 3, _in_log(_hostile), read_whole_log),
    Kind("log pictures", 3, _in_log(_picture), read_whole_log),
    Kind("log special files", 2, _in_log(_special), read_whole_log),
    Kind("log several files", 1, _in_log(_several), read_whole_log),
    Kind("nuscenes", 4, _in_nuscenes, read_nuscenes_log),
    Kind("argoverse logs", 4, _in_argoverse2, read_whole_log),
    Kind("own log json", 3, _in_own(_json), read_whole_log),
    Kind("own log tables", 3, _in_own(_csv), read_whole_log),
    Kind("own log points", 4, _in_own(_points), read_whole_log),
    Kind("own log pictures", 1, _in_own(_picture), read_whole_log),
    Kind("own log special files", 1, _in_own(_special), read_whole_log),
    Kind("sky hdr", 3, _hdr, read_sky_file),
    Kind("sky exr", 2, _exr, read_sky_file),
    Kind("panorama", 2, _panorama, read_panorama_picture),
    Kind("models", 3, _model, read_model_case),
    Kind("obj models", 3, _obj, read_obj_case),
    Kind("work json", 4, _in_work(_json), read_artefacts),
    Kind("work arrays", 3, _in_work(_signed(_arrays)), read_artefacts),
    Kind("work meshes", 3, _in_work(_signed(_meshes)), read_artefacts),
    Kind("work weights", 1, _in_work(_signed(_weights)), read_artefacts),
    Kind("work pictures", 1, _in_work(_signed(_picture)), read_artefacts),
    Kind("work source sky", 1, _in_work(_signed(_source_sky)), read_artefacts),
    Kind("work special files", 2, _in_work(_special), read_artefacts),
    Kind("options", 2, write_options_case, read_options_case),
    Kind("scenario", 3, write_scenario_case, read_scenario),
)
ROUND: tuple[Kind, ...] = tuple(kind for kind in KINDS for _ in range(kind.fraction))
"""Case n is of kind ROUND[n % len(ROUND)], whichever kinds are asked for."""
