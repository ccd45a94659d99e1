"""Scores of the inpainting network and of baselines without a network."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float32

from lightsim.core.equirect import solid_angles_sr
from lightsim.lighting.panorama.inpaint import (
    fill_by_laplace,
    fill_by_nearest,
    fill_by_network,
    fill_by_rows,
)
from lightsim.lighting.sample import PanoramaBatch, PanoramaData

if TYPE_CHECKING:
    import torch

_BASELINES: dict[str, Callable[..., np.ndarray]] = {
    "row mean": fill_by_rows,
    "nearest": fill_by_nearest,
    "laplace": fill_by_laplace,
}


def evaluate_inpaint(
    data: PanoramaData,
    weights: Mapping[str, torch.Tensor],
    *,
    batches: int = 8,
    size: int = 8,
    seed: int = 0,
) -> dict[str, dict[str, float]]:
    """Return the mean errors by method ("network", "row mean", "nearest", "laplace").

    The errors are `psnr_db` and `l1` (sRGB in [0, 1]) in all holes, and `sky_psnr_db` and `sky_l1`
    above the horizon. They are averaged by solid angle over the holes of a panorama, then over
    panoramas.
    """
    scores: dict[str, list[dict[str, float]]] = {}
    for index in range(batches):
        batch = data.panoramas(size, seed, index)
        for method, filled in _fill(batch, weights).items():
            for i in range(size):
                score = hole_errors(filled[i], batch.panorama[i], batch.visibility[i])
                scores.setdefault(method, []).append(score)
    return {
        method: {key: float(np.mean([row[key] for row in rows])) for key in rows[0]}
        for method, rows in scores.items()
    }


def hole_errors(
    filled: Float32[np.ndarray, "h w 3"],
    truth: Float32[np.ndarray, "h w 3"],
    is_seen: Bool[np.ndarray, "h w"],
) -> dict[str, float]:
    """Return PSNR and mean absolute error in the holes; both are ideal without holes."""
    difference = filled.astype(np.float64) - truth
    weight = solid_angles_sr(truth.shape[0]) * ~is_seen
    is_up = (np.arange(truth.shape[0]) < truth.shape[0] // 2)[:, None]
    errors: dict[str, float] = {}
    for prefix, part in (("", weight), ("sky_", weight * is_up)):
        # Without holes above the horizon, the errors are 0 and the PSNR has its limit of 60 dB.
        total = max(float(part.sum()), 1e-9)
        mse = float((np.square(difference).mean(-1) * part).sum()) / total
        errors[f"{prefix}psnr_db"] = -10 * float(np.log10(max(mse, 1e-6)))
        errors[f"{prefix}l1"] = float((np.abs(difference).mean(-1) * part).sum()) / total
    return errors


def _fill(
    batch: PanoramaBatch, weights: Mapping[str, torch.Tensor]
) -> dict[str, Float32[np.ndarray, "n h w 3"]]:
    """Return the panoramas filled by each method."""
    # Unobserved pixels are 0, so that no method has access to the truth.
    known = (batch.panorama * batch.visibility[..., None]).astype(np.float32)
    pairs = list(zip(known, batch.visibility, strict=True))
    filled = {
        name: np.stack([fill(image, seen) for image, seen in pairs])
        for name, fill in _BASELINES.items()
    }
    return {"network": fill_by_network(known, batch.visibility, weights), **filled}
