"""Run-length encoding of masks in COCO's format (cocoapi, common/maskApi.c)."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Bool


def encode_mask(mask: Bool[np.ndarray, "h w"]) -> dict[str, Any]:
    """Return a mask as COCO's compressed run-length encoding."""
    runs = run_lengths(mask)
    return {"size": list(mask.shape), "counts": "".join(map(_text, _differences(runs)))}


def run_lengths(mask: Bool[np.ndarray, "h w"]) -> list[int]:
    """Return the lengths of runs of 0 and 1 in turn, column by column; the first is of 0."""
    pixels = np.concatenate([[False], mask.T.reshape(-1)])
    ends = np.flatnonzero(pixels[1:] != pixels[:-1])
    return np.diff(np.concatenate([[0], ends, [mask.size]])).tolist()


def _differences(runs: list[int]) -> list[int]:
    """Return the runs; from the fourth on, the difference to the run two before, which is small."""
    return [run - runs[i - 2] if i > 2 else run for i, run in enumerate(runs)]


def _text(number: int) -> str:
    """Return a number in characters of 5 bits, lowest first; bit 6 is set if more follow."""
    text = ""
    while True:
        bits, number = number & 0x1F, number >> 5
        # The highest of the 5 bits is the sign of the rest.
        is_last = number == (-1 if bits & 0x10 else 0)
        text += chr(48 + (bits if is_last else bits | 0x20))
        if is_last:
            return text
