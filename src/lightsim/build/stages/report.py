"""Report stage."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from lightsim.build.report import ReportConfig, write_build_report
from lightsim.build.stages.context import Context
from lightsim.build.workspace import Workspace


def make_report(
    work: Workspace, config: ReportConfig, folder: Path, context: Context
) -> Iterable[str]:
    """Write the report page, index.html."""
    write_build_report(folder / "index.html", work, config)
    return ()
