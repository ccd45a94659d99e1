"""The bounded memory of results."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor
from itertools import count

import pytest

from lightsim.app.recent_results import RecentResults


def test_the_result_that_was_used_longest_ago_is_forgotten() -> None:
    kept, made = RecentResults[int](2), count()
    first = {key: kept.get(key, lambda: next(made)) for key in "ab"}
    assert kept.get("a", lambda: next(made)) == first["a"]
    kept.get("c", lambda: next(made))
    assert kept.get("a", lambda: next(made)) == first["a"]
    assert kept.get("b", lambda: next(made)) == 3  # made anew


def test_threads_that_ask_for_one_key_make_it_once() -> None:
    kept, made = RecentResults[int](2), count()
    asked = threading.Barrier(4)

    def ask(_: int) -> int:
        asked.wait(10.0)
        return kept.get("key", lambda: next(made))

    with ThreadPoolExecutor(4) as pool:
        assert set(pool.map(ask, range(4))) == {0}
    assert next(made) == 1


def test_a_slow_result_does_not_delay_others() -> None:
    kept = RecentResults[str](2)
    is_making, is_other_made = threading.Event(), threading.Event()

    def slow() -> str:
        is_making.set()
        assert is_other_made.wait(10.0)
        return "slow"

    with ThreadPoolExecutor(1) as pool:
        future = pool.submit(kept.get, "slow", slow)
        assert is_making.wait(10.0)
        assert kept.get("other", lambda: "other") == "other"
        is_other_made.set()
        assert future.result(10.0) == "slow"


def test_a_failure_is_not_kept() -> None:
    kept = RecentResults[int](1)
    with pytest.raises(ZeroDivisionError):
        kept.get("key", lambda: 1 // 0)
    assert kept.get("key", lambda: 1) == 1


def test_a_dropped_result_is_made_anew() -> None:
    kept, made = RecentResults[int](1), count()
    kept.get("key", lambda: next(made))
    kept.drop("key")
    kept.drop("unknown")
    assert kept.get("key", lambda: next(made)) == 1
