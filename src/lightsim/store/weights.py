"""Weights of networks: safetensors files with a record; shipped files are verified by SHA-256."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lightsim.errors import ArtefactError, InputError
from lightsim.store.atomic import whole_file
from lightsim.store.reading import MAX_JSON_BYTES, open_regular, read_bytes

if TYPE_CHECKING:
    import torch

# Largest size of a file of weights, in bytes. Shipped files have some megabytes each, the largest
# field a tenth of this.
_MAX_BYTES = 1 << 30
# Folder of the shipped weights in the package.
WEIGHTS_FOLDER = Path(__file__).parents[1] / "data" / "weights"
# Value of entries of a record that are not known.
UNKNOWN = "unknown"


@dataclass(frozen=True)
class WeightsRecord:
    """Record of the origin and licence of weights; unknown entries are "unknown".

    Args:
        description: description of the network.
        command: command line that made the weights.
        training_data: description of the training data.
        split_hash: hash of the split into training and held-out data.
        seed: seed of the first weights and all random numbers.
        steps: number of steps of the optimiser.
        scores: scores on held-out data, by name.
        licence: licence of the weights.
        version: version of LightSim.
        streets: names of synthetic streets: `training` streets of the training data, `validation`
            streets that selected the weights.
        probe: output of a relighting network for input planes of noise
            (`relighting.network.stored`); it differs if code uses the planes in another way.
    """

    description: str
    command: str
    training_data: str
    split_hash: str
    seed: int | str
    steps: int | str
    scores: dict[str, Any] | str
    licence: str
    version: str
    streets: dict[str, list[str]] | str = UNKNOWN
    probe: float | str = UNKNOWN

    def metadata(self) -> dict[str, str]:
        """Return the metadata of a safetensors file: one entry, with a fixed order of fields."""
        return {"record": json.dumps(asdict(self))}

    def line(self) -> str:
        """Return a summary of one line for people."""
        return (
            f"{self.description}; {self.steps} steps, seed {self.seed}, "
            f"lightsim {self.version}; {self.licence}"
        )


def write_weights(path: Path, tensors: Mapping[str, Any], record: WeightsRecord) -> None:
    """Write tensors in half precision with their record."""
    import torch
    from safetensors import SafetensorError
    from safetensors.torch import save_file

    # Half precision, which halves the size of the shipped files.
    halved = {k: v.detach().cpu().to(torch.float16).contiguous() for k, v in tensors.items()}
    with whole_file(path) as temporary:
        try:
            save_file(halved, str(temporary), record.metadata())
        except SafetensorError as error:  # Raised when the disk is full.
            raise OSError(f"{error}") from error


def read_weights(path: Path) -> dict[str, Any]:
    """Return the tensors of a file that `write_weights` wrote, in single precision.

    Raises:
        ArtefactError: the file is missing or damaged.
    """
    import torch
    from safetensors import SafetensorError
    from safetensors.torch import load

    try:
        tensors = load(read_bytes(path, "weights file", _MAX_BYTES))
        return {name: tensor.to(torch.float32) for name, tensor in tensors.items()}
    except (InputError, SafetensorError) as error:
        raise ArtefactError(
            "the weights cannot be read",
            where=path,
            got=error.got if isinstance(error, InputError) else error,
            remedy="Build again.",
        ) from error


def read_record(path: Path) -> WeightsRecord:
    """Return the record of a file of weights without reading the tensors.

    Raises:
        ArtefactError: the file is missing or damaged, or has no record.
    """
    try:
        with open_regular(path, "weights file", _MAX_BYTES) as handle:
            # A safetensors file begins with the size of its JSON header, as 64-bit little endian.
            size = int.from_bytes(handle.read(8), "little")
            header = json.loads(handle.read(min(size, MAX_JSON_BYTES)))
        record = WeightsRecord(**json.loads(header["__metadata__"]["record"]))
        return replace(record, streets=_by_side(record.streets))
    except (InputError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise ArtefactError(
            "the weights have no record of how they were made",
            where=path,
            got=f"{type(error).__name__}: {error}"[:200],
            remedy="Train again; weights of lightsim 0.2 and before have none.",
        ) from error


def _by_side(streets: Any) -> dict[str, list[str]] | str:
    if isinstance(streets, str):
        return streets
    return {side: [str(name) for name in streets[side]] for side in ("training", "validation")}


def list_weights(folder: Path = WEIGHTS_FOLDER) -> dict[str, dict[str, str]]:
    """Return the shipped files and their SHA-256, by name of the weights.

    Raises:
        InputError: the manifest is missing or damaged.
    """
    path = folder / "manifest.json"
    try:
        entries = json.loads(read_bytes(path, "list of weights", MAX_JSON_BYTES))
        return {name: dict(files.items()) for name, files in entries.items()}
    except (InputError, ValueError, AttributeError) as error:
        raise InputError(
            "the list of weights cannot be read",
            where=path,
            got=error.got if isinstance(error, InputError) else error,
            remedy="Reinstall lightsim.",
        ) from error


def load_weights(name: str, folder: Path = WEIGHTS_FOLDER) -> dict[str, torch.Tensor]:
    """Return shipped tensors by name, on the CPU and in the stored precision.

    Raises:
        InputError: the weights are unknown, or a file is missing or differs from the published one.
    """
    from safetensors.torch import load

    known = list_weights(folder)
    if name not in known:
        raise InputError(
            "there are no weights of this name", got=name, expected=f"one of {', '.join(known)}"
        )
    tensors: dict[str, torch.Tensor] = {}
    for file, sha256 in known[name].items():
        tensors.update(load(_read_checked(folder / file, sha256)))
    return tensors


def _read_checked(path: Path, sha256: str) -> bytes:
    """Return the bytes of a file after verifying its SHA-256."""
    if not path.is_file():
        raise InputError("a weights file is missing", where=path, remedy="Reinstall lightsim.")
    content = read_bytes(path, "weights file", _MAX_BYTES)
    found = hashlib.sha256(content).hexdigest()
    if found != sha256:
        raise InputError(
            "a weights file is damaged or was replaced",
            where=path,
            got=f"sha256 {found[:12]}...",
            expected=f"{sha256[:12]}...",
            remedy="Reinstall lightsim.",
        )
    return content
