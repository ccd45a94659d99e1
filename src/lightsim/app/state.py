"""State of the viewer: what is shown, under which sky, with which edits."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from lightsim.core.sky_choice import SkyChoice


@dataclass(frozen=True)
class ViewState:
    """Picture, sky and edits that the viewer shows; a change makes a new state.

    Args:
        camera: name of the camera whose picture is shown.
        stem: file stem of the shown frame.
        sky: the target sky.
        exposure_ev: exposure of the relit picture, in stops.
        edits: entries of `edits` in SCENARIO.json, in the order of application.
    """

    camera: str
    stem: str
    sky: SkyChoice = field(default_factory=lambda: SkyChoice("source"))
    exposure_ev: float = 0.0
    edits: tuple[Mapping[str, Any], ...] = ()
