"""Start of the viewer: work folder, scenario, server."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from lightsim.app.page import write_page
from lightsim.app.server import LOOPBACK, open_server, ssh_line, stop_server
from lightsim.app.session import state_of
from lightsim.app.state import ViewState
from lightsim.app.viewer import Viewer
from lightsim.build.workspace import Workspace
from lightsim.errors import InputError
from lightsim.progress import Progress
from lightsim.scenario.edits import read_scenario_request
from lightsim.store.lock import LOCK_NAME, locked
from lightsim.store.names import is_harmless


class ViewOptions(Protocol):
    """Options of `lightsim view` that concern the server."""

    work: Path
    scenario: str
    frame: str
    method: str
    port: int
    host: str
    allow_stale: bool


def export(work: Path, page: Path, stem: str, progress: Progress, allow_stale: bool) -> Path:
    """Write the scene at a frame as one page and return its path.

    Raises:
        ArtefactError: the twin has not been built.
        InputError: no such frame, or no such folder.
    """
    workspace = _opened(work, allow_stale)
    with locked(work / LOCK_NAME, is_shared=True):
        write_page(workspace, page, stem or workspace.log.stems[0], progress)
    return page


def serve(options: ViewOptions, progress: Progress, say: Callable[[str], None]) -> None:
    """Serve the viewer until the process is interrupted.

    Raises:
        ArtefactError: the twin has not been built, or a build is at work there.
        InputError: scenario or frame do not exist, or the port is in use.
    """
    workspace = _opened(options.work, options.allow_stale)
    # A build excludes viewers, and the reverse; simulations may run beside it.
    with locked(options.work / LOCK_NAME, is_shared=True):
        state, name = first_state(workspace, options.scenario, options.frame)
        server = open_server(options.host, options.port, options.work / "scenarios")
        try:
            viewer = Viewer(server, workspace, state, progress, name=name, method=options.method)
            for line in _greeting(options.host, server.get_port()):
                say(line)
            try:
                threading.Event().wait()
            finally:
                viewer.close()
        finally:
            stop_server(server)


def first_state(workspace: Workspace, scenario: str, stem: str) -> tuple[ViewState, str]:
    """Return the state that is shown first, and the name under which it is saved.

    Args:
        scenario: name of a result in WORK/scenarios, or file; empty: the recorded log.
        stem: of the frame; empty: the first one.

    Raises:
        InputError: scenario or frame do not exist.
    """
    log = workspace.log
    stem = stem or log.frames[0].stem
    found = [frame.camera_name for frame in log.frames if frame.stem == stem]
    if not found:
        raise InputError(
            "the log has no such frame",
            where=f"--frame {stem}",
            expected=f"{log.stems[0]} to {log.stems[-1]}",
        )
    if not scenario:
        return ViewState(found[0], stem), "edited"
    path = Path(scenario)
    if is_harmless(scenario) and not path.is_file():
        path = workspace.root / "scenarios" / scenario / "scenario.json"
    request = read_scenario_request(path)
    name = request.name if is_harmless(request.name) else "edited"
    return state_of(request, found[0], stem), name


def _opened(work: Path, allow_stale: bool) -> Workspace:
    workspace = Workspace(work, is_stale_allowed=allow_stale)
    workspace.need("twin")
    return workspace


def _greeting(host: str, port: int) -> list[str]:
    shown = "127.0.0.1" if host in LOOPBACK else host
    lines = [f"viewer: http://{shown}:{port}   (Ctrl-C ends it)"]
    if host in LOOPBACK:
        lines.append(f"from another machine: {ssh_line(port)}   then the same address there")
    else:
        lines.append(f"everyone who reaches {host} can control it; safer: {ssh_line(port)}")
    return lines
