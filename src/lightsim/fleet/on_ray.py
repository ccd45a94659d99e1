"""Lines of a batch on a Ray cluster, which schedules, limits memory and repeats lost lines.

A task is a process that runs the line's command; no object larger than a record is passed.
"""

from __future__ import annotations

import os
import secrets
import signal
import socket
import sys
import tempfile
import threading
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from lightsim.core.cores import THREADS, core_count
from lightsim.errors import InputError, need
from lightsim.fleet import process
from lightsim.fleet.lines import Line, Record, Request

# Ray's smallest object store is 75 MB; /dev/shm of a container often has 64 MB, and then Ray uses
# the disk. Records need a few kB.
_OBJECT_STORE_BYTES = 80 * 2**20
# Attempts after a lost worker, a lost node or a killed process; Ray's own default.
_RETRIES = 3
# Bytes of a line's output that are returned. Ray passes results below 100 kB without its object
# store.
_OUTPUT_BYTES = 60_000


class KilledError(Exception):
    """A line's process was killed by a signal, which Ray answers with another attempt."""

    def __init__(self, record: Record, output: bytes) -> None:
        # Exceptions are copied between processes by their arguments.
        super().__init__(record, output)
        self.record, self.output = record, output


def run_on_ray(
    request_by_line: Mapping[Line, Request], address: str
) -> Generator[tuple[Line, Record]]:
    """Run lines on a Ray cluster; yield each with its record when it ends.

    Args:
        request_by_line: resources of each line. Lines wait until a node has them free.
        address: of the cluster; empty starts Ray on this machine.

    Raises:
        MissingDependencyError: Ray is not installed.
        InputError: no cluster answers at the address.
    """
    with _connected(address) as ray:
        task = ray.remote(max_retries=_RETRIES, retry_exceptions=[KilledError])(_run_line)
        nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
        lines: dict[Any, Line] = {}
        for line, request in request_by_line.items():
            options = _task_options(request, nodes if not address else [])
            words = (process.PROGRAM, line.words, options["num_cpus"], os.getcwd())
            lines[task.options(name=line.log.stem, **options).remote(*words)] = line
        waiting = list(lines)
        while waiting:
            ended, waiting = ray.wait(waiting, num_returns=1)
            for reference in ended:
                yield lines[reference], _record_of(ray, reference, lines[reference])


def _run_line(
    program: Sequence[str], words: tuple[str, ...], cores: int, folder: str
) -> tuple[Record, bytes]:
    """Run a line on a node; return its record and the end of its output."""
    environment = {
        **os.environ,
        THREADS: str(cores),
        # Per node: compiled code of one processor fails on another, and an installation on a
        # network file system is shared.
        "NUMBA_CACHE_DIR": os.environ.get("NUMBA_CACHE_DIR")
        or str(Path(tempfile.gettempdir()) / f"lightsim-numba-{os.getuid()}"),
    }
    with tempfile.TemporaryDirectory(prefix="lightsim-") as own:
        log = Path(own) / "output.log"
        # A machine without the folder runs lines with absolute paths or URLs.
        place = Path(folder) if Path(folder).is_dir() else Path(own)
        record = process.Processes().run(words, log, environment, program, place)
        output = log.read_bytes()[-_OUTPUT_BYTES:]
    if record.exit_code < 0:
        raise KilledError(record, output)
    return record, output


def _record_of(ray: Any, reference: Any, line: Line) -> Record:
    """Return the record of a task that ended, and write its output beside it."""
    try:
        record, output = ray.get(reference)
    except KilledError as error:
        record, output = error.record, error.output
    except ray.exceptions.RayError as error:
        # The worker or its node was lost in every attempt, or the task could not start.
        text = f"{type(error).__name__}: {error}".strip()
        record = Record(line.words, state="failed", exit_code=1, last_line=text.splitlines()[0])
        output = text.encode()
    line.log.write_bytes(output)
    return record


def _task_options(request: Request, nodes: Sequence[Mapping[str, float]]) -> dict[str, Any]:
    """Return Ray's options of a task, at most what the largest of the known nodes has: a larger
    request would wait for ever."""
    cores = min([request.cores, *(int(node.get("CPU", 1)) for node in nodes)])
    memory = min([request.memory_mb * 10**6, *(int(node.get("memory", 0)) for node in nodes)])
    gpus = {"num_gpus": request.gpus} if request.gpus else {}
    return {"num_cpus": max(1, cores), "memory": memory, **gpus}


@contextmanager
def _connected(address: str) -> Generator[Any]:
    """Yield the module ray, connected to a cluster or to a new one on this machine.

    Raises:
        MissingDependencyError, InputError: as `run_on_ray`.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    # Ray reads these when it is imported.
    if not address and "ray" not in sys.modules:
        # A token of this process alone; without one, Ray would write one to the home folder.
        os.environ.setdefault("RAY_AUTH_MODE", "token")
        os.environ.setdefault("RAY_AUTH_TOKEN", secrets.token_hex(32))
    ray = need("ray", extra="fleet")
    own = {} if address else {
        "num_cpus": core_count(),
        "include_dashboard": False,
        "object_store_memory": _OBJECT_STORE_BYTES,
    }  # fmt: skip
    # Ray replaces the handler that makes SIGTERM an interruption.
    is_main = threading.current_thread() is threading.main_thread()
    handler = signal.getsignal(signal.SIGTERM)
    try:
        _check_reachable(address)
        ray.init(address or "local", log_to_driver=False, logging_level="WARNING", **own)
    except (OSError, RuntimeError, ray.exceptions.RayError) as error:
        raise InputError(
            "no Ray cluster answers",
            where=f"--address {address}",
            got=str(error).splitlines()[0].rstrip("."),
            remedy="Start one with ray start --head, or leave out --address to start Ray here.",
        ) from error
    if is_main:
        signal.signal(signal.SIGTERM, handler)
    try:
        yield ray
    finally:
        # Ends the tasks of this batch; their processes are killed with their workers.
        ray.shutdown()


def _check_reachable(address: str) -> None:
    """Raise OSError if nothing listens at HOST:PORT, for which Ray itself waits two minutes."""
    host, _, port = address.rpartition(":")
    if host and port.isdigit() and "/" not in host:
        socket.create_connection((host, int(port)), timeout=10.0).close()
