"""The target sky that a user names: a file, a sun position, a time, or the source's own."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from lightsim.core.dome import SkyDome, find_sun
from lightsim.errors import InputError
from lightsim.store.artefact import fingerprint
from lightsim.workspace import Workspace

SKY_HEIGHT_PX = 256


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

    @property
    def path(self) -> Path | None:
        """The file, if the sky is one."""
        named = self.sky == "source" or self.sky.startswith(("sun:", "time:"))
        return None if named else Path(self.sky)

    @property
    def input_key(self) -> str:
        """Hash of the file's bytes, or the words themselves."""
        if self.path is None:
            return self.sky
        if not self.path.is_file():
            raise InputError(
                "the sky is neither a file nor a known form",
                where=f"--sky {self.sky}",
                expected="a .hdr or .exr file, sun:AZ,EL[,TURBIDITY], time:ISO or source",
            )
        return fingerprint(self.path)


@dataclass(frozen=True, eq=False)
class TargetSky:
    """The sky to render with, in scene units, and what was done to get there."""

    dome: SkyDome
    facts: dict[str, Any]


def resolve_sky(choice: SkyChoice, workspace: Workspace) -> TargetSky:
    """The dome that a user's words name, turned and scaled, for the log of a workspace.

    Raises:
        InputError: the words or the file are wrong, or the sun is below the horizon.
    """
    from lightsim.lighting.target import dome_from_array, scale_to_source, target_sky
    from lightsim.store.images import read_sky

    notes: tuple[str, ...] = ()
    facts: dict[str, Any] = {"sky": choice.sky}
    if choice.path is None:
        dome, description, found = target_sky(
            choice.sky,
            geo=workspace.log.geo,
            source=workspace.sky,
            height_px=workspace.sky.dome.height_px,
        )
        facts |= {"description": description, **found}
    else:
        if not choice.path.is_file():
            _ = choice.input_key
        file = read_sky(choice.path)
        dome, notes = dome_from_array(file.radiance, str(choice.path)), file.notes
    if choice.yaw_deg:
        dome = dome.turned(-choice.yaw_deg)
    dome, factor = scale_to_source(dome, workspace.sky.dome, _scale_mode(choice.scale))
    sun = dome.sun or find_sun(dome.radiance)
    facts |= {
        "yaw_deg": choice.yaw_deg,
        "scale": choice.scale,
        "scale_factor": factor,
        "horizontal_irradiance": dome.horizontal_irradiance().tolist(),
        "sun_direction_world": None if sun is None else sun.direction_world.tolist(),
        "sun_irradiance": None if sun is None else sun.irradiance.tolist(),
        "notes": list(notes),
    }
    return TargetSky(dome, facts)


def _scale_mode(scale: str) -> Literal["auto", "none"] | float:
    if scale == "auto" or scale == "none":
        return scale
    try:
        return float(scale)
    except ValueError as error:
        raise InputError(
            "the sky scale is not understood",
            where="--sky-scale",
            got=scale,
            expected="auto, none or a number",
        ) from error
