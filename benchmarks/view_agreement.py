"""Agreement of two pictures of one scene, at matching points: colour, displacement, masks."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float64
from scipy.ndimage import map_coordinates

from lightsim.core.colour import luminance, srgb_from_linear
from lightsim_lab.metrics.consistency import Matches, View

# Side of the patches whose displacement is measured, in pixels.
_PATCH_PX = 24
# Smallest fraction of a patch that both views must show.
_LEAST_VISIBLE = 0.6
# Largest standard deviation of an accepted displacement, in pixels.
_CERTAIN_PX = 0.1


def colour_difference(a: View, b: View, matches: Matches) -> Float64[np.ndarray, " n"]:
    """Return the absolute log ratio of radiances, mean over the channels, at matching points."""
    # Limits the ratio of dark pixels, in scene units.
    dark = np.float32(1e-3)
    rows, columns = matches.pixel.T
    at = matches.uv[:, ::-1].T - 0.5
    other = [map_coordinates(b.radiance[..., c], at, order=1, mode="nearest") for c in range(3)]
    ratio = (a.radiance[rows, columns] + dark) / (np.stack(other, axis=1) + dark)
    return np.abs(np.log(ratio)).mean(axis=1).astype(np.float64)


def picture_shifts_px(a: View, b: View, matches: Matches) -> Float64[np.ndarray, " k"]:
    """Return the displacement of the second picture, warped to the first, in each textured patch.

    One step of Lucas & Kanade 1981 with gain and offset.
    """
    grey_a, grey_b = (srgb_from_linear(luminance(x.radiance)).astype(np.float64) for x in (a, b))
    rows, columns = matches.pixel.T
    seen = np.full(grey_a.shape, np.nan)
    seen[rows, columns] = map_coordinates(
        grey_b, matches.uv[:, ::-1].T - 0.5, order=3, mode="nearest"
    )
    rise, run = (np.asarray(slope) for slope in np.gradient(grey_a))
    shifts = []
    for top in range(0, grey_a.shape[0] - _PATCH_PX + 1, _PATCH_PX):
        for left in range(0, grey_a.shape[1] - _PATCH_PX + 1, _PATCH_PX):
            part = (slice(top, top + _PATCH_PX), slice(left, left + _PATCH_PX))
            known = np.isfinite(seen[part])
            if known.mean() < _LEAST_VISIBLE:
                continue
            here = grey_a[part][known]
            system = np.stack([run[part][known], rise[part][known], here, np.ones_like(here)], 1)
            shifts.append(_shift(system, seen[part][known] - here))
    found = np.array([s for s in shifts if s is not None])
    return np.linalg.norm(found.reshape(-1, 2), axis=1)


def _shift(
    system: Float64[np.ndarray, "n 4"], change: Float64[np.ndarray, " n"]
) -> Float64[np.ndarray, "2"] | None:
    """Fit the displacement by least squares; None where the patch does not determine it."""
    normal = system.T @ system
    if np.linalg.cond(normal) > 1e10:
        return None
    solution = np.asarray(np.linalg.solve(normal, system.T @ change))
    variance = float(np.square(change - system @ solution).mean())
    deviation = np.sqrt(variance * np.diagonal(np.linalg.inv(normal))[:2])
    return solution[:2] if bool(np.all(deviation < _CERTAIN_PX)) else None


def overlap(
    in_a: Bool[np.ndarray, "h w"], in_b: Bool[np.ndarray, "h w"], matches: Matches
) -> tuple[int, int]:
    """Return the numbers of matching points in both masks (intersection) and in either (union)."""
    rows, columns = matches.pixel.T
    one, other = in_a[rows, columns], in_b[matches.other]
    return int(np.count_nonzero(one & other)), int(np.count_nonzero(one | other))
