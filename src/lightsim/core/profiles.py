"""Profiles: one label for each column, with a cost for steps between neighbours."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64, Int64


def best_profile(
    energy: Float64[np.ndarray, "s t"], step: float, step_per_label: float
) -> Int64[np.ndarray, " s"]:
    """Return the profile of least total energy, exactly (Viterbi 1967,
    doi:10.1109/TIT.1967.1054010).

    Args:
        energy: cost of each label in each column, nats.
        step: cost of two neighbours with different labels, nats.
        step_per_label: further cost for each label between them, nats.
    """
    # best[t]: least energy of all profiles up to column s that end with label t; came_from[s, t]:
    # the label of column s - 1 in that profile. The profile is read backwards from the best end.
    count, labels = energy.shape
    levels = np.arange(labels)
    change = _change(labels, step, step_per_label)
    best = energy[0]
    came_from = np.zeros((count, labels), dtype=np.int64)
    for s in range(1, count):
        total = best + change
        came_from[s] = total.argmin(axis=1)
        best = energy[s] + total[levels, came_from[s]]
    profile = np.zeros(count, dtype=np.int64)
    profile[-1] = best.argmin()
    for s in range(count - 1, 0, -1):
        profile[s - 1] = came_from[s, profile[s]]
    return profile


def least_energies(
    energy: Float64[np.ndarray, "s t"], step: float, step_per_label: float
) -> Float64[np.ndarray, "s t"]:
    """Return the min-marginals of all labels of all columns: the least total energy of a profile
    with this label in this column, up to a constant per column. Arguments as in `best_profile`."""
    change = _change(energy.shape[1], step, step_per_label)
    before, after = np.zeros_like(energy), np.zeros_like(energy)
    for s in range(1, len(energy)):
        before[s] = (before[s - 1] + energy[s - 1] + change).min(axis=1)
        # Only differences within a column matter; without this, sums grow with the length.
        before[s] -= before[s].min()
    for s in range(len(energy) - 2, -1, -1):
        after[s] = (after[s + 1] + energy[s + 1] + change).min(axis=1)
        after[s] -= after[s].min()
    return energy + before + after


def label_probabilities(
    energy: Float64[np.ndarray, "s t"], fresh: Float64[np.ndarray, "s t"], chance: float
) -> Float64[np.ndarray, "s t"]:
    """Return the marginal probability of each label in each column, over all profiles.

    Model: with probability `chance` a column starts a new segment; otherwise it has the label of
    its neighbour or, one time in ten, an adjacent one. Marginals follow from the forward-backward
    algorithm (Rabiner 1989, doi:10.1109/5.18626).

    Args:
        energy: cost of each label in each column, nats.
        fresh: probability of each label at the start of a segment.
        chance: probability of a new segment, for each column.
    """
    # Messages are normalised in each column: products over a street would underflow.
    likelihood = np.exp(energy.min(axis=1, keepdims=True) - energy)
    before, after = likelihood * fresh, np.ones_like(energy)
    before[0] /= before[0].sum()
    for s in range(1, len(energy)):
        kept = (1 - chance) * _diffused(before[s - 1])
        before[s] = (kept + chance * fresh[s]) * likelihood[s]
        before[s] /= before[s].sum()
    for s in range(len(energy) - 2, -1, -1):
        message = after[s + 1] * likelihood[s + 1]
        after[s] = (1 - chance) * _diffused(message) + chance * (fresh[s + 1] @ message)
        after[s] /= after[s].max()
    both = before * after
    return both / both.sum(axis=1, keepdims=True)


def _diffused(weight: Float64[np.ndarray, " t"]) -> Float64[np.ndarray, " t"]:
    """Move a tenth of the weight to adjacent labels."""
    padded = np.pad(weight, 1, mode="edge")
    return 0.9 * weight + 0.05 * (padded[2:] + padded[:-2])


def _change(labels: int, step: float, step_per_label: float) -> Float64[np.ndarray, "t t"]:
    """Return the cost of each pair of labels of two neighbours."""
    levels = np.arange(labels)
    rise = np.abs(levels[:, None] - levels)
    return np.where(rise > 0, step + step_per_label * rise, 0.0)


def energy_of_filling(
    against_filled: Float64[np.ndarray, "s c"], against_free: Float64[np.ndarray, "s c"]
) -> Float64[np.ndarray, "s t"]:
    """Return the cost of each number of filled cells from the bottom: the costs of these being
    filled and of all others being free."""
    energy = np.zeros((against_filled.shape[0], against_filled.shape[1] + 1))
    energy[:, 1:] += np.cumsum(against_filled, axis=1)
    energy[:, :-1] += np.cumsum(against_free[:, ::-1], axis=1)[:, ::-1]
    return energy
