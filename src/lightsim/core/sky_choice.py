"""A target sky as a user names it."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from lightsim.core.checks import check_number
from lightsim.errors import InputError

_MIN_SCALE = 1e-9
"""Skies are stored in anything from cd/m2 to arbitrary units: nine orders hold them all."""


@dataclass(frozen=True)
class SkyChoice:
    """A target sky as the user names it.

    Args:
        sky: a .hdr or .exr file, sun:AZIMUTH,ELEVATION[,TURBIDITY], time:ISO or source.
        yaw_deg: turns the sky clockwise seen from above.
        scale: "auto", "none" or a number.
    """

    sky: str
    yaw_deg: float = 0.0
    scale: str = "auto"

    def __post_init__(self) -> None:
        check_number("--sky-yaw-deg", self.yaw_deg, -360.0, 360.0)
        _ = self.scale_mode

    @property
    def path(self) -> Path | None:
        """The file, if the sky is one."""
        named = self.sky == "source" or self.sky.startswith(("sun:", "time:"))
        return None if named else Path(self.sky)

    @property
    def name(self) -> str:
        """A name for files: a file's stem, or the words with signs that file systems know."""
        words = self.sky if self.path is None else self.path.stem
        return re.sub(r"[^\w.+-]+", "_", words).strip("._-") or "sky"

    @property
    def scale_mode(self) -> Literal["auto", "none"] | float:
        """`scale`, as a number where it is one.

        Raises:
            InputError: it is neither a word nor a positive number.
        """
        if self.scale == "auto" or self.scale == "none":
            return self.scale
        try:
            factor = float(self.scale)
        except ValueError as error:
            raise InputError(
                "the sky scale is not understood",
                where="--sky-scale",
                got=self.scale,
                expected="auto, none or a number",
            ) from error
        check_number("--sky-scale", factor, _MIN_SCALE, 1.0 / _MIN_SCALE)
        return factor
