"""Mounting and time offset of each camera, by LiDAR depth edges on edges of its pictures."""

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

_LEVELS_PX = (4.0, 2.0, 1.0)
_ROUNDS = 2
_BORDER_PX = 30.0
_LEAST_EDGES = 1000
_PRIOR_WEIGHT = 0.002
_LIMIT = 3.0
"""Largest correction in units of its expected size."""
_STEPS = np.array([1e-4] * 3 + [1e-3] * 3 + [1e-3])

Edges = Mapping[str, Float64[np.ndarray, "_ 3"]]


# Each part as a whole is measured (docs/decisions/0004-alignment-stage.md), none of these alone.

# Depth edges used in each of them.
_EDGES_PER_FRAME = 1200
# Expected size of a correction of a mounting (one standard deviation).
_CAMERA_SHIFT_M = 0.015
# The same for its rotation.
_CAMERA_ROTATION_DEG = 0.15
# The same for a camera's time offset.
_CAMERA_TIME_S = 0.01
# Pictures wider than this are reduced before they are compared.
_PICTURE_WIDTH_PX = 960


@dataclass(frozen=True)
class CameraFit:
    """One camera's correction, and the mean edge strength under held-back depth edges.

    Args:
        is_kept: whether the held-back score rose enough.
    """

    camera_name: str
    correction: CameraCorrection
    score_before: float
    score_after: float
    is_kept: bool


@dataclass(frozen=True, eq=False)
class _View:
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
    """The correction of one camera; None where too few depth edges lie in its pictures.

    Maximises the picture's edge strength under projected depth edges, from coarse to fine, with
    Gaussian priors on the seven parameters. In each round pixel positions are linear in them. The
    coarsest level can lead to a wrong maximum, so a search without it competes.
    """
    scale = min(1.0, _PICTURE_WIDTH_PX / camera.width_px)
    small = camera.scaled(scale)
    views = [_view(frame, small, edges_by_stem[frame.stem], rng) for frame in frames]
    if sum(len(view.points_world) for view in views) < _LEAST_EDGES:
        return None
    fitted = [v for i, v in enumerate(views) if i % HELD_BACK != 0]
    judging = [v for i, v in enumerate(views) if i % HELD_BACK == 0]
    spread = np.array(
        [np.radians(_CAMERA_ROTATION_DEG)] * 3 + [_CAMERA_SHIFT_M] * 3 + [_CAMERA_TIME_S]
    )
    x, best = np.zeros(7), _score(np.zeros(7), fitted, small, ego)
    for first_level in (0, 1):
        found = np.zeros(7)
        for level in range(first_level, len(_LEVELS_PX)):
            for _ in range(_ROUNDS):
                found = _improved(found, spread, fitted, level, small, ego)
        away = found / spread
        score = _score(found, fitted, small, ego) - 0.5 * _PRIOR_WEIGHT * float(away @ away)
        if score > best:
            x, best = found, score
    before = _score(np.zeros(7), judging, small, ego)
    after = _score(x, judging, small, ego)
    is_kept = after > before * (1.0 + config.least_gain)
    return CameraFit(camera.name, _correction(x), before, after, is_kept)


def chosen_frames(
    frames: Sequence[CameraFrame], stems: Collection[str], count: int
) -> list[CameraFrame]:
    """Frames spread evenly over those whose sweep is there."""
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
    """Fits of all cameras that see enough depth edges."""
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
    """The depth edges in or near the picture, and its edge strength at every level."""
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
    spread: Float64[np.ndarray, "7"],
    views: Sequence[_View],
    level: int,
    camera: PinholeCamera,
    ego: Trajectory,
) -> Float64[np.ndarray, "7"]:
    """One round: linear pixel positions, then a quasi-Newton search in units of `spread`."""
    base = _projected(x, views, camera, ego)
    slopes = [np.zeros((len(uv), 2, 7)) for uv in base]
    for k in range(7):
        moved = x.copy()
        moved[k] += _STEPS[k]
        for slope, uv, start in zip(
            slopes, _projected(moved, views, camera, ego), base, strict=True
        ):
            slope[:, :, k] = np.nan_to_num((uv - start) / _STEPS[k]) * spread[k]
    count = max(1, sum(len(uv) for uv in base))

    def cost(z: Float64[np.ndarray, "7"]) -> tuple[float, Float64[np.ndarray, "7"]]:
        total, gradient = 0.0, np.zeros(7)
        for view, start, slope in zip(views, base, slopes, strict=True):
            image, uv = view.strength[level], start + slope @ z
            total -= float(sample(image, uv).sum())
            du = sample(image, uv + [0.5, 0.0]) - sample(image, uv - [0.5, 0.0])
            dv = sample(image, uv + [0.0, 0.5]) - sample(image, uv - [0.0, 0.5])
            gradient -= slope[:, 0].T @ du + slope[:, 1].T @ dv
        away = x / spread + z
        prior = 0.5 * _PRIOR_WEIGHT * float(away @ away)
        return total / count + prior, gradient / count + _PRIOR_WEIGHT * away

    limits = [(-_LIMIT - start, _LIMIT - start) for start in x / spread]
    found = minimize(
        cost, np.zeros(7), jac=True, method="L-BFGS-B", bounds=limits, options={"maxiter": 15}
    )
    return x + found.x * spread
