"""Mounting and time offset of each camera, from LiDAR depth edges and image edges."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64
from scipy.optimize import minimize

from lightsim.align.config import HELD_BACK, AlignConfig
from lightsim.align.edges import edge_strength, reduced_grey, sample
from lightsim.core.alignment import CameraCorrection, corrected_frame
from lightsim.core.camera import PinholeCamera
from lightsim.core.frames import Trajectory
from lightsim.core.sensors import CameraFrame
from lightsim.progress import Progress

Edges = Mapping[str, Float64[np.ndarray, "_ 3"]]
"""Depth edges by frame stem, frame `world`."""

# Camera alignment is measured as a whole (docs/decisions/0004-alignment-stage.md), not by constant.

# Standard deviation of each correction: rotation in radians (0.15 degrees), shift in metres, time
# offset in seconds.
_DEVIATION = np.array([np.radians(0.15)] * 3 + [0.015] * 3 + [0.01])
# Largest correction, in standard deviations.
_LIMIT = 3.0
# Weight of the prior against the mean edge strength, which is between 0 and 1.
_PRIOR_WEIGHT = 0.002
# Steps of the numerical derivatives of pixel positions, in the units of `_DEVIATION`.
_STEPS = np.array([1e-4] * 3 + [1e-3] * 3 + [1e-3])
# Gaussian blur of the edge strength from coarse to fine, in reduced pixels.
_LEVELS_PX = (4.0, 2.0, 1.0)
# Depth edges this far outside the image are included: a correction may move them inside.
_BORDER_PX = 30.0
# Depth edges drawn in each frame; bounds the time.
_EDGES_PER_FRAME = 1200
# Fewest depth edges in all frames of a camera for a fit of seven parameters.
_LEAST_EDGES = 1000
# Images wider than this are reduced before the comparison; bounds the time.
_IMAGE_WIDTH_PX = 960


@dataclass(frozen=True)
class CameraFit:
    """Correction of one camera and its mean edge strength (0 to 1) under held-back depth edges.

    Args:
        is_kept: True if the held-back score rose by `AlignConfig.least_gain`.
    """

    camera_name: str
    correction: CameraCorrection
    score_before: float
    score_after: float
    is_kept: bool


@dataclass(frozen=True, eq=False)
class _View:
    """Frame with its sampled depth edges and the edge strength of its image at each level."""

    frame: CameraFrame
    points_world: Float64[np.ndarray, "n 3"]
    strength: tuple[Float32[np.ndarray, "h w"], ...]


def align_camera(
    camera: PinholeCamera,
    frames: Sequence[CameraFrame],
    edges_by_stem: Edges,
    ego: Trajectory,
    config: AlignConfig,
    rng: np.random.Generator,
) -> CameraFit | None:
    """Estimate the correction of one camera; None if its images contain too few depth edges.

    Maximises the image's edge strength under projected depth edges, from coarse to fine, with
    Gaussian priors on the seven parameters. Each round linearises pixel positions in them. The
    coarsest level can lead to a wrong maximum, so a second search starts one level below, and the
    better result of the two is used.
    """
    scale = min(1.0, _IMAGE_WIDTH_PX / camera.width_px)
    small = camera.scaled(scale)
    views = [_view(frame, small, edges_by_stem[frame.stem], rng) for frame in frames]
    if sum(len(view.points_world) for view in views) < _LEAST_EDGES:
        return None
    fitted = [v for i, v in enumerate(views) if i % HELD_BACK != 0]
    held_back = [v for i, v in enumerate(views) if i % HELD_BACK == 0]
    x, best = np.zeros(7), _score(np.zeros(7), fitted, small, ego)
    for first_level in (0, 1):
        found = np.zeros(7)
        for level in range(first_level, len(_LEVELS_PX)):
            for _ in range(2):  # the second linearisation corrects the first
                found = _improved(found, fitted, level, small, ego)
        away = found / _DEVIATION
        score = _score(found, fitted, small, ego) - 0.5 * _PRIOR_WEIGHT * float(away @ away)
        if score > best:
            x, best = found, score
    before = _score(np.zeros(7), held_back, small, ego)
    after = _score(x, held_back, small, ego)
    is_kept = after > before * (1.0 + config.least_gain)
    return CameraFit(camera.name, _correction(x), before, after, is_kept)


def chosen_frames(
    frames: Sequence[CameraFrame], stems: Collection[str], count: int
) -> list[CameraFrame]:
    """Return at most `count` frames, evenly distributed over the frames that have a sweep."""
    usable = [frame for frame in frames if frame.stem in stems]
    if len(usable) <= count:
        return usable
    return [usable[i] for i in np.linspace(0, len(usable) - 1, count).round().astype(int)]


def align_cameras(
    frames_by_camera: Mapping[str, Sequence[CameraFrame]],
    cameras: Mapping[str, PinholeCamera],
    edges_by_stem: Edges,
    ego: Trajectory,
    config: AlignConfig,
    *,
    rng: np.random.Generator,
    progress: Progress,
) -> list[CameraFit]:
    """Estimate the corrections of all cameras whose images contain enough depth edges."""
    fits: list[CameraFit] = []
    for name, frames in progress.track(
        frames_by_camera.items(), "camera mountings", len(frames_by_camera)
    ):
        fit = align_camera(cameras[name], frames, edges_by_stem, ego, config, rng)
        if fit is not None:
            fits.append(fit)
    return fits


def _view(
    frame: CameraFrame,
    camera: PinholeCamera,
    points_world: Float64[np.ndarray, "n 3"],
    rng: np.random.Generator,
) -> _View:
    """Return the depth edges in or near the image, and its edge strength at every level."""
    uv, _ = frame.project(camera, points_world)
    size = np.array([camera.width_px, camera.height_px])
    known = np.where(np.isfinite(uv), uv, -np.inf)
    is_near = np.all((known > -_BORDER_PX) & (known < size + _BORDER_PX), axis=1)
    chosen = rng.permutation(np.flatnonzero(is_near))[:_EDGES_PER_FRAME]
    grey = reduced_grey(frame.load_srgb8(), camera.height_px, camera.width_px)
    strength = tuple(edge_strength(grey, sigma) for sigma in _LEVELS_PX)
    return _View(frame, points_world[chosen], strength)


def _correction(x: Float64[np.ndarray, "7"]) -> CameraCorrection:
    return CameraCorrection(x[:3].copy(), x[3:6].copy(), float(x[6]))


def _projected(
    x: Float64[np.ndarray, "7"], views: Sequence[_View], camera: PinholeCamera, ego: Trajectory
) -> list[Float64[np.ndarray, "_ 2"]]:
    correction = _correction(x)
    return [
        corrected_frame(view.frame, correction, ego).project(camera, view.points_world)[0]
        for view in views
    ]


def _score(
    x: Float64[np.ndarray, "7"], views: Sequence[_View], camera: PinholeCamera, ego: Trajectory
) -> float:
    pairs = zip(views, _projected(x, views, camera, ego), strict=True)
    values = np.concatenate([sample(view.strength[-1], uv) for view, uv in pairs])
    return float(values.mean()) if len(values) else 0.0


def _improved(
    x: Float64[np.ndarray, "7"],
    views: Sequence[_View],
    level: int,
    camera: PinholeCamera,
    ego: Trajectory,
) -> Float64[np.ndarray, "7"]:
    """Return `x` after one round: pixel positions linearised, then a quasi-Newton search."""
    base = _projected(x, views, camera, ego)
    slopes = [np.zeros((len(uv), 2, 7)) for uv in base]
    for k in range(7):
        moved = x.copy()
        moved[k] += _STEPS[k]
        for slope, uv, start in zip(
            slopes, _projected(moved, views, camera, ego), base, strict=True
        ):
            # In pixels per standard deviation; NaN behind the camera becomes 0.
            slope[:, :, k] = np.nan_to_num((uv - start) / _STEPS[k]) * _DEVIATION[k]
    count = max(1, sum(len(uv) for uv in base))

    def cost(z: Float64[np.ndarray, "7"]) -> tuple[float, Float64[np.ndarray, "7"]]:
        total, gradient = 0.0, np.zeros(7)
        for view, start, slope in zip(views, base, slopes, strict=True):
            image, uv = view.strength[level], start + slope @ z
            total -= float(sample(image, uv).sum())
            du = sample(image, uv + [0.5, 0.0]) - sample(image, uv - [0.5, 0.0])
            dv = sample(image, uv + [0.0, 0.5]) - sample(image, uv - [0.0, 0.5])
            gradient -= slope[:, 0].T @ du + slope[:, 1].T @ dv
        away = x / _DEVIATION + z
        prior = 0.5 * _PRIOR_WEIGHT * float(away @ away)
        return total / count + prior, gradient / count + _PRIOR_WEIGHT * away

    limits = [(-_LIMIT - start, _LIMIT - start) for start in x / _DEVIATION]
    found = minimize(
        cost, np.zeros(7), jac=True, method="L-BFGS-B", bounds=limits, options={"maxiter": 15}
    )
    return x + found.x * _DEVIATION
