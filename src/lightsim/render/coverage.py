"""How much of each pixel an actor covers: soft edges for what is put into a picture."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
from jaxtyping import Float, Float32

from lightsim.core.buffers import GBuffers
from lightsim.core.camera import PinholeCamera
from lightsim.core.sensors import CameraFrame
from lightsim.render.scene import FrameScene

_SIDE = 4
"""Rays along each side of a pixel at an edge: steps of 1/16 do not show in 8 bits of noise."""
_STEPS = (np.arange(_SIDE) + 0.5) / _SIDE
_GRID = np.stack(np.meshgrid(_STEPS, _STEPS), axis=-1).reshape(-1, 2)


def actor_coverage(
    scene: FrameScene,
    frame: CameraFrame,
    camera: PinholeCamera,
    buffers: GBuffers,
    numbers: Collection[int],
    offsets: Float[np.ndarray, "n 2"] = _GRID,
) -> Float32[np.ndarray, "h w"]:
    """Fraction of each pixel that shows one of these actors, by their numbers in the scenario.

    Pixels around the outline at pixel centres are looked at by a ray at each of the offsets from
    their corner, by default 16; what lies between the centres of all pixels is not found.
    """
    from scipy.ndimage import binary_dilation

    is_shown = np.isin(buffers.actor_index, list(numbers))
    around = np.ones((3, 3), dtype=bool)
    # Every pixel with a neighbour that differs.
    is_edge = np.logical_and(*(binary_dilation(part, around) for part in (is_shown, ~is_shown)))
    coverage = is_shown.astype(np.float32)
    rows, columns = np.nonzero(is_edge)
    if not len(rows):
        return coverage
    uv = np.stack([columns, rows], axis=-1)[:, None] + offsets
    hits = scene.camera_caster.intersect(*frame.pixel_rays(camera, uv.reshape(-1, 2)))
    shown = np.full(len(hits.mesh_index), -1, dtype=np.int32)
    shown[hits.is_hit] = scene.actor_index[hits.mesh_index[hits.is_hit]]
    is_actor = np.isin(shown, list(numbers)).reshape(len(rows), -1)
    coverage[rows, columns] = is_actor.mean(axis=1, dtype=np.float32)
    return coverage
