"""Candidate layouts of a scene, in increasing distance from the usual parameter values."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import product
from typing import Any, NamedTuple

Make = Callable[..., list[dict[str, Any]]]
"""Returns the edits of a scene for values of its parameters."""
OTHER_SIDE_M = 6.0
"""Cost of changing the side, as a displacement along the path, in metres: a change from left to
right is more noticeable than a few metres. Chosen, not measured."""


class Choice(NamedTuple):
    """A value of a parameter.

    Args:
        cost_m: difference from the usual value, as metres of displacement along the path.
    """

    value: Any
    cost_m: float = 0.0


class Layout(NamedTuple):
    """Values of all parameters of a scene by name, and the same as command-line options."""

    values: dict[str, Any]
    options: str


def outwards(
    asked: float | None,
    usual: float,
    bounds: tuple[float, float],
    step: float,
    cost_m: float | None = None,
) -> list[Choice]:
    """Return candidate values of a parameter: the user's, else the usual one and others in bounds.

    Args:
        step: difference between two neighbouring values.
        cost_m: cost of one step, in metres along the path; by default the step.
    """
    if asked is not None:
        return [Choice(asked)]
    low, high = (round((bound - usual) / step) for bound in bounds)
    each = step if cost_m is None else cost_m
    return [Choice(usual + k * step, abs(k) * each) for k in range(low, high + 1)]


def sides(is_left: bool, is_right: bool, *, usually_left: bool) -> list[Choice]:
    """Return the side that the user gave as "is it the left one"; without one, both."""
    if is_left != is_right:
        return [Choice(is_left)]
    return [Choice(usually_left), Choice(not usually_left, OTHER_SIDE_M)]


def layouts(choices: Mapping[str, Sequence[Choice]]) -> list[Layout]:
    """Return all combinations by ascending total cost; ties keep the order of the choices."""
    # sorted is stable: layouts of equal cost stay in the order of the choices.
    free = {name for name, values in choices.items() if len(values) > 1}
    combined = sorted(product(*choices.values()), key=lambda row: sum(c.cost_m for c in row))
    return [
        Layout(
            {name: choice.value for name, choice in zip(choices, row, strict=True)},
            " ".join(
                _option(name, choice.value)
                for name, choice in zip(choices, row, strict=True)
                if name in free and _option(name, choice.value)
            ),
        )
        for row in combined
    ]


def _option(name: str, value: Any) -> str:
    """Spell a value as its command-line option; empty for a flag that is not given."""
    flag = name.removeprefix("is_").replace("_", "-")
    if value is True:
        return f"--{flag}"
    if value is False:
        return f"--{flag.replace('left', 'right')}" if "left" in flag else ""
    if isinstance(value, tuple):
        return f"--{flag} {','.join(map(str, value))}"
    return f"--{flag} {value:g}" if isinstance(value, float) else f"--{flag} {value}"
