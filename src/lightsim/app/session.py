"""A session of the viewer: history of states, SCENARIO.json and the command line of a state."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lightsim.app.state import ViewState
from lightsim.core.sky_choice import SkyChoice
from lightsim.scenario.edits import VERSION, Insert, ScenarioRequest

# Number of states that a history keeps; a state is a few kilobytes. Chosen.
_MAX_STATES = 1000


@dataclass(frozen=True)
class History:
    """States of the viewer in the order of the changes, with undo and redo.

    Args:
        states: the states; never empty.
        position: index of the current state.
        drag: name of the drag that made the current state; empty for other changes.
    """

    states: tuple[ViewState, ...]
    position: int = 0
    drag: str = ""

    @classmethod
    def of(cls, state: ViewState) -> History:
        """Return the history of a new session."""
        return cls((state,))

    @property
    def current(self) -> ViewState:
        """The state that is shown."""
        return self.states[self.position]

    @property
    def can_undo(self) -> bool:
        """True if there is an earlier state."""
        return self.position > 0

    @property
    def can_redo(self) -> bool:
        """True if a state was undone and nothing was changed since."""
        return self.position + 1 < len(self.states)

    def changed(self, state: ViewState, drag: str = "") -> History:
        """Return the history with a new current state; undone states are dropped.

        Args:
            state: the new state; without a difference there is no new entry.
            drag: name of a continuous drag, a new one for each. Consecutive changes of one drag
                are one entry, so that one undo leads back to its start.
        """
        if state == self.current:
            return self
        is_continued = bool(drag) and drag == self.drag
        end = self.position + (0 if is_continued else 1)
        states = (*self.states[:end], state)[-_MAX_STATES:]
        return History(states, len(states) - 1, drag)

    def undo(self) -> History:
        """Return the history at the previous state; at the first state, itself."""
        return History(self.states, self.position - 1) if self.can_undo else self

    def redo(self) -> History:
        """Return the history at the state that was undone last; if there is none, itself."""
        return History(self.states, self.position + 1) if self.can_redo else self


def scenario_of(state: ViewState, name: str) -> dict[str, Any]:
    """Return the content of SCENARIO.json for a state."""
    sky = state.sky
    return {
        "version": VERSION,
        "name": name,
        "sky": sky.sky,
        "sky_yaw_deg": sky.yaw_deg,
        "sky_scale": sky.scale,
        "move_sun": sky.move_sun,
        "sun_factor": sky.sun_factor,
        "edits": [dict(edit) for edit in state.edits],
    }


def state_of(
    request: ScenarioRequest, camera: str, stem: str, exposure_ev: float = 0.0
) -> ViewState:
    """Return the state of a scenario that was read from a file.

    Every inserted actor has its `id` in the edits, because default ids depend on the order.
    """
    edits = tuple(
        {**spelt, "id": edit.actor_id} if isinstance(edit, Insert) else spelt
        for edit, spelt in zip(request.edits, request.spelt, strict=True)
    )
    return ViewState(camera, stem, request.sky, exposure_ev, edits)


def command_line(work: Path, scenario: Path, state: ViewState, name: str, *further: str) -> str:
    """Return the command, quoted for a shell, that makes the frames of a state.

    Args:
        work: the work folder.
        scenario: file with the content of `scenario_of`; used if there are edits.
        state: the state.
        name: name of the result.
        further: further options, for example "--frames", "2:3".
    """
    if state.edits:
        words = ["lightsim", "simulate", str(work), str(scenario), "--name", name]
    else:
        words = ["lightsim", "relight", str(work), *_sky_options(state.sky), "--name", name]
    if state.exposure_ev != 0.0:
        words += _option("--exposure-ev", _number(state.exposure_ev))
    return shlex.join([*words, *further])


def _sky_options(sky: SkyChoice) -> list[str]:
    """Return the options of a sky; settings only if they differ from their defaults."""
    plain = SkyChoice(sky.sky)
    words = _option("--sky", sky.sky)
    if sky.yaw_deg != plain.yaw_deg:
        words += _option("--sky-yaw-deg", _number(sky.yaw_deg))
    if sky.scale != plain.scale:
        words += _option("--sky-scale", sky.scale)
    if sky.move_sun != plain.move_sun:
        words += _option("--move-sun", sky.move_sun)
    if sky.sun_factor != plain.sun_factor:
        words += _option("--sun-factor", _number(sky.sun_factor))
    return words


def _option(name: str, value: str) -> list[str]:
    # A separate word that begins with - would be read as another option.
    return [f"{name}={value}"] if value.startswith("-") else [name, value]


def _number(value: float) -> str:
    """Return the shortest text that is read as the same number."""
    return repr(value).removesuffix(".0")
