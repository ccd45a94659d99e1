"""Tensors of a TorchScript archive, read without running anything that the archive brings.

The archive is a zip: `data.pkl` holds the tree of modules, `data/<key>` the bytes of each tensor.
The pickle may name nothing but tensors and containers; the code beside it is never looked at.
"""

from __future__ import annotations

import io
import pickle
import zipfile
from typing import Any

import numpy as np

from lightsim.errors import InputError


class ScriptModule:
    """A module's attributes as the archive stores them; it computes nothing."""


def read_script_modules(content: bytes) -> dict[str, dict[str, Any]]:
    """Attributes of every module by its path ("" is the outermost); tensors are numpy arrays.

    Raises:
        InputError: this is no TorchScript archive, or it holds what is neither module nor tensor.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            tops = {name.split("/")[0] for name in archive.namelist()}
            if len(tops) != 1:
                raise KeyError("one folder")
            root = _Unpickler(archive, tops.pop()).load()
    except (zipfile.BadZipFile, pickle.UnpicklingError, KeyError, ValueError, EOFError) as error:
        raise InputError(
            "a TorchScript archive cannot be read",
            got=f"{type(error).__name__}: {error}"[:200],
            expected="an archive of modules and 32-bit tensors, as torch.jit.save writes it",
        ) from error
    found: dict[str, dict[str, Any]] = {}
    _collect("", root, found)
    return found


def _collect(path: str, module: ScriptModule, found: dict[str, dict[str, Any]]) -> None:
    found[path] = vars(module)
    for name, value in vars(module).items():
        if isinstance(value, ScriptModule):
            _collect(f"{path}.{name}" if path else name, value, found)


class _Unpickler(pickle.Unpickler):
    """Builds modules, lists of numbers and tensors; anything else a pickle may call is refused."""

    def __init__(self, archive: zipfile.ZipFile, top: str) -> None:
        super().__init__(io.BytesIO(archive.read(f"{top}/data.pkl")))
        self._archive, self._top = archive, top

    def find_class(self, module: str, name: str) -> Any:
        if module.startswith("__torch__."):
            return ScriptModule
        allowed = {
            ("torch._utils", "_rebuild_tensor_v2"): _tensor,
            ("torch.jit._pickle", "build_intlist"): list,
            ("torch", "FloatStorage"): np.float32,
            ("collections", "OrderedDict"): dict,
        }
        if (module, name) not in allowed:
            raise pickle.UnpicklingError(f"refused: {module}.{name}")
        return allowed[module, name]

    def persistent_load(self, pid: Any) -> np.ndarray:
        kind, dtype, key, _, size = pid
        values = np.frombuffer(self._archive.read(f"{self._top}/data/{key}"), "<f4")
        if (kind, dtype, len(values)) != ("storage", np.float32, size):
            raise pickle.UnpicklingError(f"storage {key} is not what the archive says")
        return values


def _tensor(
    storage: np.ndarray, offset: int, size: tuple[int, ...], stride: tuple[int, ...], *_: Any
) -> np.ndarray:
    """A contiguous tensor, copied: the archive's bytes are read-only."""
    count = int(np.prod(size))
    contiguous = tuple(int(np.prod(size[i + 1 :])) for i in range(len(size)))
    if tuple(stride) != contiguous or not 0 <= offset <= len(storage) - count:
        raise pickle.UnpicklingError("a tensor does not lie in its storage in order")
    return storage[offset : offset + count].reshape(size).copy()
