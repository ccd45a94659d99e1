"""Output of a relighting method: the relit frame and, optionally, its expected error."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from lightsim.relighting.physical.ratio import RatioConfig, RelightInputs


@dataclass(frozen=True, eq=False)
class Estimate:
    """A frame under the target sky.

    Args:
        radiance: scene units, linear, before camera gain.
        expected_error: expected mean absolute error of the picture's sRGB code, in [0, 1]; None if
            the method does not estimate it.
    """

    radiance: Float32[np.ndarray, "h w 3"]
    expected_error: Float32[np.ndarray, "h w"] | None = None


Relight = Callable[[RelightInputs, RatioConfig], Estimate]
"""Function (inputs of a frame, settings) that returns the frame under the target sky."""
