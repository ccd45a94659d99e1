"""Words with which a user names a target sky; `simulation.skies` parses and resolves them."""

from __future__ import annotations

from dataclasses import dataclass

from lightsim.core.checks import check_number

# Largest factor on the sun's irradiance. A veiled sun and a clear one differ by a factor of about
# 100; 1000 leaves a margin. Chosen; a guard against typing errors.
_MAX_SUN_FACTOR = 1e3


@dataclass(frozen=True)
class SkyChoice:
    """A target sky as named on the command line or in SCENARIO.json.

    Args:
        sky: a .hdr or .exr file, FILE.exr#LAYER, sun:AZIMUTH,ELEVATION[,TURBIDITY], time:ISO or
            source.
        yaw_deg: rotation of the sky, degrees clockwise from above, as azimuths are (opposite to
            `SkyDome.rotated`).
        scale: "auto", "none" or a number.
        move_sun: "AZIMUTH,ELEVATION" of the moved sun, degrees; empty if it is not moved.
        sun_factor: factor on the sun's irradiance; 0 removes the sun.
    """

    sky: str
    yaw_deg: float = 0.0
    scale: str = "auto"
    move_sun: str = ""
    sun_factor: float = 1.0

    def __post_init__(self) -> None:
        check_number("--sky-yaw-deg", self.yaw_deg, -360.0, 360.0)
        check_number("--sun-factor", self.sun_factor, 0.0, _MAX_SUN_FACTOR)

    @property
    def has_edited_sun(self) -> bool:
        """True if the sun of the sky is moved or its irradiance is changed."""
        return bool(self.move_sun) or self.sun_factor != 1.0
