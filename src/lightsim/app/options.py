"""Options of `lightsim view`, with their checks."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from lightsim.core.checks import check_number
from lightsim.errors import InputError
from lightsim.relighting.methods import check_method

# Largest port of TCP (RFC 9293).
_LAST_PORT = 65535


@dataclass(frozen=True, kw_only=True)
class ViewOptions:
    """Options of `lightsim view`."""

    scenario: str = ""
    """Scenario that is shown first: the name of a result in WORK/scenarios, or a SCENARIO.json."""
    frame: str = ""
    """File stem of the frame that is shown first; by default the first one."""
    export: Path | None = None
    """Write the recorded scene as one HTML page that opens without a server, and end."""
    method: str = "network"
    """Relighting method, as in lightsim relight."""
    port: int = 8080
    """Port of the web server; 0 chooses a free one."""
    host: str = "127.0.0.1"
    """Interface of the web server. By default only this machine can connect; on other interfaces
    everyone on the network can control the viewer."""
    allow_stale: bool = False
    """Continue although the recording has changed since the build."""

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
