"""Batches made by threads ahead of their use."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Generic, TypeVar

T = TypeVar("T")


class Ahead(Generic[T]):
    """What `make` gives for numbers that are asked for in steps of `stride`, made by threads.

    Args:
        make: safe to call from several threads.
        workers: threads, each with one item ahead; 0 makes an item when it is asked for.
        stride: from one number to the next of its kind.
        stop: no number is as large.
    """

    def __init__(self, make: Callable[[int], T], workers: int, stride: int, stop: int) -> None:
        self._make = make
        self._pool = ThreadPoolExecutor(workers) if workers else None
        self._stride, self._stop = stride, stop
        self._reach = stride * (workers + 1)
        self._coming: dict[int, Future[T]] = {}

    def get(self, number: int) -> T:
        """The item of a number; each may be asked for once, its followers are then begun."""
        if self._pool is None:
            return self._make(number)
        for later in range(number, min(number + self._reach, self._stop), self._stride):
            if later not in self._coming:
                self._coming[later] = self._pool.submit(self._make, later)
        return self._coming.pop(number).result()

    def __enter__(self) -> Ahead[T]:
        return self

    def __exit__(self, *error: object) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)
