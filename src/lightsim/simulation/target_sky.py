"""Result of resolving a target sky: its dome and its provenance."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from lightsim.core.dome import SkyDome, Sun, split_sun


@dataclass(frozen=True)
class SkyFacts:
    """Provenance of a target sky; None marks what does not apply to its form.

    Args:
        sky: words of `--sky`.
        path: sky file.
        file_heading_deg: azimuth of the file's +x from true north, degrees.
        description: one line about a clear sky or the source sky.
        utc_ns: time of a `time:` sky, nanoseconds.
        assumed: assumption about an unknown heading.
        azimuth_deg: azimuth of the sun from true north, degrees.
        elevation_deg: elevation of the sun, degrees.
        turbidity: of a clear sky.
        origin: method that estimated the source sky.
        notes: changes to a file's pixels, orientation and level.
        yaw_deg: rotation in degrees, clockwise when viewed from above.
        scale: scaling mode or factor, as given.
        scale_factor: factor that was applied to the radiance.
        sun_factor: factor that was applied to the sun's irradiance.
        scenery_fraction: part of the upper half that showed scenery, in [0, 1].
    """

    sky: str
    path: Path | None = None
    file_heading_deg: float | None = None
    description: str | None = None
    utc_ns: int | None = None
    assumed: str | None = None
    azimuth_deg: float | None = None
    elevation_deg: float | None = None
    turbidity: float | None = None
    origin: str | None = None
    notes: tuple[str, ...] = ()
    yaw_deg: float | None = None
    scale: str | None = None
    scale_factor: float | None = None
    sun_factor: float | None = None
    scenery_fraction: float | None = None

    def noted(self, *notes: str) -> SkyFacts:
        """Return the facts with further notes."""
        return replace(self, notes=(*self.notes, *notes))

    def as_json(self) -> dict[str, Any]:
        """Return the facts that apply, by name; an unknown azimuth of a known sun is None."""
        facts = asdict(self) | {"notes": None if self.path is None else list(self.notes)}
        # Notes record the rotation to north; moving a sky file does not change the sky.
        del facts["path"], facts["file_heading_deg"]
        has_sun = self.elevation_deg is not None
        return {
            key: value
            for key, value in facts.items()
            if value is not None or (has_sun and key == "azimuth_deg")
        }


@dataclass(frozen=True, eq=False)
class TargetSky:
    """A sky to render with, in scene units.

    Args:
        dome: radiance that lights the scene.
        facts: provenance.
        name: of the sky's folder.
        behind: background that cameras show instead of a file that contains scenery; None shows
            the dome.
        is_source: True for the unchanged sky under which the log was recorded.
    """

    dome: SkyDome
    facts: SkyFacts
    name: str = ""
    behind: SkyDome | None = None
    is_source: bool = False

    @property
    def sun(self) -> Sun | None:
        """Sun of the dome: known, or found in its image."""
        return self.dome.sun or split_sun(self.dome)[1]

    @cached_property
    def record(self) -> dict[str, Any]:
        """Return the metadata of the sky as stored beside the frames: source, irradiance on level
        ground with and without the sun, and the sun's direction and irradiance.

        Irradiance is RGB, in radiance x sr.
        """
        # The disc is part of the dome, so its light is subtracted from that of the whole sky.
        sun, level = self.sun, self.dome.horizontal_irradiance()
        from_sun = 0.0 if sun is None else sun.irradiance * max(0.0, float(sun.direction_world[2]))
        return self.facts.as_json() | {
            "horizontal_irradiance": level.tolist(),
            "sky_irradiance": np.maximum(level - from_sun, 0.0).tolist(),
            "sun_direction_world": None if sun is None else sun.direction_world.tolist(),
            "sun_irradiance": None if sun is None else sun.irradiance.tolist(),
        }
