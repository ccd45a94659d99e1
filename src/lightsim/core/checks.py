"""Ranges of options, checked where the options are made."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from lightsim.errors import InputError

MAX_SEED = 2**32 - 1
"""All generators in use (numpy, torch, Mitsuba) take seeds of 32 bits."""
MAX_EXPOSURE_EV = 30.0
"""Thirty stops take the darkest value of an 8-bit camera beyond any sun."""
MIN_IMAGE_SCALE = 0.01
"""A camera of 1920 pixels would be 19 wide: nothing can be seen on less."""


def check_number(
    where: str, value: float | int, least: float | int = -math.inf, most: float | int = math.inf
) -> None:
    """Refuse what is not a finite number from `least` to `most`.

    Args:
        where: the option, as a user writes it.

    Raises:
        InputError: it is nan, infinite or out of range.
    """
    # Whole numbers may be too large for a float, which isfinite would make of them.
    if (isinstance(value, int) or math.isfinite(value)) and least <= value <= most:
        return
    if math.isfinite(least) and math.isfinite(most):
        expected = f"a number from {least:g} to {most:g}"
    elif math.isfinite(least):
        expected = f"a finite number of at least {least:g}"
    else:
        expected = "a finite number"
    raise InputError("the value is out of range", where=where, got=value, expected=expected)


def check_seed(seed: int, where: str = "--seed") -> None:
    """Refuse a seed that a generator would not take."""
    check_number(where, seed, 0, MAX_SEED)


def check_image_scale(image_scale: float) -> None:
    """Refuse a factor on the recorded size that leaves nothing, or would invent pixels."""
    check_number("--image-scale", image_scale, MIN_IMAGE_SCALE, 1.0)


def check_choice(where: str, value: str | None, choices: Sequence[str | None]) -> None:
    """Refuse a word that is not one of an option's."""
    if value not in choices:
        raise InputError(
            "there is no such choice",
            where=where,
            got=repr(value)[:80],
            expected=f"one of {', '.join(str(choice) for choice in choices)}",
        )


@dataclass(frozen=True)
class Limit:
    """Between which values a measured quantity is taken, and what is said of others.

    Args:
        what: the message where it is refused.
        most: largest value that is taken.
        unit: of all four numbers, for the message.
        least: smallest value that is taken.
        odd: outside these two it is taken, but worth a note.
        remedy: what to do where it is refused.
    """

    what: str
    most: float
    unit: str
    least: float = -math.inf
    odd: tuple[float, float] = (-math.inf, math.inf)
    remedy: str | None = None

    def check(self, where: object, value: float, got: str) -> bool:
        """Refuse what lies outside; whether the value is odd.

        Args:
            where: the file or entry.
            value: to compare; nan is refused.
            got: the value in words.

        Raises:
            InputError: it lies outside.
        """
        if not self.least <= value <= self.most:
            least = "at most" if math.isinf(self.least) else f"{self.least:g} to"
            raise InputError(
                self.what,
                where=where,
                got=got,
                expected=f"{least} {self.most:g} {self.unit}",
                remedy=self.remedy,
            )
        return not self.odd[0] <= value <= self.odd[1]
