"""One case in one forked child with limits; what became of it as an `Outcome`.

The parent has imported all that the readers need, so a child costs milliseconds. A child that hangs
(also in a system call, such as opening a FIFO) is killed by the parent's clock.
"""

from __future__ import annotations

import faulthandler
import gc
import json
import os
import resource
import select
import shutil
import signal
import sys
import time
import traceback
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from lightsim.errors import LightSimError

Result = Literal[
    "accepted", "refused", "foreign", "message", "hang", "memory", "crash", "escape", "harness"
]
FAILURES: tuple[Result, ...] = (
    "foreign", "message", "hang", "memory", "crash", "escape", "harness",
)  # fmt: skip
CANARY_NAME = "code_ran"
_PACKAGE = "/lightsim/"
_MAX_MESSAGE = 2000
"""An error is one line; this is 20 lines of a terminal."""


@dataclass(frozen=True)
class Limits:
    """What a case may use."""

    memory_mb: int = 1500
    """Peak resident memory of the whole process, interpreter and libraries included."""
    processor_s: int = 10
    """The largest honest case takes a second."""
    wall_s: float = 20.0
    """Twice the processor time: other work may share the machine."""
    address_mb: int = 3000
    """Address space beyond the parent's; protects the machine from a case that would fill it."""


@dataclass(frozen=True)
class Outcome:
    """What became of a case.

    Args:
        result: "accepted", "refused" (our error), or one of `FAILURES`: another exception or a
            warning, an error of several lines, no end, too much memory, death by a signal, code run
            or a file outside the case's folder, an exception of the fuzzer itself.
        detail: the error's text.
        place: file:line inside the package where it was raised.
        damage: what was done to the file.
        peak_mb: largest resident memory.
        processor_s: of reading, making the case included.
    """

    result: Result
    detail: str
    place: str
    damage: str
    peak_mb: float
    processor_s: float


def run_case(
    root: Path,
    make: Callable[[Path], str],
    read: Callable[[Path], None],
    limits: Limits,
) -> Outcome:
    """Make a case in a fresh folder below `root` and read it, in a child.

    Args:
        make: fills the folder, says what it damaged.
        read: may raise a LightSimError and nothing else.
    """
    folder = root / "case"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    before = _names(root)
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(reader)
        _child(folder, writer, make, read, limits)
    os.close(writer)
    text, is_late = _listen(reader, limits.wall_s)
    os.close(reader)
    if is_late:
        os.kill(child, signal.SIGKILL)
    _, status, usage = os.wait4(child, 0)
    outcome = _judge(text, is_late, status, usage, limits)
    escaped = _names(root) - before
    if escaped or (folder / CANARY_NAME).exists():
        for name in escaped:
            _remove(root / name)
        detail = f"written outside: {sorted(escaped)}" if escaped else "the canary was touched"
        return Outcome("escape", detail, "", outcome.damage, outcome.peak_mb, outcome.processor_s)
    return outcome


def _names(root: Path) -> set[str]:
    return {entry.name for entry in os.scandir(root)}


def _remove(path: Path) -> None:
    shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()


def _child(
    folder: Path,
    writer: int,
    make: Callable[[Path], str],
    read: Callable[[Path], None],
    limits: Limits,
) -> None:
    """Never returns. The first line to the parent is the damage, the second the outcome."""
    gc.disable()
    faulthandler.disable()
    nowhere = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):
        os.dup2(nowhere, stream)
    message: dict[str, Any]
    try:
        damage = make(folder)
        os.write(writer, (json.dumps(damage[:300]) + "\n").encode())
        os.chdir(folder)
        _set_limits(limits)
        message = _read_outcome(folder, read)
    except BaseException as error:  # noqa: BLE001 - a fault of the fuzzer must be told too.
        os.write(writer, b'"?"\n')
        message = _message("harness", error)
    os.write(writer, (json.dumps(message) + "\n").encode())
    os._exit(0)


def _set_limits(limits: Limits) -> None:
    used_s = sum(os.times()[:2])
    limit_s = int(used_s) + 1 + limits.processor_s
    resource.setrlimit(resource.RLIMIT_CPU, (limit_s, limit_s))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    size = pages * resource.getpagesize() + (limits.address_mb << 20)
    resource.setrlimit(resource.RLIMIT_AS, (size, size))


def _read_outcome(folder: Path, read: Callable[[Path], None]) -> dict[str, Any]:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            read(folder)
    except LightSimError as error:
        if _has_memory_error(error):
            return _message("memory", error)
        text = str(error)
        is_one_line = len(text.splitlines()) == 1 and len(text) <= _MAX_MESSAGE
        return _message("refused" if is_one_line else "message", error)
    except MemoryError as error:
        return _message("memory", error)
    except BaseException as error:  # noqa: BLE001 - whatever comes is the finding.
        return _message("foreign", error)
    return {"result": "accepted", "detail": "", "place": ""}


def _has_memory_error(error: BaseException | None) -> bool:
    """Whether a reader tried to allocate what a file claimed, and was only saved by the limit."""
    while error is not None:
        if isinstance(error, MemoryError):
            return True
        error = error.__cause__ or error.__context__
    return False


def _message(result: Result, error: BaseException) -> dict[str, Any]:
    frames = traceback.extract_tb(error.__traceback__)
    ours = [f for f in frames if _PACKAGE in f.filename] or list(frames)
    place = f"{ours[-1].filename.rpartition(_PACKAGE)[2]}:{ours[-1].lineno}" if ours else ""
    return {
        "result": result,
        "detail": f"{type(error).__name__}: {error}"[:300],
        "place": place,
    }


def _listen(reader: int, wall_s: float) -> tuple[str, bool]:
    """All that the child says, and whether it was still alive when its time was over."""
    parts: list[bytes] = []
    end = time.monotonic() + wall_s
    while (left := end - time.monotonic()) > 0:
        if not select.select([reader], [], [], left)[0]:
            break
        part = os.read(reader, 1 << 16)
        if not part:
            return b"".join(parts).decode(), False
        parts.append(part)
    return b"".join(parts).decode(), True


def _judge(
    text: str, is_late: bool, status: int, usage: resource.struct_rusage, limits: Limits
) -> Outcome:
    lines = [json.loads(line) for line in text.splitlines()]
    damage = str(lines[0]) if lines else "?"
    peak_mb, processor_s = usage.ru_maxrss / 1024, usage.ru_utime + usage.ru_stime
    found: dict[str, Any] = lines[1] if len(lines) > 1 else {}
    if not found:
        number = os.WTERMSIG(status) if os.WIFSIGNALED(status) else 0
        # The kernel answers a passed RLIMIT_CPU with one of these two.
        is_slow = is_late or number in (signal.SIGXCPU, signal.SIGKILL)
        detail = "no end" if is_slow else f"signal {number}, status {status}"
        found = {"result": "hang" if is_slow else "crash", "detail": detail, "place": ""}
    result: Result = found["result"]
    if result in ("accepted", "refused") and peak_mb > limits.memory_mb:
        result = "memory"
    return Outcome(result, found["detail"], found["place"], damage, peak_mb, processor_s)


def import_what_was_needed(read: Callable[[], None]) -> None:
    """Import in this process whatever modules `read` imports in a child; so the children that
    follow import nothing, and this process starts no thread."""
    reader, writer = os.pipe()
    before = set(sys.modules)
    child = os.fork()
    if child == 0:
        os.close(reader)
        try:
            read()
        except BaseException:  # noqa: BLE001 - the child must not run the parent's code.
            traceback.print_exc()
            os._exit(1)
        names = [name for name in sys.modules if name not in before]
        os.write(writer, "\n".join(names).encode())
        os._exit(0)
    os.close(writer)
    text, _ = _listen(reader, 600.0)
    os.close(reader)
    if os.waitpid(child, 0)[1]:
        raise RuntimeError("honest files are not accepted; see above")
    for name in text.split("\n")[:-1]:
        try:
            __import__(name)
        except ImportError:  # a module that another one made up, such as six.moves
            continue
    gc.collect()
    gc.freeze()
