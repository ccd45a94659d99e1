"""What the relighting network itself costs: processor seconds, frames a second and memory.

    python benchmarks/relight_network.py [--width 1920] [--device cpu|cuda] [--repeats 5]

Planes of random numbers, the shipped weights: neither changes the time. Physical
relighting and tracing come before it and are not counted (benchmarks/edited_frame.py,
docs/benchmarks/rendering.md). `network`: planes that lie on the device to a picture there;
`whole`: from planes in main memory to a picture in main memory. Medians; the first repeat, which
makes kernels, is left out. On CUDA both in single precision and in bfloat16.
"""

from __future__ import annotations

import argparse
import resource
import sys
import time
from collections.abc import Callable

import numpy as np
import torch

from lightsim.relighting.network.channels import DOME_ROWS, LIGHT, SCENE, TARGET, Planes
from lightsim.relighting.network.features import Batch, downsampled, tensors_of
from lightsim.relighting.network.model import RelitNet
from lightsim.relighting.network.stored import network_for


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
    network = network_for(RelitNet, None).to(device)
    before_mb = peak_mb(device)

    def look(batch: Batch) -> torch.Tensor:
        with torch.autocast(device.type, enabled=False):
            working = downsampled(batch, network.config.working_columns)
        return network(batch, working).picture

    is_cuda = device.type == "cuda"
    precisions = (torch.float32, torch.bfloat16) if is_cuda else (torch.float32,)

    def report(name: str, action: Callable[[], object]) -> None:
        for precision in precisions:
            is_mixed = precision == torch.bfloat16
            with torch.inference_mode(), torch.autocast(device.type, precision, enabled=is_mixed):
                processor, wall = clock(action, options.repeats, device)
            sys.stdout.write(
                f"{options.width}x{height}, {options.device}, {precision}, {name}: median "
                f"{processor:.3f} processor seconds, {1 / wall:.2f} frames a second\n"
            )

    report("whole", lambda: look(tensors_of(planes, device)).cpu())
    peak = peak_mb(device) - before_mb
    sys.stdout.write(f"{peak:.0f} MB above {before_mb:.0f} MB\n")
    here = tensors_of(planes, device)
    report("network", lambda: look(here))


def clock(action: Callable[[], object], repeats: int, device: torch.device) -> tuple[float, float]:
    """Median processor and wall-clock seconds."""
    processor, wall = [], []
    for _ in range(repeats + 1):
        began, began_wall = time.process_time(), time.monotonic()
        action()
        if device.type == "cuda":
            torch.cuda.synchronize()
        processor.append(time.process_time() - began)
        wall.append(time.monotonic() - began_wall)
    return float(np.median(processor[1:])), float(np.median(wall[1:]))


def peak_mb(device: torch.device) -> float:
    """Of the device's memory, or of this process."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated() / 2**20
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


if __name__ == "__main__":
    main()
