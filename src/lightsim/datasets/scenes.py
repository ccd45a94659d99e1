"""Choice of one recording in a data set of many."""

from __future__ import annotations

from collections.abc import Collection

from lightsim.core.reading import LogReading
from lightsim.errors import InputError

# Number of names that a message lists.
_SHOWN = 6


def chosen_scene(names: Collection[str], reading: LogReading) -> str:
    """Return the recording that --scene names; without the option, the only one.

    Raises:
        InputError: there is no such recording, or there are several and none is named.
    """
    if reading.scene in names:
        return reading.scene
    if not reading.scene and len(names) == 1:
        return next(iter(names))
    shown = ", ".join(sorted(names)[:_SHOWN]) + (", ..." if len(names) > _SHOWN else "")
    raise InputError(
        "there is no such recording" if reading.scene else "SOURCE has many recordings",
        where=reading.source,
        got=f"--scene {reading.scene}" if reading.scene else f"{len(names)} recordings",
        expected=f"--scene with one of {len(names)}: {shown}",
    )
