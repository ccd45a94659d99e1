"""Measures stage: scores that need no ground truth."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from lightsim.build.measures import MeasureConfig, measure, write_measures
from lightsim.build.stages.context import Context
from lightsim.build.workspace import Workspace


def make_measures(
    work: Workspace, config: MeasureConfig, folder: Path, context: Context
) -> Iterable[str]:
    """Write measures.json."""
    write_measures(folder, measure(work, config, context.progress))
    return ()
