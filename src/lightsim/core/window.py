"""Rectangular parts of pictures."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool

Window = tuple[slice, slice]
"""Rows and columns."""


def window_around(mask: Bool[np.ndarray, "h w"], margin_px: int) -> Window:
    """Return the smallest window around a mask that is not empty, grown by a margin."""
    # Axis 1 is reduced to find the rows, axis 0 to find the columns.
    spans = []
    for axis, size in ((1, mask.shape[0]), (0, mask.shape[1])):
        found = np.flatnonzero(mask.any(axis=axis))
        low, high = int(found[0]) - margin_px, int(found[-1]) + 1 + margin_px
        spans.append(slice(max(0, low), min(size, high)))
    return spans[0], spans[1]
