"""A target sky as a user names it."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from lightsim.core.checks import check_number
from lightsim.errors import InputError

# Skies are stored in anything from cd/m2 to arbitrary units: nine orders hold them all.
_MIN_SCALE = 1e-9
# From a veiled sun to a clear one is a factor of a hundred.
_MAX_SUN_FACTOR = 1e3
POSITION = "AZIMUTH,ELEVATION in degrees"
FORMS = (
    "a .hdr or .exr file (FILE.exr#LAYER takes a layer of it), sun:AZIMUTH,ELEVATION[,TURBIDITY],"
    " time:ISO or source"
)
_LAYER = re.compile(r"(?P<path>.*\.(exr|hdr))#(?P<layer>.+)", re.DOTALL | re.IGNORECASE)
_SUFFIX = re.compile(r"\.[a-z]\w{1,4}$", re.IGNORECASE)


@dataclass(frozen=True)
class SkyChoice:
    """A target sky as the user names it.

    Args:
        sky: a .hdr or .exr file, FILE.exr#LAYER, sun:AZIMUTH,ELEVATION[,TURBIDITY], time:ISO or
            source. A file that exists is taken by its whole name, "#" included.
        yaw_deg: turns the sky clockwise seen from above.
        scale: "auto", "none" or a number.
        move_sun: "AZIMUTH,ELEVATION" where the sun is put; empty where it stays.
        sun_factor: on the sun's irradiance; 0 takes the sun out.
    """

    sky: str
    yaw_deg: float = 0.0
    scale: str = "auto"
    move_sun: str = ""
    sun_factor: float = 1.0

    def __post_init__(self) -> None:
        check_number("--sky-yaw-deg", self.yaw_deg, -360.0, 360.0)
        check_number("--sun-factor", self.sun_factor, 0.0, _MAX_SUN_FACTOR)
        _ = self.scale_mode, self.sun_position

    @property
    def sun_position(self) -> tuple[float, float] | None:
        """Azimuth from true north and elevation that the sun is moved to, degrees.

        Raises:
            InputError: they cannot be read, or lie below the horizon.
        """
        if not self.move_sun:
            return None
        azimuth_deg, elevation_deg = sun_numbers(self.move_sun, "--move-sun", POSITION)
        return azimuth_deg, elevation_deg

    @property
    def has_edited_sun(self) -> bool:
        """Whether the sky's own sun is moved, or made weaker or stronger."""
        return bool(self.move_sun) or self.sun_factor != 1.0

    @property
    def path(self) -> Path | None:
        """The file, if the sky is one; a leading ~ is the home folder."""
        named = self.sky == "source" or self.sky.startswith(("sun:", "time:"))
        return None if named else Path(os.path.expanduser(self._file_and_layer[0]))

    @property
    def layer(self) -> str:
        """The layer of an OpenEXR file that is asked for; empty where none is."""
        return self._file_and_layer[1]

    @property
    def is_like_path(self) -> bool:
        """Whether the words look like a file's path, not like a misspelt form."""
        words = self._file_and_layer[0]
        return "/" in words or words.startswith("~") or _SUFFIX.search(words) is not None

    @property
    def name(self) -> str:
        """A name for files: a file's stem and layer, or the words, in signs that file systems
        allow."""
        words = self.sky if self.path is None else f"{self.path.stem}_{self.layer}"
        return re.sub(r"[^\w.+-]+", "_", words).strip("._-") or "sky"

    @property
    def _file_and_layer(self) -> tuple[str, str]:
        match = _LAYER.fullmatch(self.sky)
        if match is None or os.path.isfile(os.path.expanduser(self.sky)):
            return self.sky, ""
        return match["path"], match["layer"]

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


def sun_numbers(text: str, where: str, expected: str, counts: Sequence[int] = (2,)) -> list[float]:
    """The numbers of "AZIMUTH,ELEVATION[,...]", degrees, azimuth in [0, 360).

    Args:
        where, expected: for errors.
        counts: how many there may be.

    Raises:
        InputError: they are not finite numbers, or the elevation is not above the horizon.
    """
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in counts or not np.isfinite(numbers).all():
        raise InputError("the sun cannot be read", where=where, got=text, expected=expected)
    if not 0 < numbers[1] <= 90:
        raise InputError(
            "the sun's elevation is out of range",
            where=where,
            got=numbers[1],
            expected="above 0 and at most 90 degrees",
            remedy="Night and twilight are not modelled; give an HDR file for them.",
        )
    return [numbers[0] % 360.0, *numbers[1:]]
