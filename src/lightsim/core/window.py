"""A part of a picture."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool

Window = tuple[slice, slice]
"""Rows and columns."""


def window_around(mask: Bool[np.ndarray, "h w"], margin_px: int) -> Window:
    """The smallest window that holds the mask and a margin; the mask holds a pixel."""
    spans = []
    for axis, size in ((1, mask.shape[0]), (0, mask.shape[1])):
        found = np.flatnonzero(mask.any(axis=axis))
        low, high = int(found[0]) - margin_px, int(found[-1]) + 1 + margin_px
        spans.append(slice(max(0, low), min(size, high)))
    return spans[0], spans[1]
