"""Contiguous parts of a list of items, one per process."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

from lightsim.errors import InputError

T = TypeVar("T")


@dataclass(frozen=True)
class Shard:
    """One of `count` contiguous parts; `index` starts at 1."""

    index: int = 1
    count: int = 1

    def __post_init__(self) -> None:
        if not 1 <= self.index <= self.count:
            raise InputError(
                "there is no such shard",
                where=f"--shard {self.index}/{self.count}",
                expected="I/N with I from 1 to N",
            )

    @classmethod
    def parse(cls, text: str) -> Shard:
        """Parse I/N; empty text gives the whole.

        Raises:
            InputError: the text is malformed, or I is not in 1..N.
        """
        if not text:
            return cls()
        # Nine digits bound the numbers: longer ones cannot be meant.
        found = re.fullmatch(r"\s*(\d{1,9})\s*/\s*(\d{1,9})\s*", text)
        if found is None:
            raise InputError(
                "the shard cannot be read",
                where=f"--shard {text}",
                expected="I/N with I from 1 to N, such as 3/8",
            )
        return cls(int(found.group(1)), int(found.group(2)))

    def of(self, items: Sequence[T]) -> tuple[T, ...]:
        """Return this part. The parts of all shards are disjoint, in order, and differ in length by
        at most one."""
        # Integer arithmetic: the union of all parts is complete without rounding.
        first = (self.index - 1) * len(items) // self.count
        return tuple(items[first : self.index * len(items) // self.count])
