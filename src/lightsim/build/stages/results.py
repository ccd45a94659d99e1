"""What a build says of itself: numbers first, then the page that shows them."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from lightsim.build.measures import MeasureConfig, measure, write_measures
from lightsim.build.report import ReportConfig, write_build_report
from lightsim.build.stages.context import Context
from lightsim.build.workspace import Workspace


def make_measures(
    work: Workspace, config: MeasureConfig, folder: Path, context: Context
) -> Iterable[str]:
    """measures.json: all that can be measured without ground truth."""
    write_measures(folder, measure(work, config, context.progress))
    return ()


def make_report(
    work: Workspace, config: ReportConfig, folder: Path, context: Context
) -> Iterable[str]:
    """index.html: the page of figures and numbers."""
    write_build_report(folder / "index.html", work, config)
    return ()
