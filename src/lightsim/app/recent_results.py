"""Bounded cache of results that are expensive to make."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

Made = TypeVar("Made")


class RecentResults(Generic[Made]):
    """Thread-safe cache of the most recently used results; each result is computed once.

    Args:
        count: number of results, at least 1.
    """

    def __init__(self, count: int) -> None:
        self._count = count
        self._made: OrderedDict[Hashable, Made] = OrderedDict()
        self._lock = threading.Lock()
        self._making: dict[Hashable, threading.Lock] = {}

    def get(self, key: Hashable, make: Callable[[], Made]) -> Made:
        """Return the result of a key; compute it if it is not cached."""
        with self._lock:
            if key in self._made:
                self._made.move_to_end(key)
                return self._made[key]
            making = self._making.setdefault(key, threading.Lock())
        with making:
            with self._lock:
                if key in self._made:
                    return self._made[key]
            made = make()
            with self._lock:
                self._made[key] = made
                self._making.pop(key, None)
                while len(self._made) > self._count:
                    self._made.popitem(last=False)
            return made

    def drop(self, key: Hashable) -> None:
        """Remove a result."""
        with self._lock:
            self._made.pop(key, None)
