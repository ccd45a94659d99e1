"""Per-camera factors that match exposure and white balance of the sky where cameras overlap."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float, Float32

# Weight of the prior (factor 1), as a fraction of the panorama's area: an overlap of this area
# corrects two thirds of the difference between two cameras, slivers less. Sensitivity not measured.
_PRIOR_FRACTION = 5e-4
# Radiance below which a pixel is not compared, because its ratio is mostly noise.
_DARKEST = 1e-3


def sky_factors(
    radiance: Sequence[Float32[np.ndarray, "h w 3"]], is_usable: Sequence[Bool[np.ndarray, "h w"]]
) -> Float[np.ndarray, "n 3"]:
    """Return RGB factors, one row per camera, that match the skies of overlapping cameras.

    Camera gains are estimated on surfaces. Camera responses are not linear near white, so bright
    sky requires separate factors: the least-squares solution of the overlaps' median log ratios,
    weighted by area. The geometric mean of the factors is 1.

    Args:
        radiance: panorama of each single camera, gains divided out.
        is_usable: true where the camera observed unsaturated sky.
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
        # Normal equations of log factor a - log factor b = -ratio, weighted by area.
        system[[a, b], [a, b]] += fraction
        system[[a, b], [b, a]] -= fraction
        right[a] -= fraction * ratio
        right[b] += fraction * ratio
    return np.exp(np.linalg.solve(system, right))
