"""The thread that computes the latest request."""

from __future__ import annotations

import logging
import threading
import time

import pytest

from lightsim.app.worker import LatestRequestWorker

WAIT_S = 10.0


class Gate:
    """Work that records its requests and waits in each until it may go on."""

    def __init__(self) -> None:
        self.done: list[int] = []
        self.is_started, self.is_open = threading.Event(), threading.Event()

    def __call__(self, request: int) -> None:
        self.is_started.set()
        assert self.is_open.wait(WAIT_S)
        self.done.append(request)


def test_requests_between_the_running_and_the_latest_one_are_dropped() -> None:
    gate = Gate()
    worker = LatestRequestWorker(gate, name="test")
    worker.post(1)
    assert gate.is_started.wait(WAIT_S)
    for request in (2, 3, 4):
        worker.post(request)
    assert not worker.wait(0.05)
    gate.is_open.set()
    assert worker.wait(WAIT_S)
    worker.close()
    assert gate.done == [1, 4]


def test_work_starts_after_a_pause_of_the_requests() -> None:
    gate = Gate()
    gate.is_open.set()
    delay_s = 0.3
    worker = LatestRequestWorker(gate, name="test", delay_s=delay_s)
    for request in range(4):
        worker.post(request)
        time.sleep(0.02)
    last_s = time.monotonic()
    worker.post(4)
    assert gate.is_started.wait(WAIT_S)
    assert time.monotonic() - last_s >= delay_s
    assert worker.wait(WAIT_S)
    worker.close()
    assert gate.done == [4]


def test_an_error_is_logged_and_the_next_request_is_computed(
    caplog: pytest.LogCaptureFixture,
) -> None:
    done: list[int] = []

    def work(request: int) -> None:
        if request == 0:
            raise ZeroDivisionError("of the test")
        done.append(request)

    worker = LatestRequestWorker(work, name="test")
    with caplog.at_level(logging.ERROR):
        worker.post(0)
        assert worker.wait(WAIT_S)
    assert "ZeroDivisionError: of the test" in caplog.text
    worker.post(1)
    assert worker.wait(WAIT_S)
    worker.close()
    assert done == [1]


def test_closing_waits_for_the_running_request_and_starts_no_other() -> None:
    gate = Gate()
    worker = LatestRequestWorker(gate, name="test")
    worker.post(1)
    assert gate.is_started.wait(WAIT_S)
    worker.post(2)
    threading.Timer(0.1, gate.is_open.set).start()
    worker.close()
    assert gate.done == [1]
