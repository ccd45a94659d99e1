"""How many of the machine's cores a process may use."""

from __future__ import annotations

import os
from collections.abc import MutableMapping

THREADS = "OMP_NUM_THREADS"
"""The variable by which a user says so; torch, OpenMP and this package listen to it."""
_OF_NUMBA = "NUMBA_NUM_THREADS"


def core_count() -> int:
    """Cores that this process may run on."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def tell_numba(environment: MutableMapping[str, str]) -> None:
    """Make what a user says hold for numba, too, before it is imported. It knows a variable of its
    own alone, and its first parallel loop hands that number, or all cores, on to torch: processes
    that share cores then wait for each other's threads, ten times as long as they work."""
    if environment.get(THREADS):
        environment.setdefault(_OF_NUMBA, environment[THREADS].split(",")[0])
