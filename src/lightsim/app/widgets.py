"""Helpers for viser's controls: reactions to users, names of drags, errors as notifications."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import Any

from lightsim.errors import LightSimError

_LOGGER = logging.getLogger(__name__)
# Pause after which the next change of a control is a new entry of the history, in seconds.
_PAUSE_S = 1.0
# Time for which a notification is shown, in seconds. Chosen.
_NOTIFIED_S = 8.0


class Drags:
    """Names continuous changes of controls: changes without a pause are one drag."""

    def __init__(self) -> None:
        self._last: tuple[str, float] = ("", 0.0)
        self._number = 0

    def name(self, control: str) -> str:
        """Return the name of the drag to which a change of a control belongs."""
        now = time.monotonic()
        control_before, time_s = self._last
        if control_before != control or now - time_s > _PAUSE_S:
            return self.new(control)
        self._last = control, now
        return f"{control} {self._number}"

    def new(self, control: str) -> str:
        """Return the name of a drag that begins now."""
        self._number += 1
        self._last = control, time.monotonic()
        return f"{control} {self._number}"


def on_user_event(handle: Any, act: Callable[[Any], object]) -> None:
    """Call `act` with viser's event when a user, not the program, changes a control or clicks it.

    Calls come in the order of the events, in viser's event loop: `act` must return quickly. Errors
    of LightSim are shown to the user.
    """

    async def react(event: Any) -> None:
        if event.client is None:
            return
        try:
            act(event)
        except LightSimError as error:
            notify(event.client, str(error))

    names = ("on_upload", "on_click", "on_update")
    subscribe = next(getattr(handle, name) for name in names if hasattr(handle, name))
    subscribe(react)


def within(slider: Any) -> Any:
    """Return the value of a slider within its limits, which its text field does not enforce."""
    return min(max(slider.value, slider.min), slider.max)


def notify(client: Any, text: str, title: str = "Not possible") -> None:
    """Show a text to the user of one client, or of all clients of a server."""
    clients = client.get_clients().values() if hasattr(client, "get_clients") else (client,)
    for one in clients:
        one.add_notification(title, text, color="red", auto_close_seconds=_NOTIFIED_S)
    _LOGGER.info("%s: %s", title.lower(), text)
