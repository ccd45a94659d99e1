"""Results that threads compute ahead."""

from __future__ import annotations

import threading
import time
from itertools import islice

import pytest

from lightsim.core.ahead import mapped_ahead


def test_results_are_in_order_and_few_are_computed_ahead() -> None:
    begun: list[int] = []

    def slow_first(item: int) -> int:
        begun.append(item)
        time.sleep(0.02 if item == 0 else 0.0)
        return item**2

    made = mapped_ahead(slow_first, range(50), 3)
    assert list(islice(made, 2)) == [0, 1]
    time.sleep(0.05)
    # Two results were taken; workers + 1 may have been computed for the second.
    assert max(begun) <= 4
    assert list(made) == [k**2 for k in range(2, 50)]


def test_an_error_comes_with_its_item_and_later_items_are_not_begun() -> None:
    begun: list[int] = []
    is_free = threading.Event()

    def broken(item: int) -> int:
        begun.append(item)
        if item == 1:
            raise ValueError("item 1")
        is_free.wait(0.05)
        return item

    made = mapped_ahead(broken, range(50), 1)
    assert next(made) == 0
    with pytest.raises(ValueError, match="item 1"):
        list(made)
    assert max(begun) <= 3
