"""One command over many logs: a process for each log, finished logs are skipped, failures are
reported at the end."""

from __future__ import annotations

import hashlib
import json
import os
import shlex
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from lightsim.core.checks import check_number
from lightsim.core.cores import THREADS, core_count
from lightsim.core.version import __version__
from lightsim.errors import InputError
from lightsim.progress import Progress
from lightsim.simulation.shard import Shard
from lightsim.store.artefact import write_text
from lightsim.store.reading import MAX_JSON_BYTES, read_bytes

BatchCommand = Literal["synthesize", "build", "train", "relight", "evaluate"]
_PROGRAM = (sys.executable, "-m", "lightsim")


@dataclass(frozen=True, kw_only=True)
class BatchOptions:
    """Options of a batch over logs."""

    out: Path
    """Folder for the commands' output (<log>.log) and for markers of finished logs (<log>.done)."""
    jobs: int = 1
    """Processes at a time; each uses OMP_NUM_THREADS cores, by default an equal part of all."""
    shard: str = ""
    """I/N, I from 1 to N: take the I-th of N parts of the list; parts may use the same DIR."""

    def __post_init__(self) -> None:
        check_number("--jobs", self.jobs, 1, 1024)
        Shard.parse(self.shard)


@dataclass(frozen=True)
class BatchResult:
    """Outcome of a batch.

    Args:
        run: number of lines that were run.
        kept: number of lines that had been finished before.
        failed: last line of each failed command's output, by its output file.
    """

    run: int
    kept: int
    failed: Mapping[Path, str]


@dataclass(frozen=True)
class _Job:
    words: tuple[str, ...]
    log: Path

    @property
    def done(self) -> Path:
        return self.log.with_suffix(".done")

    @property
    def record(self) -> str:
        """Content of the .done file: results of other words or other versions do not count as
        finished."""
        return json.dumps({"words": self.words, "version": __version__}) + "\n"

    def is_done(self) -> bool:
        return self.done.is_file() and self.done.read_text() == self.record


def read_list(path: Path) -> list[tuple[str, ...]]:
    """Return the words of each line of a list of logs.

    A line has the words that follow the command, quoted as in a shell; # starts a comment.

    Raises:
        InputError: the file cannot be read, or a line's quotes do not match.
    """
    lines = []
    text = read_bytes(path, "list of logs", MAX_JSON_BYTES).decode("utf-8", errors="replace")
    for number, line in enumerate(text.splitlines(), start=1):
        try:
            words = tuple(shlex.split(line, comments=True))
        except ValueError as error:
            raise InputError(
                "a line of the list cannot be read",
                where=f"{path}:{number}",
                got=error,
                expected="words as in a shell",
            ) from error
        if words:
            lines.append(words)
    return lines


def run_batch(
    command: BatchCommand,
    lines: Sequence[tuple[str, ...]],
    options: BatchOptions,
    progress: Progress,
) -> BatchResult:
    """Run `lightsim COMMAND LINE` for each line of this shard that is not finished.

    A line is finished when its command succeeded with these words in this version. A failed or
    interrupted line is run again, and resumes if its command can.

    Raises:
        InputError: there are no lines.
    """
    if not lines:
        raise InputError("the list contains no log", expected="one or more lines")
    options.out.mkdir(parents=True, exist_ok=True)
    # Repeated lines would write the same files at the same time.
    chosen = Shard.parse(options.shard).of(list(dict.fromkeys(lines)))
    jobs = [_job((command, *words), options.out) for words in chosen]
    pending = [job for job in jobs if not job.is_done()]
    running = _Running(options.jobs)
    failed: dict[Path, str] = {}
    with ThreadPoolExecutor(options.jobs) as pool:
        futures = {pool.submit(running.run, job): job for job in pending}
        try:
            for future in progress.track(as_completed(futures), command, len(pending)):
                if future.result():
                    failed[futures[future].log] = _last_line(futures[future].log)
        except BaseException:
            # Also at Ctrl-C: processes must not outlive the batch.
            running.stop()
            pool.shutdown(wait=True, cancel_futures=True)
            raise
    return BatchResult(len(pending), len(jobs) - len(pending), failed)


def log_of(command: BatchCommand, line: tuple[str, ...], out: Path) -> Path:
    """Return the output file of a line."""
    return _job((command, *line), out).log


def _job(words: tuple[str, ...], out: Path) -> _Job:
    """Return the job of a line, with a file name from its first log and a hash of all its words.

    The name does not depend on the line's position: lists may be reordered, and extended.
    """
    # Short, since it only separates lines with the same first log.
    digest = hashlib.sha256("\0".join(words).encode()).hexdigest()[:8]
    # `evaluate` and `train` have another word, the subject, before the log.
    is_second = words[0] in ("evaluate", "train") and len(words) > 2
    given = list(words[2:] if is_second else words[1:])
    paths = [word for word in given if "/" in word]
    named = Path(given[0] if not given[0].startswith("-") or not paths else paths[0]).name
    safe = "".join(c if c.isalnum() or c in "._-" else "_" for c in named)[:60]
    return _Job(words, out / f"{safe}-{digest}.log")


class _Running:
    """Running processes."""

    def __init__(self, at_a_time: int) -> None:
        # Without a limit each process would start threads for all cores. The user's value wins.
        own = max(1, core_count() // at_a_time)
        self._environment = {THREADS: str(own), **os.environ}
        self._lock = threading.Lock()
        self._alive: set[subprocess.Popen[bytes]] = set()
        self._is_stopped = False

    def run(self, job: _Job) -> int:
        """Run the job's command and return its exit code."""
        with job.log.open("wb") as log:
            with self._lock:
                if self._is_stopped:
                    # The shell's exit code of an interrupted command.
                    return 130
                process = subprocess.Popen(
                    [*_PROGRAM, *job.words],
                    stdout=log,
                    stderr=subprocess.STDOUT,
                    env=self._environment,
                )
                self._alive.add(process)
            code = process.wait()
        with self._lock:
            self._alive.discard(process)
        # Written last: a crash leaves the line unfinished.
        if code == 0:
            write_text(job.done, job.record)
        return code

    def stop(self) -> None:
        """Send SIGTERM, upon which a command ends cleanly."""
        with self._lock:
            self._is_stopped = True
            for process in self._alive:
                process.terminate()


def _last_line(log: Path) -> str:
    lines = log.read_text(errors="replace").strip().splitlines()
    return lines[-1][:300] if lines else "no output"
