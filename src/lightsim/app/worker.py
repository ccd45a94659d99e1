"""A thread that computes the latest request and drops the ones before it."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from typing import Generic, TypeVar

Request = TypeVar("Request")
_LOGGER = logging.getLogger(__name__)


class LatestRequestWorker(Generic[Request]):
    """Calls `work` with the latest request, in one thread.

    A request that arrives before an older one has started replaces it, so that requests do not
    queue up.

    Args:
        work: called with a request; its errors are logged and do not stop the thread.
        delay_s: time for which a request must remain the latest before it starts.
    """

    def __init__(self, work: Callable[[Request], None], *, name: str, delay_s: float = 0.0) -> None:
        self._work = work
        self._delay_s = delay_s
        self._waiting: Request | None = None
        self._due_s = 0.0
        self._is_busy = False
        self._is_closed = False
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def post(self, request: Request) -> None:
        """Set the latest request; returns at once."""
        with self._changed:
            self._waiting = request
            self._due_s = time.monotonic() + self._delay_s
            self._changed.notify_all()

    def wait(self, timeout_s: float) -> bool:
        """Return True once no request is waiting or running, False after the timeout."""
        with self._changed:
            return self._changed.wait_for(
                lambda: self._waiting is None and not self._is_busy, timeout_s
            )

    def stop(self) -> None:
        """Start no further request; returns at once."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()

    def close(self) -> None:
        """Stop, and wait for the running request."""
        self.stop()
        self._thread.join()

    def _run(self) -> None:
        while True:
            request = self._next()
            if request is None:
                return
            try:
                self._work(request)
            except Exception:
                _LOGGER.exception("the viewer could not make a picture")
            with self._changed:
                self._is_busy = False
                self._changed.notify_all()

    def _next(self) -> Request | None:
        """Wait for a request that is due; None after `close`."""
        with self._changed:
            while not self._is_closed:
                left_s = self._due_s - time.monotonic()
                if self._waiting is not None and left_s <= 0:
                    request, self._waiting, self._is_busy = self._waiting, None, True
                    return request
                self._changed.wait(left_s if self._waiting is not None else None)
            return None
