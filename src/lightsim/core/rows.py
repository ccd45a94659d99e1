"""Base of dataclasses whose fields are arrays of one length, such as beams or surface points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import TypeVar

import numpy as np
from jaxtyping import Shaped

RowsT = TypeVar("RowsT", bound="Rows")


@dataclass(frozen=True, eq=False)
class Rows:
    """Arrays of one length, which subclasses declare as fields."""

    def chosen(self: RowsT, rows: Shaped[np.ndarray, " _"] | slice) -> RowsT:
        """Return some rows, by a mask, a slice or their numbers."""
        return type(self)(*(getattr(self, f.name)[rows] for f in fields(self)))

    def fill(self, rows: Shaped[np.ndarray, " _"], other: Rows) -> None:
        """Copy all rows of `other`, an object of the same class, to the rows `rows`, in place."""
        for field in fields(self):
            getattr(self, field.name)[rows] = getattr(other, field.name)

    @classmethod
    def joined(cls: type[RowsT], parts: Sequence[RowsT]) -> RowsT:
        """Concatenate one or more groups of rows."""
        return cls(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(cls)))
