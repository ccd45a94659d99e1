"""Numbers that a build measures without ground truth."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from lightsim.build.measures import MeasureConfig, measure, write_measures
from lightsim.build.stages.context import Context
from lightsim.build.workspace import Workspace


def make_measures(
    work: Workspace, config: MeasureConfig, folder: Path, context: Context
) -> Iterable[str]:
    """measures.json: all that can be measured without ground truth."""
    write_measures(folder, measure(work, config, context.progress))
    return ()
