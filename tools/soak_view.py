"""Run the viewer of a work folder under random input, without a browser, and print its memory.

python tools/soak_view.py WORK --minutes 3 --seed 0

Prints resident memory, number of changes and number of errors once a minute; exit code 1 after an
error. Nothing but WORK/view is written.
"""

from __future__ import annotations

import argparse
import asyncio
import logging
import random
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from lightsim.app.editing import remove_actor, restore_actor, set_ego_offset
from lightsim.app.paths import place_of
from lightsim.app.server import LOOPBACK, open_server, stop_server
from lightsim.app.start import first_state
from lightsim.app.viewer import Viewer
from lightsim.build.workspace import Workspace
from lightsim.core.sky_choice import SkyChoice
from lightsim.progress import SilentProgress

_PAUSES_S = (0.02, 0.1, 2.0)
"""Pauses between two changes: a drag, a fast user, a user who waits for the final picture."""
_MOVED_M = 3.0


class Errors(logging.Handler):
    """Counts logged errors and prints them."""

    def __init__(self) -> None:
        super().__init__(logging.ERROR)
        self.count = 0

    def emit(self, record: logging.LogRecord) -> None:
        """Count a record and print it."""
        self.count += 1
        print(self.format(record), flush=True)  # noqa: T201


class RandomUser:
    """Makes valid changes of a viewer's state.

    Args:
        viewer: what is changed.
        seed: of the choices.
    """

    def __init__(self, viewer: Viewer, seed: int) -> None:
        self._viewer, self._random = viewer, random.Random(seed)
        self._actors = [placement.track for placement in viewer.editor.recorded.placements]

    def act(self) -> None:
        """Make one change."""
        acts: tuple[Callable[[], None], ...] = (
            *(3 * (self._sky,)),
            *(2 * (self._edit,)),
            self._frame,
            self._exposure,
            self._viewer.undo,
            self._viewer.redo,
        )
        self._random.choice(acts)()

    def pause_s(self) -> float:
        """Return the time until the next change."""
        return self._random.choice(_PAUSES_S)

    def _sky(self) -> None:
        place = f"{self._random.uniform(0, 360):.1f},{self._random.uniform(1, 90):.1f}"
        skies = (
            SkyChoice(f"sun:{place}"),
            SkyChoice("source"),
            SkyChoice("source", sun_factor=self._random.uniform(0.0, 2.0)),
            SkyChoice("source", move_sun=place),
        )
        viewer = self._viewer
        sky = self._random.choice(skies)
        viewer.change(replace(viewer.state, sky=sky), viewer.drags.name("soak"))

    def _exposure(self) -> None:
        state = self._viewer.state
        self._viewer.change(replace(state, exposure_ev=self._random.uniform(-2.0, 2.0)))

    def _frame(self) -> None:
        frame = self._random.choice(self._viewer.workspace.log.frames)
        state = replace(self._viewer.state, camera=frame.camera_name, stem=frame.stem)
        self._viewer.change(state)

    def _edit(self) -> None:
        viewer, edits = self._viewer, self._viewer.state.edits
        track = self._random.choice(self._actors)
        here = place_of(track, viewer.time_ns())
        there = replace(here, x_m=here.x_m + self._random.uniform(-_MOVED_M, _MOVED_M), z_m=None)
        assets = viewer.editor.asset_names
        changed = self._random.choice(
            (
                lambda: remove_actor(edits, track.actor_id),
                lambda: restore_actor(edits, track.actor_id),
                lambda: viewer.editor.move(edits, track.actor_id, viewer.time_ns(), there),
                lambda: viewer.editor.insert(edits, self._random.choice(assets), there)[0],
                lambda: set_ego_offset(edits, (0.0, self._random.uniform(-1.0, 1.0), 0.0)),
                lambda: (),
            )
        )
        viewer.change(replace(viewer.state, edits=changed()))


def resident_mb() -> float:
    """Return the resident memory of this process, in megabytes."""
    status = Path("/proc/self/status").read_text()
    line = next(line for line in status.splitlines() if line.startswith("VmRSS:"))
    return int(line.split()[1]) / 1024


async def soak(user: RandomUser, minutes: float, errors: Errors) -> None:
    """Change the state for some minutes; in viser's event loop, as changes of users are."""
    start = reported = time.monotonic()
    count = 0
    while time.monotonic() - start < 60.0 * minutes:
        try:
            user.act()
        except Exception:  # an error is what is searched for; the next change follows
            logging.exception("a change failed")
        count += 1
        await asyncio.sleep(user.pause_s())
        if time.monotonic() - reported >= 60.0:
            reported = time.monotonic()
            passed = (reported - start) / 60.0
            line = f"{passed:.1f} min: {resident_mb():.0f} MB, {count} changes"
            print(f"{line}, {errors.count} errors", flush=True)  # noqa: T201


def main(words: Sequence[str] | None = None) -> int:
    """Run the viewer and return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("work", type=Path)
    parser.add_argument("--minutes", type=float, default=3.0)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(words)
    errors = Errors()
    logging.getLogger().addHandler(errors)
    workspace = Workspace(options.work)
    state, name = first_state(workspace, "", "")
    server = open_server(LOOPBACK[0], 0)
    viewer = Viewer(server, workspace, state, SilentProgress(), name=name)
    print(f"start: {resident_mb():.0f} MB", flush=True)  # noqa: T201
    running = soak(RandomUser(viewer, options.seed), options.minutes, errors)
    asyncio.run_coroutine_threadsafe(running, server.get_event_loop()).result()
    viewer.wait(60.0)
    print(f"end: {resident_mb():.0f} MB, {errors.count} errors", flush=True)  # noqa: T201
    viewer.close()
    stop_server(server)
    return 1 if errors.count else 0


if __name__ == "__main__":
    raise SystemExit(main())
