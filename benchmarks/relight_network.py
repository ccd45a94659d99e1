"""What the relighting network itself costs: processor seconds, frames a second and memory.

    python benchmarks/relight_network.py [--width 1920] [--device cpu] [--repeats 5]

Planes of random numbers, first weights of the shipped size: neither changes the time. Physical
relighting and tracing come before it and are not counted (benchmarks/edited_frame.py,
docs/benchmarks/rendering.md).
"""

from __future__ import annotations

import argparse
import resource
import sys
import time

import numpy as np
import torch

from lightsim.relighting.network.channels import DOME_ROWS, LIGHT, SCENE, TARGET, Planes, shrunk
from lightsim.relighting.network.features import tensors_of
from lightsim.relighting.network.model import RelitNet, RelitNetConfig


def random_planes(height: int, width: int) -> Planes:
    """One frame."""
    rng = np.random.default_rng(0)
    names = {
        **SCENE,
        **{f"source_{name}": count for name, count in LIGHT.items()},
        **{f"target_{name}": count for name, count in {**LIGHT, **TARGET}.items()},
    }
    planes = {
        name: rng.random((count, height, width), dtype=np.float32) for name, count in names.items()
    }
    for which in ("source", "target"):
        planes[f"{which}_dome"] = rng.random((3, DOME_ROWS, 2 * DOME_ROWS), dtype=np.float32)
    return planes


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--width", type=int, default=1920)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    height = round(options.width * 9 / 16)
    planes, device = random_planes(height, options.width), torch.device(options.device)
    config = RelitNetConfig()
    network = RelitNet(config).eval().to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]
    before_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    processor, wall = [], []
    is_cuda = device.type == "cuda"
    for _ in range(options.repeats + 1):
        began, began_wall = time.process_time(), time.monotonic()
        batch = tensors_of(planes, device)
        working = tensors_of(shrunk(planes, config.working_columns), device)
        with torch.inference_mode(), torch.autocast(device.type, torch.bfloat16, enabled=is_cuda):
            network(batch, working).picture.sum().item()
        processor.append(time.process_time() - began)
        wall.append(time.monotonic() - began_wall)
    # The first repeat makes kernels.
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    sys.stdout.write(
        f"{options.width}x{height}, {options.device}: median {np.median(processor[1:]):.2f} "
        f"processor seconds, {1 / np.median(wall[1:]):.2f} frames a second, "
        f"{peak_mb - before_mb:.0f} MB above the planes' {before_mb:.0f} MB\n"
    )


if __name__ == "__main__":
    main()
