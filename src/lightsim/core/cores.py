"""Number of processor cores and threads that a process may use."""

from __future__ import annotations

import os
from collections.abc import Mapping, MutableMapping

from lightsim.errors import InputError

THREADS = "OMP_NUM_THREADS"
"""Environment variable for the number of threads; torch, OpenMP and this package obey it."""
_OF_NUMBA = "NUMBA_NUM_THREADS"


def core_count() -> int:
    """Return the number of cores that this process may run on."""
    # Containers and batch systems restrict the affinity; cpu_count returns all cores of the
    # machine.
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def worker_count() -> int:
    """Return the number of threads for parallel work: OMP_NUM_THREADS, at most the usable cores."""
    wanted = _outer_threads(os.environ)
    return min(int(wanted), core_count()) if wanted.isdecimal() and int(wanted) else core_count()


def check_shared_loops(where: str) -> None:
    """Check that several threads may run numba's parallel loops at the same time.

    Raises:
        InputError: numba has no thread-safe threading layer here; `where` is the option that
            requires one.
    """
    import numba
    from numba.np.ufunc.parallel import threading_layer

    # Numba chooses a layer when it starts its threads.
    numba.set_num_threads(numba.get_num_threads())
    if threading_layer() == "workqueue":
        raise InputError(
            "several threads cannot run numba's loops at the same time",
            where=where,
            got="the threading layer workqueue",
            expected="tbb or omp",
            remedy=f"Install the package tbb, or leave out {where}.",
        )


def divide_threads(parts: int) -> None:
    """Divide the threads of numba's loops by the number of threads that run such loops at a time.

    Each of these threads calls this function.

    Torch keeps its threads: their number changes the last digit of its sums.
    """
    import numba

    numba.set_num_threads(max(1, numba.get_num_threads() // parts))


def limit_numba_threads(environment: MutableMapping[str, str]) -> None:
    """Set numba's thread count from OMP_NUM_THREADS; call it before numba is imported.

    Numba obeys only a variable of its own, and its first parallel loop imposes that number, or all
    cores, on torch. Several processes on the same cores then spend most of their time waiting for
    each other's threads.
    """
    if environment.get(THREADS):
        environment.setdefault(_OF_NUMBA, _outer_threads(environment))


def _outer_threads(environment: Mapping[str, str]) -> str:
    """Return the first number of OMP_NUM_THREADS: OpenMP accepts a list, one for each level of
    nested loops."""
    return environment.get(THREADS, "").split(",")[0]
