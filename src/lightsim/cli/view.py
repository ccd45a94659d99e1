"""`lightsim view`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from lightsim.cli.options import Verbose, say
from lightsim.core.checks import check_number
from lightsim.errors import InputError
from lightsim.progress import terminal_progress
from lightsim.relighting.methods import check_method

_LAST_PORT = 65535


@dataclass(frozen=True)
class View:
    """Show a twin in the browser: move the sun, edit actors, look through the cameras."""

    work: tyro.conf.Positional[Path]
    """Work folder of a finished build."""
    scenario: Annotated[str, tyro.conf.arg(metavar="NAME|FILE")] = ""
    """Scenario that is shown first: the name of a result in WORK/scenarios, or a SCENARIO.json."""
    export: Annotated[Path | None, tyro.conf.arg(metavar="PAGE.html")] = None
    """Write the scene as one page that opens without a server, and end."""
    frame: str = ""
    """File stem of the frame that is shown first; by default the first one."""
    method: str = "network"
    """Relighting method, as in lightsim relight."""
    port: int = 8080
    """Port of the web server; 0 chooses a free one."""
    host: str = "127.0.0.1"
    """Interface of the web server. By default only this machine can connect: other hosts let
    everyone on the network control the viewer."""
    allow_stale: bool = False
    """Continue although the recording has changed since the build."""
    verbose: Verbose = False

    def __post_init__(self) -> None:
        check_number("--port", self.port, 0, _LAST_PORT)
        check_method(self.method)
        if self.export is not None and self.scenario:
            raise InputError(
                "the page shows the recorded scene",
                where="--export",
                got=f"--scenario {self.scenario}",
                expected="--export without --scenario",
            )

    def run(self) -> None:
        """Write the page, or serve the viewer until Ctrl-C."""
        from lightsim.app.start import export, serve

        if self.export is not None:
            path = export(self.work, self.export, self.frame, terminal_progress(), self.allow_stale)
            say(f"page: {path}")
            return
        serve(self, terminal_progress(), say)
