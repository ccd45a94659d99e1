"""Cameras brought to one exposure and white balance where they see the same sky."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float, Float32

_PRIOR_FRACTION = 5e-4
"""An overlap of this fraction of the panorama alone is believed two thirds; slivers less."""
_DARKEST = 1e-3


def sky_factors(
    radiance: Sequence[Float32[np.ndarray, "h w 3"]], is_usable: Sequence[Bool[np.ndarray, "h w"]]
) -> Float[np.ndarray, "n 3"]:
    """RGB factors, one row per camera, that make the skies of overlapping cameras agree.

    Camera gains are solved on surfaces. Tone curves bend, so bright sky needs factors of its own:
    the least squares of the overlaps' median log ratios, weighted by area. The geometric mean of
    the factors is 1.

    Args:
        radiance: panorama of each camera alone, gains divided out.
        is_usable: where it saw unsaturated sky.
    """
    count = len(radiance)
    system = np.eye(count) * _PRIOR_FRACTION
    right = np.zeros((count, 3))
    for a, b in combinations(range(count), 2):
        both = is_usable[a] & is_usable[b]
        first, second = radiance[a][both], radiance[b][both]
        is_bright = (first > _DARKEST).all(axis=1) & (second > _DARKEST).all(axis=1)
        if not is_bright.any():
            continue
        fraction = float(is_bright.sum() / both.size)
        ratio = np.median(np.log(first[is_bright] / second[is_bright]), axis=0)
        system[[a, b], [a, b]] += fraction
        system[[a, b], [b, a]] -= fraction
        right[a] -= fraction * ratio
        right[b] += fraction * ratio
    return np.exp(np.linalg.solve(system, right))
