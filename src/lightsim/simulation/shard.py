"""Parts of a job for several processes."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

from lightsim.errors import InputError

T = TypeVar("T")


@dataclass(frozen=True)
class Shard:
    """The `index`-th of `count` contiguous parts, counted from 1."""

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
        """I/N; empty for the whole."""
        if not text:
            return cls()
        found = re.fullmatch(r"\s*(\d{1,9})\s*/\s*(\d{1,9})\s*", text)
        if found is None:
            raise InputError(
                "the shard cannot be read",
                where=f"--shard {text}",
                expected="I/N with I from 1 to N, such as 3/8",
            )
        return cls(int(found.group(1)), int(found.group(2)))

    def of(self, items: Sequence[T]) -> tuple[T, ...]:
        """This part. The parts of all shards are disjoint, in order, and of even length."""
        first = (self.index - 1) * len(items) // self.count
        return tuple(items[first : self.index * len(items) // self.count])
