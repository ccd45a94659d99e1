"""Devices of networks, and processes that train one network together."""

from __future__ import annotations

import os
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TypeVar

import torch
import torch.distributed as distributed
from torch import Tensor

from lightsim.errors import InputError

T = TypeVar("T")


def choose_device(name: str) -> torch.device:
    """Return the device of "auto", "cpu" or "cuda"; "auto" is CUDA if a CUDA device is available.

    Raises:
        InputError: "cuda" without a CUDA device.
    """
    has_cuda = torch.cuda.is_available()
    if name == "cuda" and not has_cuda:
        raise InputError(
            "no CUDA device is available",
            where="--device cuda",
            remedy="Use --device cpu, or install a CUDA build of torch and a driver.",
        )
    return torch.device("cuda" if has_cuda and name != "cpu" else "cpu")


def device_of(network: torch.nn.Module) -> torch.device:
    """Return the device of a network's parameters."""
    return next(network.parameters()).device


@dataclass(frozen=True)
class Processes:
    """One of `count` processes that train the same networks; by default the only one."""

    rank: int = 0
    count: int = 1

    @property
    def is_first(self) -> bool:
        """True for the process that reads and writes files, and reports progress."""
        return self.rank == 0

    def from_first(self, make: Callable[[], T]) -> T:
        """Call `make` in the first process and return its result in all of them."""
        found = [make() if self.is_first else None]
        if self.count > 1:
            distributed.broadcast_object_list(found)
        return found[0]  # type: ignore[return-value]

    def any(self, value: bool) -> bool:
        """Return True in all processes if `value` is True in one, so that all branch alike."""
        if self.count == 1:
            return value
        found: list[bool] = [False] * self.count
        distributed.all_gather_object(found, value)
        return any(found)

    def average(self, gradients: Sequence[Tensor]) -> None:
        """Replace each gradient by its mean over the processes.

        All processes must pass gradients of the same parameters. `DistributedDataParallel` computes
        the same mean but requires that losses call only a network's `forward`; losses here call
        several of its methods.
        """
        if self.count == 1 or not gradients:
            return
        flat = torch.cat([gradient.flatten() for gradient in gradients])
        distributed.all_reduce(flat)
        parts = (flat / self.count).split([gradient.numel() for gradient in gradients])
        for gradient, part in zip(gradients, parts, strict=True):
            gradient.copy_(part.view_as(gradient))


ALONE = Processes()


@contextmanager
def joined_processes(device: torch.device) -> Generator[Processes]:
    """Join the processes that torchrun started (it sets WORLD_SIZE); otherwise yield `ALONE`."""
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        yield ALONE
        return
    if device.type == "cuda":
        torch.cuda.set_device(int(os.environ["LOCAL_RANK"]))
    distributed.init_process_group("nccl" if device.type == "cuda" else "gloo")
    try:
        yield Processes(distributed.get_rank(), distributed.get_world_size())
        # A process that exits early would close its connection and abort those still at work.
        distributed.barrier()
    finally:
        distributed.destroy_process_group()
