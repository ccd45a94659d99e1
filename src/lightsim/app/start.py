"""Start of the viewer: work folder, scenario, server."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from lightsim.app.options import ViewOptions
from lightsim.app.page import write_page
from lightsim.app.server import LOOPBACK, open_server, ssh_line, stop_server
from lightsim.app.session import state_of
from lightsim.app.state import ViewState
from lightsim.app.viewer import Viewer
from lightsim.build.workspace import Workspace
from lightsim.errors import InputError
from lightsim.progress import Progress
from lightsim.scenario.edits import read_scenario_request
from lightsim.simulation.finished import finished_scenarios
from lightsim.store.lock import LOCK_NAME, locked
from lightsim.store.names import is_harmless
from lightsim.store.scenario import SCENARIO_NAME

if TYPE_CHECKING:
    import viser


def view(
    work: Path, options: ViewOptions, progress: Progress, print_line: Callable[[str], None]
) -> None:
    """Serve the viewer until the process is interrupted, or write the page of --export.

    Raises:
        ArtefactError: the twin has not been built, or a build is at work there.
        InputError: scenario, frame or folder do not exist, or the port is in use.
        MissingDependencyError: viser is not installed.
    """
    workspace = Workspace(work, is_stale_allowed=options.allow_stale)
    workspace.need("twin")
    # Builds and viewers exclude each other; simulations may run at the same time.
    with locked(work / LOCK_NAME, is_shared=True):
        state, name = first_state(workspace, options.scenario, options.frame)
        if options.export is not None:
            write_page(workspace, options.export, state.stem, progress)
            print_line(f"page: {options.export}")
            return
        server = open_server(options.host, options.port, work / "scenarios")
        try:
            _serve(server, workspace, state, name, options, progress, print_line)
        finally:
            stop_server(server)


def _serve(
    server: viser.ViserServer,
    workspace: Workspace,
    state: ViewState,
    name: str,
    options: ViewOptions,
    progress: Progress,
    print_line: Callable[[str], None],
) -> None:
    viewer = Viewer(server, workspace, state, progress, name=name, method=options.method)
    try:
        for line in address_lines(options.host, server.get_port()):
            print_line(line)
        threading.Event().wait()
    finally:
        viewer.close()


def scenario_file(work: Path, scenario: str) -> Path:
    """Return the SCENARIO.json of a file's path, or of a result: NAME, or NAME/SKY of several.

    Raises:
        InputError: there is neither.
    """
    results = work / "scenarios"
    for path in (Path(scenario), results / scenario / SCENARIO_NAME):
        if path.is_file():
            return path
    names = [folder.relative_to(results).as_posix() for folder in finished_scenarios(work)]
    raise InputError(
        "there is no such scenario",
        where=f"--scenario {scenario}",
        expected=", ".join(["a SCENARIO.json", *names]),
    )


def first_state(workspace: Workspace, scenario: str, stem: str) -> tuple[ViewState, str]:
    """Return the state that is shown first, and the name under which it is saved.

    Args:
        scenario: name of a result in WORK/scenarios, or file; empty: the recorded log.
        stem: of the frame; empty: the first one.

    Raises:
        InputError: scenario or frame do not exist.
    """
    log = workspace.log
    stem = stem or log.stems[0]
    there = {frame.camera_name for frame in log.frames if frame.stem == stem}
    found = [name for name in log.ahead_by_camera if name in there]
    if not found:
        raise InputError(
            "the log has no such frame",
            where=f"--frame {stem}",
            expected=f"{log.stems[0]} to {log.stems[-1]}",
        )
    if not scenario:
        return ViewState(found[0], stem), "edited"
    request = read_scenario_request(scenario_file(workspace.root, scenario))
    name = request.name if is_harmless(request.name) else "edited"
    return state_of(request, found[0], stem), name


def address_lines(host: str, port: int) -> list[str]:
    """Return the lines that print the address of the viewer."""
    shown = "127.0.0.1" if host in LOOPBACK else host
    lines = [f"viewer: http://{shown}:{port}   (Ctrl-C ends it)"]
    if host in LOOPBACK:
        lines.append(f"from another machine: {ssh_line(port)}   then the same address there")
    else:
        lines.append(f"everyone who reaches {host} can control it; safer: {ssh_line(port)}")
    return lines
