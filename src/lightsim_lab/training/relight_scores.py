"""Scores of a relighting network on validation streets."""

from __future__ import annotations

from collections import defaultdict
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32
from torch import Tensor, nn
from torch.nn import functional

from lightsim.build.quality.metrics import psnr
from lightsim.build.quality.statistics import rank_correlation
from lightsim.progress import Progress
from lightsim.relighting.network.features import srgb_of
from lightsim_lab.metrics.lpips import Features, lpips_features, lpips_of_features
from lightsim_lab.training.relight_data import RelightData
from lightsim_lab.training.relight_pairs import RelightBatch

Picture = Float32[np.ndarray, "h w 3"]
# Row of the scores for frames relit under their own sky.
IDENTITY = "identity"


def score_relight(network: nn.Module, data: RelightData, progress: Progress) -> dict[str, Any]:
    """Return PSNR in dB and LPIPS by target sky and method, outside the sky of the matte.

    All measured skies form one row, `measured`; the target of `identity` is the source. A network
    that predicts its error also gets `error_rank_correlation`, the mean Spearman rank correlation
    of predicted and true error.
    """
    found: dict[str, dict[str, list[tuple[float, float]]]] = defaultdict(lambda: defaultdict(list))
    correlations: list[float] = []
    network.eval()
    for index in progress.track(range(len(data)), "validate relighting"):
        for sky in (*data.skies(index), None):
            batch = data.whole(index, sky)
            made, log_error = made_by(network, batch)
            is_valid = is_judged(batch)
            truth = picture_of(batch.truth)
            # `physical` and `copy` are the references: the uncorrected estimate, and no relighting.
            methods = {"network": made}
            if sky is not None:
                methods["physical"] = picture_of(srgb_of(batch.planes["target_physical"]))
                methods["copy"] = picture_of(batch.planes["source"])
            features = lpips_features(truth)
            for method, picture in methods.items():
                scores = scores_of(picture, truth, features, is_valid.numpy())
                found[_condition(sky)][method].append(scores)
            if log_error is not None and sky is not None:
                correlations.append(_correlation(made, truth, is_valid, log_error))
    rows = {
        sky: {
            name: dict(zip(("psnr_db", "lpips"), _mean(one), strict=True))
            for name, one in own.items()
        }
        for sky, own in sorted(found.items())
    }
    return rows | ({"error_rank_correlation": float(np.mean(correlations))} if correlations else {})


def is_judged(batch: RelightBatch) -> Bool[Tensor, "h w"]:
    """Return the pixels of a frame that are scored: valid ones outside the sky of the matte."""
    return (batch.weight[0, 0] > 0) & (batch.planes["matte"][0, 0] < 0.5)


def _condition(sky: str | None) -> str:
    """Return the row of a target sky: one of the streets' own three, `measured`, or IDENTITY."""
    if sky is None:
        return IDENTITY
    return sky if sky in ("low_sun", "high_sun", "overcast") else "measured"


def made_by(network: nn.Module, batch: RelightBatch) -> tuple[Picture, Tensor | None]:
    """Return a network's picture of one frame, and its predicted log error, or None."""
    with torch.inference_mode():
        found = network(batch.planes)
    if isinstance(found, Tensor):
        return picture_of(found), None
    return picture_of(srgb_of(found.picture)), found.log_error


def picture_of(srgb: Float[Tensor, "1 3 h w"]) -> Picture:
    """Convert an sRGB tensor to a picture, clipped to [0, 1]."""
    return srgb[0].clamp(0, 1).permute(1, 2, 0).contiguous().numpy()


def scores_of(
    picture: Picture,
    truth: Picture,
    features: Features | None,
    is_valid: Bool[np.ndarray, "h w"],
) -> tuple[float, float]:
    """Return PSNR in dB and LPIPS over the valid pixels.

    Args:
        features: `lpips_features` of the truth; None: LPIPS is not computed and is NaN.
    """
    if features is None:
        return psnr(picture, truth, is_valid), float("nan")
    # LPIPS needs whole images: the truth replaces invalid pixels.
    filled = np.where(is_valid[..., None], picture, truth)
    distance = lpips_of_features(lpips_features(filled), features, is_valid)
    return psnr(picture, truth, is_valid), distance


def _correlation(made: Picture, truth: Picture, is_valid: Tensor, log_error: Tensor) -> float:
    error = torch.from_numpy(np.abs(made - truth).mean(-1))[None, None]
    size = log_error.shape[-2:]
    error = functional.interpolate(error, size, mode="area")[0, 0]
    # Cells of the predicted error count only if they are valid almost everywhere.
    whole = functional.interpolate(is_valid.float()[None, None], size, mode="area")[0, 0] > 0.99
    return rank_correlation(error[whole].numpy(), log_error[0, 0][whole].numpy())


def _mean(scores: list[tuple[float, float]]) -> tuple[float, ...]:
    return tuple(float(value) for value in np.mean(scores, axis=0))
