"""Time of the hash grid's implementations, side by side; prints tables, asserts nothing.

    python benchmarks/bench_hash_grid.py [--points 65536] [--repeats 21] [--threads 2] [--torch]

Measured: forward, backward (to the table) and sparse Adam, alone and as a whole step; then the
step with two layers of 64 behind the grid. All implementations take turns within one run, so that
other work on the machine slows all of them; figures are medians, ratios are medians of the ratios
within a turn. `--torch` adds the plain implementation, much slower. The C++ reference
(hash_grid_reference.cpp) needs g++ and is left out without it. With a CUDA device Triton joins.
"""

from __future__ import annotations

import argparse
import ctypes
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lightsim.reconstruct.field.hash_grid.grid import (
    HashGridSpec,
    Implementation,
    hash_encode,
    make_table,
)
from lightsim.reconstruct.field.hash_grid.sparse_adam import SparseAdam
from lightsim.reconstruct.field.hash_grid.sparse_gradient import zeros_on

SPEC = HashGridSpec(levels=12, features=2, log2_entries=20, coarsest_m=4.0, finest_m=0.1)
RATE = 1e-2
PARTS = ("forward", "backward", "Adam")


def make_points(kind: str, count: int, seed: int) -> Tensor:
    """Metres in a street of 140x60x22 m: anywhere ("uniform") or along rays near surfaces."""
    rng = np.random.default_rng(seed)
    if kind == "uniform":
        points = rng.uniform(0, 1, (count, 3)) * (140, 60, 22)
    else:
        rays = -(-count // 32)
        origins = rng.uniform(0, 1, (rays, 1, 3)) * (140, 60, 2)
        directions = rng.normal(size=(rays, 1, 3))
        directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
        distances = rng.uniform(5, 40, (rays, 1, 1)) + np.linspace(-0.6, 0.6, 32)[:, None]
        points = (origins + directions * distances).reshape(-1, 3)[:count]
    return torch.from_numpy(np.ascontiguousarray(points, np.float32))


class Package:
    """One implementation of the package, with its table and optimiser."""

    def __init__(self, implementation: Implementation, points: Tensor, upstream: Tensor) -> None:
        self.name: Implementation = implementation
        device = "cuda" if implementation == "triton" else "cpu"
        self.points, self.upstream = points.to(device), upstream.to(device)
        self.table = make_table(SPEC, torch.Generator().manual_seed(0), device)
        self.optimiser = SparseAdam(self.table, learning_rate=RATE)
        self.features = torch.empty(0)

    def encode(self) -> Tensor:
        return hash_encode(self.points, self.table, SPEC, implementation=self.name)

    def forward(self) -> None:
        self.features = self.encode()

    def backward(self) -> None:
        self.features.backward(self.upstream)

    def step(self) -> None:
        self.optimiser.step()


class Reference:
    """The C++ loops, called on plain arrays."""

    name = "C++"

    def __init__(self, library: ctypes.CDLL, points: Tensor, upstream: Tensor) -> None:
        self.library, self.points, self.upstream = library, points, upstream
        shape = SPEC.table_shape()
        self.table = make_table(SPEC, torch.Generator().manual_seed(0)).detach()
        self.gradient, self.mean, self.square = (zeros_on("cpu", shape) for _ in range(3))
        self.is_touched = torch.zeros(shape[0] // 8, dtype=torch.uint8)
        self.salt = torch.zeros(len(points), dtype=torch.int32)
        self.scales = torch.from_numpy(SPEC.cells_per_m())
        self.features = torch.empty((len(points), SPEC.output_dim))
        self.steps = 0
        self.sizes = ctypes.c_int64(len(points)), SPEC.levels, SPEC.log2_entries

    def forward(self) -> None:
        inputs = pointers(self.points, self.salt, self.table, self.scales)
        self.library.look_up(*inputs, *self.sizes, *pointers(self.features))

    def backward(self) -> None:
        inputs = pointers(self.points, self.salt, self.scales)
        outputs = pointers(self.upstream, self.gradient, self.is_touched)
        self.library.scatter(*inputs, *self.sizes, *outputs)

    def step(self) -> None:
        self.steps += 1
        step_size = RATE / (1 - 0.9**self.steps)
        correction = (1 - 0.99**self.steps) ** -0.5
        rates = [ctypes.c_float(x) for x in (0.9, 0.99, step_size, correction, 1e-15)]
        arrays = pointers(self.table, self.gradient, self.mean, self.square, self.is_touched)
        self.library.update_touched(*arrays, ctypes.c_int64(len(self.is_touched)), *rates)

    def encode(self) -> Tensor:
        return _ReferenceEncode.apply(torch.empty(0, requires_grad=True), self)  # pyright: ignore[reportReturnType]


class _ReferenceEncode(torch.autograd.Function):
    """The C++ loops inside torch's backward pass, as a training step would use them."""

    @staticmethod
    def forward(ctx: Any, _anchor: Tensor, reference: Reference) -> Tensor:
        ctx.reference = reference
        reference.forward()
        return reference.features.clone()

    @staticmethod
    def backward(ctx: Any, *upstreams: Tensor) -> tuple[None, None]:
        ctx.reference.upstream = upstreams[0].contiguous()
        ctx.reference.backward()
        return None, None


def pointers(*tensors: Tensor) -> list[ctypes.c_void_p]:
    return [ctypes.c_void_p(tensor.data_ptr()) for tensor in tensors]


def build_reference(folder: str) -> ctypes.CDLL | None:
    """Compile the C++ loops; None where there is no compiler."""
    compiler = shutil.which("g++")
    if compiler is None:
        return None
    source = Path(__file__).with_name("hash_grid_reference.cpp")
    target = Path(folder) / "reference.so"
    flags = ["-O3", "-march=native", "-ffast-math", "-fopenmp", "-shared", "-fPIC"]
    subprocess.run([compiler, *flags, str(source), "-o", str(target)], check=True)
    return ctypes.CDLL(str(target))


def clock(action: Callable[[], Any]) -> float:
    start = time.perf_counter()
    action()
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return 1e3 * (time.perf_counter() - start)


def take_turns(runners: list[Any], repeats: int) -> dict[str, np.ndarray]:
    """Milliseconds [repeats, 3] of the three parts; the first turn compiles and is dropped."""
    times: dict[str, list[list[float]]] = {runner.name: [] for runner in runners}
    for turn in range(repeats + 1):
        for runner in runners[turn % 2 :] + runners[: turn % 2]:
            parts = [clock(part) for part in (runner.forward, runner.backward, runner.step)]
            if turn:
                times[runner.name].append(parts)
    return {name: np.array(rows) for name, rows in times.items()}


def with_network(runners: list[Any], repeats: int) -> dict[str, np.ndarray]:
    """Milliseconds [repeats, 1] of training steps through two layers of 64."""
    times: dict[str, list[list[float]]] = {runner.name: [] for runner in runners}
    for turn in range(repeats + 1):
        for runner in runners:
            device = runner.points.device
            torch.manual_seed(0)
            network = torch.nn.Sequential(
                torch.nn.Linear(SPEC.output_dim, 64),
                torch.nn.ReLU(),
                torch.nn.Linear(64, 64),
                torch.nn.ReLU(),
                torch.nn.Linear(64, 1),
            ).to(device)
            adam = torch.optim.Adam(network.parameters(), lr=2e-3)

            def step(runner: Any = runner, network: Any = network, adam: Any = adam) -> None:
                network(runner.encode()).square().mean().backward()
                adam.step()
                runner.step()

            parts = [clock(step)]
            if turn:
                times[runner.name].append(parts)
    return {name: np.array(rows) for name, rows in times.items()}


def report(title: str, columns: tuple[str, ...], times: dict[str, np.ndarray]) -> None:
    base_name = "C++" if "C++" in times else "numba"
    base = times[base_name].sum(axis=1)
    sys.stdout.write(f"\n{title}\n| ms | {' | '.join((*columns, 'step'))} | step / {base_name} |\n")
    sys.stdout.write("|---" + "|---:" * (len(columns) + 2) + "|\n")
    for name, rows in times.items():
        medians = [f"{value:.1f}" for value in np.median(rows, axis=0)] if columns else []
        total = rows.sum(axis=1)
        ratio = np.median(total / base)
        cells = [name, *medians, f"{np.median(total):.1f}", f"{ratio:.2f}"]
        sys.stdout.write(f"| {' | '.join(cells)} |\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--points", type=int, default=65536)
    parser.add_argument("--repeats", type=int, default=21)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--torch", action="store_true", help="add the plain implementation")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    os.environ["OMP_NUM_THREADS"] = str(options.threads)
    names: list[Implementation] = ["numba", "torch"] if options.torch else ["numba"]
    if torch.cuda.is_available():
        names.append("triton")
    with tempfile.TemporaryDirectory() as folder:
        library = build_reference(folder)
        for kind in ("rays", "uniform"):
            points = make_points(kind, options.points, 0)
            upstream = torch.randn((options.points, SPEC.output_dim))
            runners: list[Any] = [Package(name, points, upstream) for name in names]
            if library is not None:
                runners.insert(0, Reference(library, points, upstream))
            title = f"{options.points} points, {kind}"
            report(title, PARTS, take_turns(runners, options.repeats))
            report(f"{title}, with network", (), with_network(runners, options.repeats))


if __name__ == "__main__":
    main()
