"""Measures stage: scores that need no ground truth."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from lightsim.build.measures import measure, write_measures
from lightsim.build.stages.context import Context
from lightsim.build.workspace import Workspace


def make_measures(work: Workspace, _: None, folder: Path, context: Context) -> Iterable[str]:
    """Write measures.json."""
    write_measures(folder, measure(work, context.progress))
    return ()
