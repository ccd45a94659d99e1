"""Radiometric closure: ratio of predicted radiance (base colour times light) to observed
radiance."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass

import numpy as np
from jaxtyping import Bool, Float

from lightsim.build.quality.frame_report import FramesReport
from lightsim.core.colour import LUMINANCE_WEIGHTS
from lightsim.errors import InputError
from lightsim_lab.metrics.base_colour import (
    FACADE_BELOW,
    GROUND_ABOVE,
    LIT_ABOVE,
    SHADOW_BELOW,
)

# Smallest observed radiance of a sample, in scene units: one step of an 8-bit picture. Ratios of
# smaller values are dominated by quantisation.
_DARKEST = 0.004


@dataclass(frozen=True)
class ClosureRow:
    """Ratio of predicted to observed radiance on one class of surface; 1 is ideal.

    Args:
        surface: name of the class.
        count: number of samples.
        median, percentile_10, percentile_90: statistics of the ratio of luminances.
        median_rgb: median ratio of each channel.
    """

    surface: str
    count: int
    median: float
    percentile_10: float
    percentile_90: float
    median_rgb: tuple[float, float, float]


@dataclass(frozen=True)
class ClosureReport:
    """Rows of the classes that have samples, in the given order.

    Args:
        frames: scores of held-out frames under the source sky; None without held-out frames.
    """

    rows: tuple[ClosureRow, ...]
    frames: FramesReport | None = None

    def to_table(self) -> str:
        """Return the report as Markdown."""
        lines = [
            "| predicted / observed | samples | median | 10 % | 90 % | R | G | B |",
            "|---|---:|---:|---:|---:|---:|---:|---:|",
        ]
        for row in self.rows:
            values = (row.median, row.percentile_10, row.percentile_90, *row.median_rgb)
            cells = " | ".join(f"{value:.3f}" for value in values)
            lines.append(f"| {row.surface} | {row.count} | {cells} |")
        if self.frames is not None:
            lines += ["", self.frames.to_table()]
        return "\n".join(lines)

    def to_json(self) -> str:
        """Return all figures as JSON."""
        frames = None if self.frames is None else json.loads(self.frames.to_json())
        rows = [asdict(row) for row in self.rows]
        return json.dumps({"rows": rows, "frames": frames}, indent=2)


def measure_closure(
    predicted: Float[np.ndarray, "n 3"],
    radiance: Float[np.ndarray, "n 3"],
    is_member_by_surface: Mapping[str, Bool[np.ndarray, " n"]],
) -> ClosureReport:
    """Compute the ratio of predicted to observed radiance by class.

    The ratio is 1 where geometry, sky, exposure and base colour of a twin agree with its pictures.

    Args:
        predicted: base colour times irradiance / pi plus reflections of n surface samples, scene
            units, linear RGB.
        radiance: observed radiance of the samples, scene units: linear pixel value over camera
            gain. The caller must exclude clipped pixels.
        is_member_by_surface: mask of the samples of each class; classes may overlap.

    Raises:
        InputError: no sample is bright enough to be compared.
    """
    predicted, seen = (x.astype(np.float64) for x in (predicted, radiance))
    weights = np.asarray(LUMINANCE_WEIGHTS, np.float64)
    columns = [np.column_stack([x @ weights, x]) for x in (predicted, seen)]
    # Column 0 is luminance, columns 1 to 3 are the channels.
    is_usable = (columns[1] > _DARKEST).all(axis=1) & np.isfinite(columns[0]).all(axis=1)
    rows = []
    for surface, is_member in is_member_by_surface.items():
        chosen = is_member & is_usable
        if chosen.any():
            ratio = columns[0][chosen] / columns[1][chosen]
            low, middle, high = np.percentile(ratio[:, 0], [10, 50, 90]).tolist()
            red, green, blue = np.median(ratio[:, 1:], axis=0).tolist()
            count = int(chosen.sum())
            rows.append(ClosureRow(surface, count, middle, low, high, (red, green, blue)))
    if not rows:
        raise InputError(
            "no surface sample can be compared",
            got=f"{len(radiance)} samples of {', '.join(is_member_by_surface)}",
            expected=f"one or more of radiance above {_DARKEST} in all channels",
        )
    return ClosureReport(tuple(rows))


def surface_classes(
    normal_world: Float[np.ndarray, "n 3"],
    sun_visibility: Float[np.ndarray, " n"],
) -> dict[str, Bool[np.ndarray, " n"]]:
    """Return masks of the classes "all", and lit and shadowed ground and facades.

    Args:
        normal_world: unit normals.
        sun_visibility: visible fraction of the solar disc, 0 on surfaces turned away.
    """
    upward = normal_world[:, 2]
    shapes = {
        "ground": upward > GROUND_ABOVE,
        "facades": np.abs(upward) < FACADE_BELOW,
    }
    lights = {
        "lit": sun_visibility > LIT_ABOVE,
        "shadowed": sun_visibility < SHADOW_BELOW,
    }
    classes = {"all": np.ones(len(upward), dtype=bool)}
    for shape, has_shape in shapes.items():
        classes |= {f"{shape}, {name}": has_shape & has_light for name, has_light in lights.items()}
    return classes
