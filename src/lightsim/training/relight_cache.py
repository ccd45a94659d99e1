"""Frames that relighting networks learn from: one file each, a folder of them for every street."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8

from lightsim.core.colour import LUMINANCE_WEIGHTS, linear_from_srgb
from lightsim.errors import InputError
from lightsim.relighting.network.channels import Planes
from lightsim.store.arrays import load_arrays
from lightsim.store.atomic import whole_file

_REMEDY = "Make the data again with lightsim train prepare relight."
_LARGEST = np.float32(6e4)
"""Below the largest number of half precision: suns in domes are brighter."""


@dataclass(frozen=True, eq=False)
class RelightTargetSample:
    """A frame under one target sky.

    Args:
        planes: of the light and of the physical estimate (`channels.target_planes`).
        truth: what the camera would have recorded, sRGB; None where nobody knows.
    """

    planes: Planes
    truth: UInt8[np.ndarray, "3 h w"] | None

    @cached_property
    def level(self) -> float:
        """Mean of the physical estimate over surfaces (`features.level`)."""
        is_surface = np.asarray(self.planes["target_shaded"].any(axis=0))
        return _mean_over(is_surface, self.planes["target_physical"])


@dataclass(frozen=True, eq=False)
class RelightSample:
    """A recorded frame and what it should look like under other skies.

    Args:
        scene: planes of the frame (`channels.scene_planes`), and `valid`: 1 where it counts.
        targets: by name of the sky.
    """

    scene: Planes
    targets: Mapping[str, RelightTargetSample]

    @cached_property
    def level(self) -> float:
        """The same of the recorded picture."""
        source = linear_from_srgb(self.scene["source"].astype(np.float32))
        return _mean_over(self.scene["surface"][0] > 0, source)


def write_sample(path: Path, sample: RelightSample) -> None:
    """One .npz file in half precision, not compressed: training reads it many times."""
    arrays: dict[str, np.ndarray] = {f"scene/{k}": _half(v) for k, v in sample.scene.items()}
    for sky, target in sample.targets.items():
        arrays |= {f"{sky}/{k}": _half(v) for k, v in target.planes.items()}
        if target.truth is not None:
            arrays[f"{sky}/truth"] = target.truth
    with whole_file(path) as temporary, temporary.open("wb") as handle:
        np.savez(handle, allow_pickle=False, **arrays)


def read_sample(path: Path) -> RelightSample:
    """A sample that `write_sample` wrote, in half precision; what is not looked at is not read.

    Raises:
        InputError: it is missing or damaged.
    """
    arrays = load_arrays(path, is_mapped=True)
    groups: dict[str, dict[str, np.ndarray]] = {}
    for name, value in arrays.items():
        group, _, plane = name.partition("/")
        groups.setdefault(group, {})[plane] = value
    scene = groups.pop("scene", None)
    if scene is None or not groups or "source" not in scene:
        raise InputError("this is no sample of relighting", where=path, remedy=_REMEDY)
    targets = {
        sky: RelightTargetSample({k: v for k, v in own.items() if k != "truth"}, own.get("truth"))
        for sky, own in groups.items()
    }
    return RelightSample(scene, targets)


def _mean_over(chosen: Bool[np.ndarray, "h w"], picture: Float[np.ndarray, "3 h w"]) -> float:
    """Mean luminance; 0 of nothing."""
    if not chosen.any():
        return 0.0
    return float(LUMINANCE_WEIGHTS @ picture[:, chosen].mean(axis=1, dtype=np.float64))


def _half(values: np.ndarray) -> np.ndarray:
    return np.clip(values, -_LARGEST, _LARGEST).astype(np.float16)
