"""Results: SCENARIO.json, the command line of the state, and a simulation with its progress."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import threading
from typing import TYPE_CHECKING

from lightsim.app.session import command_line, scenario_of
from lightsim.app.widgets import notify, on_user_event
from lightsim.errors import InputError
from lightsim.store.artefact import write_text
from lightsim.store.names import is_harmless

if TYPE_CHECKING:
    from pathlib import Path

    from lightsim.app.state import ViewState
    from lightsim.app.viewer_base import ViewerBase

THIS_FRAME, THIS_CAMERA, ALL = "this frame", "this camera", "all cameras and frames"
# Lines of progress, as `lightsim.progress.LineProgress` writes them.
_PROGRESS = re.compile(r"\s*([\w ]+): (\d+)/(\d+),")
# Characters of an error of a command that are shown.
_SHOWN = 400
# Exit code of a command after SIGTERM or Ctrl-C.
_INTERRUPTED = 130


class OutputPanel:
    """The tab "Output"."""

    def __init__(self, viewer: ViewerBase) -> None:
        self._viewer = viewer
        self._process: subprocess.Popen[str] | None = None
        gui, icon = viewer.server.gui, viewer.icon
        self._name = gui.add_text("Name", viewer.name)
        self._part = gui.add_dropdown("Frames", (THIS_FRAME, THIS_CAMERA, ALL))
        self._save = gui.add_button("Save SCENARIO.json", icon=icon.DEVICE_FLOPPY)
        self._run = gui.add_button("Simulate", icon=icon.MOVIE)
        self._stop = gui.add_button("Stop", icon=icon.PLAYER_STOP, visible=False)
        self._progress = gui.add_progress_bar(0.0, visible=False)
        self._result = gui.add_markdown("")
        self._command = gui.add_text("Command", "", multiline=True, hint="Select and copy")
        on_user_event(self._name, lambda _: self.show(viewer.state))
        on_user_event(self._part, lambda _: self.show(viewer.state))
        on_user_event(self._save, lambda _: self._saved())
        on_user_event(self._run, lambda _: self._simulate())
        on_user_event(self._stop, lambda _: self._stopped())

    def show(self, state: ViewState) -> None:
        """Show the command line of a state."""
        self._command.value = self._line(state)

    def close(self) -> None:
        """Stop a running simulation, and wait for its end."""
        process = self._process
        self._stopped()
        if process is not None:
            process.wait()

    def _line(self, state: ViewState) -> str:
        work, name = self._viewer.workspace.root, self._name.value
        return command_line(work, self._path(), state, name, *self._further(state))

    def _further(self, state: ViewState) -> list[str]:
        """Return the options that select the frames."""
        if self._part.value == ALL:
            return []
        further = ["--cameras", state.camera]
        if self._part.value == THIS_FRAME:
            number = int(state.stem)
            further += ["--frames", f"{number}:{number + 1}"]
        return further

    def _path(self) -> Path:
        return self._viewer.folder / f"{self._name.value}.json"

    def _saved(self) -> Path:
        """Write the scenario of the present state and return its path, in WORK/view."""
        name = self._name.value
        if not is_harmless(name):
            raise InputError(
                "the name is not a valid file name",
                where="Name",
                got=repr(name[:40]),
                expected="letters, digits and . _ -, a letter or digit first",
            )
        path = self._path()
        path.parent.mkdir(parents=True, exist_ok=True)
        scenario = scenario_of(self._viewer.state, name)
        write_text(path, json.dumps(scenario, indent=2) + "\n")
        self._result.content = f"Saved `{path}`"
        return path

    def _simulate(self) -> None:
        """Start `lightsim simulate` on the saved state, in a separate process."""
        if self._process is not None:
            raise InputError("a simulation is running", remedy="Wait for it, or stop it.")
        state, name = self._viewer.state, self._name.value
        words = [sys.executable, "-m", "lightsim", "simulate", str(self._viewer.workspace.root)]
        words += [str(self._saved()), "--name", name, "--overwrite", *self._further(state)]
        words += [f"--exposure-ev={state.exposure_ev!r}"]
        self._process = subprocess.Popen(
            words, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
        )
        self._run.disabled = self._stop.visible = self._progress.visible = True
        self._progress.value = 0.0
        threading.Thread(target=self._watch, args=(self._process, name), daemon=True).start()

    def _stopped(self) -> None:
        if self._process is not None:
            self._process.terminate()

    def _watch(self, process: subprocess.Popen[str], name: str) -> None:
        """Show the progress of a simulation and, at its end, the way to its result."""
        last = ""
        assert process.stderr is not None
        for line in process.stderr:
            match = _PROGRESS.match(line)
            if match is not None:
                self._progress.value = 100.0 * int(match[2]) / max(1, int(match[3]))
                self._result.content = f"{match[1].strip()}: {match[2]} of {match[3]}"
            elif line.strip():
                last = line.strip()
        code = process.wait()
        self._process = None
        self._run.disabled = self._stop.visible = self._progress.visible = False
        if code == 0:
            folder = self._viewer.workspace.root / "scenarios" / name
            link = f"/scenarios/{name}/report.html"
            self._result.content = f"[Open the result]({link})  \n`{folder}`"
        elif code < 0 or code == _INTERRUPTED:
            self._result.content = "The simulation was stopped."
        else:
            self._result.content = f"The simulation ended with code {code}."
            notify(self._viewer.server, last[:_SHOWN], "Simulation")
