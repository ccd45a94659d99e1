"""How far the sky's colour changes from one direction to another, and what does so by more.

A camera that never saw the sky at a direction did see some beside it. A clear sky is nearly the
same colour a few degrees on, and a pale gable before it is not; clouds change within less. Which
it is, and how fast, each log shows: by pairs of directions that were surely sky, and by pixels that
returned a beam.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

RESIDUALS_LAB = np.geomspace(0.5, 60.0, 25)
"""Borders of the classes of residuals, CIE Lab."""
SURELY_SKY = 3.5
"""Log-odds of sky from which its colours and residuals are learnt."""
_BLOCK_DEG = 1.5
"""Sure sky is kept in blocks of directions about this wide."""
_ANGLES_DEG = np.array([3.0, 6.0, 12.0, 24.0])
"""Upper borders of the classes of angles; what is further from sure sky is told nothing."""


def ratio_at(
    log_ratio: Float[np.ndarray, " r"], residual: Float[np.ndarray, "*n"]
) -> Float[np.ndarray, "*n"]:
    """The log ratio at a residual, linear in its logarithm between the middles of classes."""
    step = RESIDUALS_LAB[1] / RESIDUALS_LAB[0]
    borders = np.log(RESIDUALS_LAB)
    middles = np.append(borders, borders[-1] + np.log(step)) - 0.5 * np.log(step)
    return np.interp(np.log(np.maximum(residual, 1e-3)), middles, log_ratio)


def log_ratios(
    sky: Float[np.ndarray, "*a r"], other: Float[np.ndarray, "*a r"]
) -> Float[np.ndarray, "*a r"]:
    """Of two counts of residuals; one more of each, since a log shows few of the rare ones."""
    sky, other = sky + 1.0, other + 1.0
    return np.log(sky / sky.sum(axis=-1, keepdims=True)) - np.log(
        other / other.sum(axis=-1, keepdims=True)
    )


@dataclass(frozen=True, eq=False)
class SureSky:
    """Blocks of directions in which one camera surely saw sky.

    Args:
        directions: unit vectors, frame world.
        lab: their mean colour.
    """

    directions: Float[np.ndarray, "b 3"]
    lab: Float[np.ndarray, "b 3"]

    @staticmethod
    def of(directions: Float[np.ndarray, "n 3"], lab: Float[np.ndarray, "n 3"]) -> SureSky:
        """Means over blocks."""
        cells = np.floor(directions / np.radians(_BLOCK_DEG)).astype(np.int64)
        _, block, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
        block = block.ravel()
        both = np.concatenate([directions, lab], axis=1)
        sums = [np.bincount(block, column, len(count)) for column in both.T]
        means = np.stack(sums, axis=1) / count[:, None]
        length = np.linalg.norm(means[:, :3], axis=1, keepdims=True)
        return SureSky(means[:, :3] / np.maximum(length, 1e-9), means[:, 3:])

    def residuals(
        self, directions: Float[np.ndarray, "n 3"], lab: Float[np.ndarray, "n 3"]
    ) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Of colours to that of the nearest block: class of the angle to it, and how far apart."""
        from scipy.spatial import KDTree

        if not len(self.lab):
            return np.full(len(lab), len(_ANGLES_DEG)), np.zeros(len(lab))
        chord, nearest = KDTree(self.directions).query(directions)
        angle_deg = np.degrees(2.0 * np.arcsin(np.minimum(chord / 2.0, 1.0)))
        residual = np.linalg.norm(lab - self.lab[nearest], axis=1)
        return np.digitize(angle_deg, _ANGLES_DEG), residual

    def sky_count(self) -> Float[np.ndarray, "a r"]:
        """Residuals of the sky to itself, by class of the angle: all pairs of blocks."""
        cosine = np.clip(self.directions @ self.directions.T, -1.0, 1.0)
        i, j = np.nonzero(np.triu(cosine, 1) > np.cos(np.radians(_ANGLES_DEG[-1])))
        angle = np.digitize(np.degrees(np.arccos(cosine[i, j])), _ANGLES_DEG)
        return _counts(angle, np.linalg.norm(self.lab[i] - self.lab[j], axis=1))

    def other_count(
        self, directions: Float[np.ndarray, "n 3"], lab: Float[np.ndarray, "n 3"]
    ) -> Float[np.ndarray, "a r"]:
        """Residuals of what is surely none."""
        return _counts(*self.residuals(directions, lab))

    def against(
        self,
        directions: Float[np.ndarray, "n 3"],
        lab: Float[np.ndarray, "n 3"],
        log_ratio: Float[np.ndarray, "a r"],
    ) -> Float[np.ndarray, " n"]:
        """Log-likelihood ratios of sky, at most 0: that a colour is the sky's tells little where
        the street is of that colour, too."""
        angle, residual = self.residuals(directions, lab)
        found = np.zeros(len(residual))
        for k, row in enumerate(log_ratio):
            found[angle == k] = np.minimum(ratio_at(row, residual[angle == k]), 0.0)
        return found


def _counts(
    angle: Int[np.ndarray, " n"], residual: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "a r"]:
    """By classes; what is beyond the last angle does not count."""
    counts = np.zeros((len(_ANGLES_DEG) + 1, len(RESIDUALS_LAB) + 1))
    np.add.at(counts, (angle, np.digitize(residual, RESIDUALS_LAB)), 1.0)
    return counts[:-1]
