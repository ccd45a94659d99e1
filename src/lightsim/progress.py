"""Progress reports of long loops: a bar on a terminal, plain lines elsewhere, none in tests."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Iterator
from typing import Protocol, TypeVar, runtime_checkable

T = TypeVar("T")


@runtime_checkable
class Progress(Protocol):
    """Reporter of a stage's progress; a stage iterates over `track(items, ...)`."""

    def track(self, items: Iterable[T], description: str, total: int | None = None) -> Iterator[T]:
        """Yield the items and report; `total` is the number of items that have no length."""
        ...


class SilentProgress:
    """Reporter without output, for use as a library and in tests."""

    def track(self, items: Iterable[T], description: str, total: int | None = None) -> Iterator[T]:
        """Yield the items."""
        yield from items


class LineProgress:
    """Reporter that prints at most one line every `every_s` seconds, and one at the end."""

    def __init__(self, every_s: float = 10.0) -> None:
        self._every_s = every_s

    def track(self, items: Iterable[T], description: str, total: int | None = None) -> Iterator[T]:
        """Yield the items; each line has the number of items and the seconds since the start."""
        total = _length(items) if total is None else total
        start = last = time.monotonic()
        done = printed = 0
        for item in items:
            yield item
            done += 1
            now = time.monotonic()
            if now - last >= self._every_s:
                last, printed = now, done
                self._line(description, done, total, now - start)
        # The last item may have been printed already.
        if done > printed or (not done and total != 0):
            self._line(description, done, total, time.monotonic() - start)

    @staticmethod
    def _line(description: str, done: int, total: int | None, seconds: float) -> None:
        of = f"/{total}" if total is not None else ""
        left = (
            f", {seconds / done * (total - done):.0f} s left" if total and 0 < done < total else ""
        )
        sys.stderr.write(f"  {description}: {done}{of}, {seconds:.1f} s{left}\n")
        sys.stderr.flush()


class BarProgress:
    """Reporter with a progress bar (rich) and the estimated time left."""

    def track(self, items: Iterable[T], description: str, total: int | None = None) -> Iterator[T]:
        """Yield the items under a bar on standard error."""
        from rich.console import Console
        from rich.progress import track

        total = _length(items) if total is None else total
        if total == 0:
            return  # An empty bar would look like work that does not start.
        yield from track(
            items,
            description=f"  {description}",
            total=total,
            console=Console(stderr=True),
        )


def terminal_progress() -> Progress:
    """Return the reporter for standard error: a bar on a terminal, lines elsewhere."""
    return BarProgress() if sys.stderr.isatty() else LineProgress()


def _length(items: object) -> int | None:
    return len(items) if hasattr(items, "__len__") else None  # type: ignore[arg-type]
