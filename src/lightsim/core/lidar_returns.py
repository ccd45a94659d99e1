"""LiDAR returns of several sweeps in one array."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32


@dataclass(frozen=True, eq=False)
class LidarReturns:
    """LiDAR returns from surfaces that do not move, in one frame.

    Args:
        points: ends of the beams, in metres.
        origins: positions of the sensor, in metres.
    """

    points: Float32[np.ndarray, "n 3"]
    origins: Float32[np.ndarray, "n 3"]
