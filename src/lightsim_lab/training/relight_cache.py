"""Frames that relighting networks learn from: one file each, a folder of them for every street."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

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


@dataclass(frozen=True, eq=False)
class RelightSample:
    """A recorded frame and what it should look like under other skies.

    Args:
        scene: planes of the frame (`channels.scene_planes`), and `valid`: 1 where it counts.
        targets: by name of the sky.
    """

    scene: Planes
    targets: Mapping[str, RelightTargetSample]


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


def _half(values: np.ndarray) -> np.ndarray:
    return np.clip(values, -_LARGEST, _LARGEST).astype(np.float16)
