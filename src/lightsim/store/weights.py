"""Weights of networks: safetensors that carry their record; those of the package are checked."""

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

_MAX_BYTES = 1 << 30
"""The shipped files have some megabytes each, the largest field a tenth of this."""
WEIGHTS_FOLDER = Path(__file__).parents[1] / "data" / "weights"
UNKNOWN = "unknown"


@dataclass(frozen=True)
class WeightsRecord:
    """How weights came to be and what may be done with them; what is not known is "unknown".

    Args:
        description: the network, in words.
        command: the command line that made them.
        training_data: in words.
        split_hash: of what trained and what was held out.
        seed: of the first weights and all draws.
        steps: of the optimiser.
        scores: on held-out data, by name.
        licence: of the numbers.
        version: of lightsim.
        streets: names of synthetic streets, `training` those that it learned from, `validation`
            those that chose it.
        probe: what a relighting network makes of planes of noise (`relighting.network.stored`):
            code that uses its planes in another way makes another number.
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
        """For the header of a safetensors file: one entry, whose order of fields is fixed."""
        return {"record": json.dumps(asdict(self))}

    def line(self) -> str:
        """For people."""
        return (
            f"{self.description}; {self.steps} steps, seed {self.seed}, "
            f"lightsim {self.version}; {self.licence}"
        )


def write_weights(path: Path, tensors: Mapping[str, Any], record: WeightsRecord) -> None:
    """Tensors in half precision, and their record."""
    import torch
    from safetensors import SafetensorError
    from safetensors.torch import save_file

    halved = {k: v.detach().cpu().to(torch.float16).contiguous() for k, v in tensors.items()}
    with whole_file(path) as temporary:
        try:
            save_file(halved, str(temporary), record.metadata())
        except SafetensorError as error:  # Its own way to tell of a full disk.
            raise OSError(f"{error}") from error


def read_weights(path: Path) -> dict[str, Any]:
    """Single-precision tensors of a file that `write_weights` wrote.

    Raises:
        ArtefactError: it is missing or damaged.
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
    """The record that a weights file carries; tensors are not read.

    Raises:
        ArtefactError: the file is missing or damaged, or has no record.
    """
    try:
        with open_regular(path, "weights file", _MAX_BYTES) as handle:
            size = int.from_bytes(handle.read(8), "little")
            header = json.loads(handle.read(min(size, MAX_JSON_BYTES)))
        record = WeightsRecord(**json.loads(header["__metadata__"]["record"]))
        return replace(record, streets=_by_side(record.streets))
    except (InputError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise ArtefactError(
            "the weights carry no record of how they were made",
            where=path,
            got=f"{type(error).__name__}: {error}"[:200],
            remedy="Train again; weights of lightsim 0.2 and before have none.",
        ) from error


def _by_side(streets: Any) -> dict[str, list[str]] | str:
    if isinstance(streets, str):
        return streets
    return {side: [str(name) for name in streets[side]] for side in ("training", "validation")}


def list_weights(folder: Path = WEIGHTS_FOLDER) -> dict[str, dict[str, str]]:
    """The files of all weights of the package, with their sha256, by name of the weights.

    Raises:
        InputError: the manifest is missing or broken.
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
    """Tensors by name on the CPU, in the precision they are stored in.

    Raises:
        InputError: no such weights, or a file is missing or not the one that was published.
    """
    from safetensors.torch import load

    known = list_weights(folder)
    if name not in known:
        raise InputError("no such weights", got=name, expected=f"one of {', '.join(known)}")
    tensors: dict[str, torch.Tensor] = {}
    for file, sha256 in known[name].items():
        tensors.update(load(_read_checked(folder / file, sha256)))
    return tensors


def _read_checked(path: Path, sha256: str) -> bytes:
    """The bytes of a file whose digest is known."""
    if not path.is_file():
        raise InputError("a weights file is missing", where=path, remedy="Reinstall lightsim.")
    content = read_bytes(path, "weights file", _MAX_BYTES)
    found = hashlib.sha256(content).hexdigest()
    if found != sha256:
        raise InputError(
            "a weights file is damaged or was exchanged",
            where=path,
            got=f"sha256 {found[:12]}...",
            expected=f"{sha256[:12]}...",
            remedy="Reinstall lightsim.",
        )
    return content
