"""Range checks of options and of measured quantities."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from lightsim.errors import InputError

MAX_SEED = 2**32 - 1
"""Largest seed: the generators in use (numpy, torch, Mitsuba) accept 32 bits."""
MAX_EXPOSURE_EV = 30.0
"""Largest exposure correction, in stops: a factor of 1e9, beyond any use. Chosen as a guard against
typing errors."""
MIN_IMAGE_SCALE = 0.01
"""Smallest image scale: 1920 columns become 19, and smaller pictures are useless."""


def check_number(
    where: str, value: float | int, least: float | int = -math.inf, most: float | int = math.inf
) -> None:
    """Reject a value that is not a finite number from `least` to `most`.

    Args:
        where: the option, as a user writes it.

    Raises:
        InputError: it is nan, infinite or out of range.
    """
    # isfinite converts integers to float, which raises OverflowError for very large ones.
    if (isinstance(value, int) or math.isfinite(value)) and least <= value <= most:
        return
    if math.isfinite(least) and math.isfinite(most):
        expected = f"a number from {_text_of(least)} to {_text_of(most)}"
    elif math.isfinite(least):
        expected = f"a finite number of at least {_text_of(least)}"
    else:
        expected = "a finite number"
    raise InputError("the value is out of range", where=where, got=value, expected=expected)


def _text_of(bound: float | int) -> str:
    # Without an exponent: 1048576, not 1.04858e+06.
    return str(bound) if isinstance(bound, int) else f"{bound:.12g}"


def check_seed(seed: int, where: str = "--seed") -> None:
    """Reject a seed that a generator would not accept."""
    check_number(where, seed, 0, MAX_SEED)


def check_image_scale(image_scale: float) -> None:
    """Reject an image scale below MIN_IMAGE_SCALE or above 1."""
    check_number("--image-scale", image_scale, MIN_IMAGE_SCALE, 1.0)


def check_choice(where: str, value: str | None, choices: Sequence[str | None]) -> None:
    """Reject a word that is not one of the choices of an option."""
    if value not in choices:
        raise InputError(
            "there is no such choice",
            where=where,
            got=repr(value)[:80],
            expected=f"one of {', '.join(str(choice) for choice in choices)}",
        )


@dataclass(frozen=True)
class Limit:
    """Accepted range of a measured quantity, with the error message for values outside.

    Args:
        what: error message for a refused value.
        most: largest accepted value.
        unit: of all four numbers, for the message.
        least: smallest accepted value.
        odd: limits of the usual range; accepted values outside of it deserve a note.
        remedy: advice for a refused value.
    """

    what: str
    most: float
    unit: str
    least: float = -math.inf
    odd: tuple[float, float] = (-math.inf, math.inf)
    remedy: str | None = None

    def check(self, where: object, value: float, got: str) -> bool:
        """Reject a value out of range; return whether an accepted value is unusual (`odd`).

        Args:
            where: the file or entry.
            value: to compare; nan is refused.
            got: the value in words.

        Raises:
            InputError: it lies outside.
        """
        # Written as `not (a <= value <= b)`, so that nan, which fails both comparisons, is refused.
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
