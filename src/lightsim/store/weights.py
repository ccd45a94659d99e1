"""Network weights that ship with the package: safetensors, checked before use."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from lightsim.errors import InputError
from lightsim.store.reading import MAX_JSON_BYTES, read_bytes

if TYPE_CHECKING:
    import torch

_MAX_BYTES = 1 << 30
"""The shipped files have some megabytes each."""
WEIGHTS_FOLDER = Path(__file__).parents[1] / "data" / "weights"


@dataclass(frozen=True)
class WeightsCard:
    """Where weights come from and what may be done with them (one entry of manifest.json).

    Args:
        name: what `load_weights` is asked for.
        sha256_by_file: the shards, in the folder of the manifest.
        description: network and training data.
        source: package or paper the numbers were taken from.
        licence: of the numbers.
    """

    name: str
    sha256_by_file: dict[str, str]
    description: str
    source: str
    licence: str


def list_weights(folder: Path = WEIGHTS_FOLDER) -> dict[str, WeightsCard]:
    """All weights of the package, by name.

    Raises:
        InputError: the manifest is missing or broken.
    """
    path = folder / "manifest.json"
    try:
        entries = json.loads(read_bytes(path, "list of weights", MAX_JSON_BYTES))
        return {name: WeightsCard(name, **entry) for name, entry in entries.items()}
    except (InputError, ValueError, TypeError, AttributeError) as error:
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

    cards = list_weights(folder)
    if name not in cards:
        raise InputError("no such weights", got=name, expected=f"one of {', '.join(cards)}")
    tensors: dict[str, torch.Tensor] = {}
    for file, sha256 in cards[name].sha256_by_file.items():
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
