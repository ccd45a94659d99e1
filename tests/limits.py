"""Runs code in a process of its own with a ceiling on time and memory, for files that attack.

Where a reader fails, the child dies at its ceiling; the test run neither hangs nor swells.
"""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import dataclass

_PROLOGUE = """\
import atexit, resource, sys
resource.setrlimit(resource.RLIMIT_CPU, ({cpu_s}, {cpu_s} + 1))
resource.setrlimit(resource.RLIMIT_AS, ({memory_mb} << 20, {memory_mb} << 20))
resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
def _say_peak():
    # ru_maxrss would count the parent, whose memory the child shares until it runs Python.
    with open("/proc/self/status") as status:
        peak_kb = next(int(line.split()[1]) for line in status if line.startswith("VmHWM"))
    usage = resource.getrusage(resource.RUSAGE_SELF)
    print("LIMITS", peak_kb // 1024, usage.ru_utime + usage.ru_stime, file=sys.stderr)
atexit.register(_say_peak)
"""


@dataclass(frozen=True)
class Finished:
    """What a child said, and what it took.

    Args:
        output: its standard output.
        peak_mb: largest resident size, MiB.
        cpu_s: user and system seconds.
    """

    output: str
    peak_mb: int
    cpu_s: float


def run_limited(
    code: str, *arguments: object, cpu_s: int = 10, memory_mb: int = 2048, wall_s: float = 60.0
) -> Finished:
    """Run Python code to its end under limits; `arguments` are its `sys.argv[1:]`.

    Args:
        code: of a script; what it prints comes back.
        arguments: handed over as text.
        cpu_s: ceiling on seconds of computing, imports included.
        memory_mb: ceiling on address space, MiB; importing numpy takes some 300 of it.
        wall_s: ceiling on waiting, for reads that block.

    Raises:
        AssertionError: it ran into a ceiling, or ended with an error; its last words are given.
    """
    script = _PROLOGUE.format(cpu_s=cpu_s, memory_mb=memory_mb) + code
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join(path for path in sys.path if path),
        "OPENBLAS_NUM_THREADS": "1",
        "OMP_NUM_THREADS": "1",
    }
    command = [sys.executable, "-c", script, *map(str, arguments)]
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=wall_s, env=environment, check=False
        )
    except subprocess.TimeoutExpired as error:
        raise AssertionError(f"blocked for more than {wall_s} s") from error
    said = done.stderr.strip().splitlines()
    if done.returncode != 0:
        raise AssertionError(f"ended with {done.returncode}: {' | '.join(said[-4:])[-600:]}")
    _, peak_mb, seconds = next(line for line in reversed(said) if line.startswith("LIMITS")).split()
    return Finished(done.stdout, int(peak_mb), float(seconds))
