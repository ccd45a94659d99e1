"""Batches of the baselines: the same frames, with what the camera makes of a dome's radiance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from lightsim.core.equirect import sample_bilinear
from lightsim.relighting.baselines.self_osr import WHITE
from lightsim.training.relight_cache import RelightSample, read_sample
from lightsim.training.relight_data import RelightData, RelightDataConfig

_MEMORY_FRAMES = 512
_BELOW = -0.05
"""Sine of the elevation: there the dome is smooth, and the sun is not."""


class BaselineData(RelightData):
    """`RelightData` whose samples have the plane `white_sky`, too."""

    def __init__(self, folders: Sequence[Path], config: RelightDataConfig) -> None:
        super().__init__(folders, config)
        self._read = lru_cache(_MEMORY_FRAMES)(_read)


def _read(path: Path) -> RelightSample:
    sample = read_sample(path)
    size = sample.scene["source"].shape[1:]
    white = np.broadcast_to(camera_gain(sample)[:, None, None], (3, *size))
    return replace(sample, scene={**sample.scene, WHITE: white.astype(np.float16)})


def camera_gain(sample: RelightSample) -> Float32[np.ndarray, "3"]:
    """What the camera makes of radiance 1; 1 where no surface below the horizon tells.

    A sample holds domes in scene units, and the target sky behind every pixel in units of the
    camera: their quotient is the gain. The median over skies, because what stands behind a picture
    may be brighter than what lights it.
    """
    position = np.moveaxis(sample.scene["position"].astype(np.float32), 0, -1)
    distance = np.linalg.norm(position, axis=-1)
    is_below = (sample.scene["surface"][0] > 0) & (position[..., 2] < _BELOW * distance)
    if not is_below.any():
        return np.ones(3, np.float32)
    right, forward, up = np.moveaxis(position[is_below] / distance[is_below, None], -1, 0)
    # The dome's centre column looks forward, and its columns grow to the right.
    directions = np.stack([forward, -right, up], axis=-1)
    gains = []
    for target in sample.targets.values():
        dome = np.moveaxis(target.planes["target_dome"].astype(np.float32), 0, -1)
        shown = np.moveaxis(target.planes["target_sky"].astype(np.float32), 0, -1)[is_below]
        seen = np.maximum(sample_bilinear(dome, directions), np.float32(1e-6))
        gains.append(np.median(shown / seen, axis=0))
    return np.median(gains, axis=0).astype(np.float32)
