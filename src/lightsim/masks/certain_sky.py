"""Statistics of sky colour against angular distance; pixels that deviate by more are not sky.

They extend the sky of a camera to directions at which it observed none. A clear sky has nearly the
same colour a few degrees away, a pale gable in front of it has not, and clouds vary within smaller
angles. Each log provides its own statistics: of pairs of directions that are certainly sky, and of
pixels with LiDAR returns against the sky nearest to them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

# Sensitivity of the mattes to these constants is not measured.

# Boundaries of the classes of residuals (colour differences), CIE Lab; from noise to any contrast.
RESIDUALS_LAB = np.geomspace(0.5, 60.0, 25)
# Log-odds of sky from which pixels serve as samples of the sky.
CERTAIN_LOG_ODDS = 3.5
# Edge of the blocks of directions over which certain sky is averaged.
_BLOCK_DEG = 1.5
# Upper boundaries of the classes of angles to certain sky; there is no evidence beyond the last.
_ANGLES_DEG = np.array([3.0, 6.0, 12.0, 24.0])


def ratio_at(
    log_ratio: Float[np.ndarray, " r"], residual: Float[np.ndarray, "*n"]
) -> Float[np.ndarray, "*n"]:
    """Return the log ratio at a residual, interpolated in its logarithm between class middles."""
    step = RESIDUALS_LAB[1] / RESIDUALS_LAB[0]
    borders = np.log(RESIDUALS_LAB)
    middles = np.append(borders, borders[-1] + np.log(step)) - 0.5 * np.log(step)
    return np.interp(np.log(np.maximum(residual, 1e-3)), middles, log_ratio)


def log_ratios(
    sky: Float[np.ndarray, "*a r"], other: Float[np.ndarray, "*a r"]
) -> Float[np.ndarray, "*a r"]:
    """Return the log-likelihood ratio of two histograms of residuals, with add-one smoothing."""
    sky, other = sky + 1.0, other + 1.0
    return np.log(sky / sky.sum(axis=-1, keepdims=True)) - np.log(
        other / other.sum(axis=-1, keepdims=True)
    )


@dataclass(frozen=True, eq=False)
class CertainSky:
    """Blocks of directions in which the sky of one camera is certain.

    Args:
        directions: unit vectors of the blocks, frame `world`.
        lab: mean colour of each block, CIE Lab.
    """

    directions: Float[np.ndarray, "b 3"]
    lab: Float[np.ndarray, "b 3"]

    @staticmethod
    def of(directions: Float[np.ndarray, "n 3"], lab: Float[np.ndarray, "n 3"]) -> CertainSky:
        """Average directions and colours of pixels over blocks."""
        cells = np.floor(directions / np.radians(_BLOCK_DEG)).astype(np.int64)
        _, block, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
        block = block.ravel()
        both = np.concatenate([directions, lab], axis=1)
        sums = [np.bincount(block, column, len(count)) for column in both.T]
        means = np.stack(sums, axis=1) / count[:, None]
        length = np.linalg.norm(means[:, :3], axis=1, keepdims=True)
        return CertainSky(means[:, :3] / np.maximum(length, 1e-9), means[:, 3:])

    def residuals(
        self, directions: Float[np.ndarray, "n 3"], lab: Float[np.ndarray, "n 3"]
    ) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Return the class of the angle to the nearest block, and the colour difference from it."""
        from scipy.spatial import KDTree

        if not len(self.lab):
            return np.full(len(lab), len(_ANGLES_DEG)), np.zeros(len(lab))
        chord, nearest = KDTree(self.directions).query(directions)
        angle_deg = np.degrees(2.0 * np.arcsin(np.minimum(chord / 2.0, 1.0)))
        residual = np.linalg.norm(lab - self.lab[nearest], axis=1)
        return np.digitize(angle_deg, _ANGLES_DEG), residual

    def sky_count(self) -> Float[np.ndarray, "a r"]:
        """Return the histogram of residuals of all pairs of blocks, by class of their angle."""
        cosine = np.clip(self.directions @ self.directions.T, -1.0, 1.0)
        i, j = np.nonzero(np.triu(cosine, 1) > np.cos(np.radians(_ANGLES_DEG[-1])))
        angle = np.digitize(np.degrees(np.arccos(cosine[i, j])), _ANGLES_DEG)
        return _counts(angle, np.linalg.norm(self.lab[i] - self.lab[j], axis=1))

    def other_count(
        self, directions: Float[np.ndarray, "n 3"], lab: Float[np.ndarray, "n 3"]
    ) -> Float[np.ndarray, "a r"]:
        """Return the histogram of residuals of pixels that are not sky, by class of the angle."""
        return _counts(*self.residuals(directions, lab))

    def against(
        self,
        directions: Float[np.ndarray, "n 3"],
        lab: Float[np.ndarray, "n 3"],
        log_ratio: Float[np.ndarray, "a r"],
    ) -> Float[np.ndarray, " n"]:
        """Return log-likelihood ratios of sky against other surfaces, at most 0.

        Agreement with the sky's colour is not used as evidence of sky, because surfaces of the
        street can have the same colour.
        """
        angle, residual = self.residuals(directions, lab)
        found = np.zeros(len(residual))
        for k, row in enumerate(log_ratio):
            found[angle == k] = np.minimum(ratio_at(row, residual[angle == k]), 0.0)
        return found


def _counts(
    angle: Int[np.ndarray, " n"], residual: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "a r"]:
    """Return the histogram by class of angle and residual, without angles beyond the last class."""
    counts = np.zeros((len(_ANGLES_DEG) + 1, len(RESIDUALS_LAB) + 1))
    np.add.at(counts, (angle, np.digitize(residual, RESIDUALS_LAB)), 1.0)
    return counts[:-1]
