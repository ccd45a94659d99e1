"""Corrections of path, cameras and boxes."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from lightsim.align.build import align_log
from lightsim.align.config import AlignConfig
from lightsim.build.stages.context import Context
from lightsim.build.workspace import Workspace
from lightsim.store.alignment import write_alignment


def make_alignment(
    work: Workspace, config: AlignConfig, folder: Path, context: Context
) -> Iterable[str]:
    """Estimate corrections of path, boxes and cameras, without held-out frames and sweeps."""
    # Corrections are functions of time and of the camera, so that they apply to held-out frames,
    # too.
    alignment = align_log(
        work.recorded_training_log,
        config,
        rng=np.random.default_rng(context.seed),
        progress=context.progress,
    )
    write_alignment(folder, alignment)
    return alignment.notes
