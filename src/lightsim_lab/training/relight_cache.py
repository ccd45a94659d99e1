"""Sample files of the relighting networks: one file per frame, one folder per street."""

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
# Values are clipped to this magnitude: half precision ends at 65504, and the suns of sky domes are
# brighter.
_LARGEST = np.float32(6e4)


@dataclass(frozen=True, eq=False)
class RelightTargetSample:
    """A frame under one target sky.

    Args:
        planes: planes of the light and of the physical estimate (`channels.target_planes`).
        truth: true picture under this sky, 8-bit sRGB; None if it is unknown.
    """

    planes: Planes
    truth: UInt8[np.ndarray, "3 h w"] | None


@dataclass(frozen=True, eq=False)
class RelightSample:
    """A recorded frame, with its light and true pictures under target skies.

    Args:
        scene: planes of the frame (`channels.scene_planes`), and `valid`: 1 where a pixel counts.
        targets: planes and truth by name of the sky.
    """

    scene: Planes
    targets: Mapping[str, RelightTargetSample]


def write_sample(path: Path, sample: RelightSample) -> None:
    """Write a sample as one .npz file in half precision."""
    # Not compressed, so that training can map the file and read only the crops it needs.
    arrays: dict[str, np.ndarray] = {f"scene/{k}": _half(v) for k, v in sample.scene.items()}
    for sky, target in sample.targets.items():
        arrays |= {f"{sky}/{k}": _half(v) for k, v in target.planes.items()}
        if target.truth is not None:
            arrays[f"{sky}/truth"] = target.truth
    with whole_file(path) as temporary, temporary.open("wb") as handle:
        np.savez(handle, allow_pickle=False, **arrays)


def read_sample(path: Path) -> RelightSample:
    """Return a sample of `write_sample` as memory-mapped arrays in half precision.

    Raises:
        InputError: the file is missing or damaged.
    """
    arrays = load_arrays(path, is_mapped=True)
    # Names are "scene/PLANE" or "SKY/PLANE".
    groups: dict[str, dict[str, np.ndarray]] = {}
    for name, value in arrays.items():
        group, _, plane = name.partition("/")
        groups.setdefault(group, {})[plane] = value
    scene = groups.pop("scene", None)
    if scene is None or not groups or "source" not in scene:
        raise InputError("the file is not a relighting sample", where=path, remedy=_REMEDY)
    targets = {
        sky: RelightTargetSample({k: v for k, v in own.items() if k != "truth"}, own.get("truth"))
        for sky, own in groups.items()
    }
    return RelightSample(scene, targets)


def _half(values: np.ndarray) -> np.ndarray:
    return np.clip(values, -_LARGEST, _LARGEST).astype(np.float16)
