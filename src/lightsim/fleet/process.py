"""Processes of lines on one machine: their run, their cost, and as many as cores allow."""

from __future__ import annotations

import os
import resource
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Generator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path

from lightsim.core.cores import THREADS, core_count
from lightsim.fleet.lines import Line, Record

PROGRAM = ("-m", "lightsim.fleet.child")
"""Arguments of the Python interpreter that runs a line."""
# Exit code of a shell for an interrupted command.
_INTERRUPTED = 130


class Processes:
    """Running processes of lines, which can be stopped together."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._alive: set[int] = set()
        self._is_stopped = False

    def run(
        self,
        words: tuple[str, ...],
        log: Path,
        environment: Mapping[str, str],
        program: Sequence[str],
        folder: Path | None = None,
    ) -> Record:
        """Run a line to its end.

        Args:
            words: the command and its words.
            log: file for the output.
            environment: of the process.
            program: arguments of the interpreter before the words.
            folder: working directory; by default that of this process.
        """
        start = time.monotonic()
        with log.open("wb") as output:
            with self._lock:
                if self._is_stopped:
                    return Record(words, state="failed", exit_code=_INTERRUPTED)
                # A process of its own: Dr.Jit must not be forked, and its memory is returned.
                process = subprocess.Popen(
                    [sys.executable, *program, *words],
                    stdout=output,
                    stderr=subprocess.STDOUT,
                    env=environment,
                    cwd=folder,
                )
                self._alive.add(process.pid)
            usage = self._wait(process)
        return Record(
            words,
            state="done" if process.returncode == 0 else "failed",
            exit_code=process.returncode,
            seconds=round(time.monotonic() - start, 2),
            cpu_seconds=round(usage.ru_utime + usage.ru_stime, 2),
            # Linux gives kilobytes (getrusage(2)).
            peak_memory_mb=usage.ru_maxrss // 1024,
            host=socket.gethostname(),
            last_line=_last_line(log, process.returncode),
        )

    def _wait(self, process: subprocess.Popen[bytes]) -> resource.struct_rusage:
        """Wait for the end of a process; return its cost and that of its children."""
        try:
            # The process is reaped after it has left the set: its number is not sent a signal then.
            os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
        except BaseException:
            process.terminate()
            raise
        finally:
            with self._lock:
                self._alive.discard(process.pid)
            _, status, usage = os.wait4(process.pid, 0)
            process.returncode = os.waitstatus_to_exitcode(status)
        return usage

    def stop(self) -> None:
        """Send SIGTERM, upon which a command ends cleanly."""
        with self._lock:
            self._is_stopped = True
            for pid in self._alive:
                os.kill(pid, signal.SIGTERM)


def run_here(lines: Sequence[Line], jobs: int) -> Generator[tuple[Line, Record]]:
    """Run lines on this machine, `jobs` at a time; yield each with its record when it ends.

    Each process uses OMP_NUM_THREADS cores, by default an equal part of all.
    """
    # Without a limit each process would start threads for all cores. The user's value wins.
    environment = {THREADS: str(max(1, core_count() // jobs)), **os.environ}
    processes = Processes()
    with ThreadPoolExecutor(jobs) as pool:
        futures = {
            pool.submit(processes.run, line.words, line.log, environment, PROGRAM): line
            for line in lines
        }
        try:
            for future in as_completed(futures):
                yield futures[future], future.result()
        except BaseException:
            # Also at Ctrl-C: processes must not outlive the batch.
            processes.stop()
            pool.shutdown(wait=True, cancel_futures=True)
            raise


def _last_line(log: Path, exit_code: int) -> str:
    if exit_code < 0:
        hint = " (out of memory?)" if exit_code == -signal.SIGKILL else ""
        return f"killed by {signal.Signals(-exit_code).name}{hint}"
    lines = log.read_text(errors="replace").strip().splitlines()
    return lines[-1][:300] if lines else "no output"
