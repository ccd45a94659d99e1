"""The best integer for every column of a row, where steps between neighbours cost."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64, Int64


def best_profile(
    energy: Float64[np.ndarray, "s t"], step: float, step_per_label: float
) -> Int64[np.ndarray, " s"]:
    """The profile of least total energy, exactly (Viterbi 1967, doi:10.1109/TIT.1967.1054010).

    Args:
        energy: of each column at each label, nats.
        step: of two neighbours with different labels, nats.
        step_per_label: the same, for every label between them.
    """
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
    """Of all profiles with this label in this column, the least total energy, up to a constant of
    each column: min-marginals. The arguments are those of `best_profile`."""
    change = _change(energy.shape[1], step, step_per_label)
    before, after = np.zeros_like(energy), np.zeros_like(energy)
    for s in range(1, len(energy)):
        before[s] = (before[s - 1] + energy[s - 1] + change).min(axis=1)
        before[s] -= before[s].min()
    for s in range(len(energy) - 2, -1, -1):
        after[s] = (after[s + 1] + energy[s + 1] + change).min(axis=1)
        after[s] -= after[s].min()
    return energy + before + after


def label_probabilities(
    energy: Float64[np.ndarray, "s t"], fresh: Float64[np.ndarray, "s t"], chance: float
) -> Float64[np.ndarray, "s t"]:
    """Of each label in each column, over all profiles: the best one alone has no steps where
    nothing speaks for one.

    A column has its neighbour's label (or, one in ten times, the next), but with a chance it
    begins something new; sums over all profiles by the forward-backward algorithm (Rabiner 1989,
    doi:10.1109/5.18626).

    Args:
        energy: of each column at each label, nats.
        fresh: probability of each label where something new begins.
        chance: of that, for each column.
    """
    likelihood = np.exp(energy.min(axis=1, keepdims=True) - energy)
    before, after = likelihood * fresh, np.ones_like(energy)
    before[0] /= before[0].sum()
    for s in range(1, len(energy)):
        kept = (1 - chance) * _wandering(before[s - 1])
        before[s] = (kept + chance * fresh[s]) * likelihood[s]
        before[s] /= before[s].sum()
    for s in range(len(energy) - 2, -1, -1):
        told = after[s + 1] * likelihood[s + 1]
        after[s] = (1 - chance) * _wandering(told) + chance * (fresh[s + 1] @ told)
        after[s] /= after[s].max()
    both = before * after
    return both / both.sum(axis=1, keepdims=True)


def _wandering(weight: Float64[np.ndarray, " t"]) -> Float64[np.ndarray, " t"]:
    """One in ten moves to a label beside it."""
    padded = np.pad(weight, 1, mode="edge")
    return 0.9 * weight + 0.05 * (padded[2:] + padded[:-2])


def _change(labels: int, step: float, step_per_label: float) -> Float64[np.ndarray, "t t"]:
    """Energy of every pair of neighbours' labels."""
    levels = np.arange(labels)
    rise = np.abs(levels[:, None] - levels)
    return np.where(rise > 0, step + step_per_label * rise, 0.0)


def energy_of_filling(
    against_filled: Float64[np.ndarray, "s c"], against_free: Float64[np.ndarray, "s c"]
) -> Float64[np.ndarray, "s t"]:
    """Energy of each number of filled cells, counted from the first: what speaks against these
    being filled, and against all others being free."""
    energy = np.zeros((against_filled.shape[0], against_filled.shape[1] + 1))
    energy[:, 1:] += np.cumsum(against_filled, axis=1)
    energy[:, :-1] += np.cumsum(against_free[:, ::-1], axis=1)[:, ::-1]
    return energy
