"""Loopy belief propagation on pairs of binary labels, compiled by numba.

The sum-product algorithm (Kschischang et al. 2001, doi:10.1109/18.910572), iterated on a graph with
cycles.
"""

# numba infers the types of its functions' parameters.
# pyright: reportMissingParameterType=false

from __future__ import annotations

from typing import no_type_check

from numba import njit


@njit(cache=True, inline="always")
@no_type_check
def _softplus(x):
    """Approximate log(1 + exp(x)) within 0.05: a parabola joins the two asymptotes."""
    # 0.6931 = log 2, the value at 0; 3.6 is the half width of the parabola.
    gap = 1.0 - abs(x) / 3.6
    return max(x, 0.0) + (0.6931 * gap * gap if gap > 0.0 else 0.0)


@njit(cache=True, inline="always")
@no_type_check
def _message(h, e00, e01, e10, e11):
    """Return the message in log odds from a neighbour of log odds `h`.

    The energies are indexed [neighbour's label, receiver's label].
    """
    to_one = _softplus(h - e11 + e01)
    to_zero = _softplus(h - e10 + e00)
    return to_one - e01 - (to_zero - e00)


@njit(cache=True)
@no_type_check
def propagate(unary, pairs, energy, messages, belief, rounds, damping):
    """Pass sum-product messages along every pair in both directions, in place.

    Args:
        unary: [n] log odds of label 1.
        pairs: [e, 2] indices of variables.
        energy: [e, 2, 2] by (label of the first, label of the second), in nats.
        messages: [e, 2] to the first and to the second; 0, or the result of an earlier call.
        belief: [n] log odds, written.
        rounds: most sweeps over all pairs.
        damping: weight of a message's previous value, in [0, 1).
    """
    belief[:] = unary
    for e in range(len(pairs)):
        belief[pairs[e, 0]] += messages[e, 0]
        belief[pairs[e, 1]] += messages[e, 1]
    for turn in range(rounds):
        change = 0.0
        for step in range(len(pairs)):
            # Alternating the order propagates information along chains in both directions.
            e = step if turn % 2 == 0 else len(pairs) - 1 - step
            i, j = pairs[e, 0], pairs[e, 1]
            old_i, old_j = messages[e, 0], messages[e, 1]
            a, b, c, d = energy[e, 0, 0], energy[e, 0, 1], energy[e, 1, 0], energy[e, 1, 1]
            new_j = damping * old_j + (1 - damping) * _message(belief[i] - old_i, a, b, c, d)
            new_i = damping * old_i + (1 - damping) * _message(belief[j] - old_j, a, c, b, d)
            messages[e, 0], messages[e, 1] = new_i, new_j
            belief[i] += new_i - old_i
            belief[j] += new_j - old_j
            change = max(change, abs(new_i - old_i), abs(new_j - old_j))
        if change < 0.05:
            break
