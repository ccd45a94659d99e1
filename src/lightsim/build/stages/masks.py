"""Sky mattes of training frames, and of held-out frames."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np

from lightsim.build.stages.context import Context
from lightsim.build.workspace import Workspace
from lightsim.core.sensors import CameraFrame
from lightsim.masks.sky import learn_sky, sky_mattes
from lightsim.store.images import write_png

# Both stages of a build need the sky of the same log.
_sky_of = lru_cache(maxsize=1)(learn_sky)


def make_masks(work: Workspace, _: None, folder: Path, context: Context) -> Iterable[str]:
    """Write a sky matte for every frame that is not held out."""
    _write_mattes(work, work.recorded_training_log.frames, folder, context)
    return ()


def make_held_out_masks(work: Workspace, _: None, folder: Path, context: Context) -> Iterable[str]:
    """Write sky mattes of held-out frames, which only measuring and relighting read.

    Their models of surfaces, colours and sky come from the other frames alone.
    """
    frames = tuple(f for f in work.recorded_log.frames if f.stem in work.held_out)
    _write_mattes(work, frames, folder, context)
    return ()


def _write_mattes(
    work: Workspace, frames: Sequence[CameraFrame], folder: Path, context: Context
) -> None:
    """Write mattes of frames; those of an interrupted run are reused."""

    def path_of(frame: CameraFrame) -> Path:
        return folder / frame.camera_name / f"{frame.stem}.png"

    for camera in work.recorded_log.cameras:
        (folder / camera).mkdir(exist_ok=True)
    wanted = [frame for frame in frames if not path_of(frame).exists()]
    if not wanted:
        return
    # Learned from the training log alone, also for held-out frames.
    sky = _sky_of(work.recorded_training_log)
    for frame, matte in sky_mattes(sky, wanted, context.progress):
        planes = np.stack([matte.expected, matte.likeliest], axis=-1)
        write_png(path_of(frame), np.round(planes * 255).astype(np.uint8))
