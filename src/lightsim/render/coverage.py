"""Fraction of each pixel that an actor covers: soft edges for composited actors."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
from jaxtyping import Float, Float32

from lightsim.core.buffers import GBuffers
from lightsim.core.camera import PinholeCamera
from lightsim.core.sensors import CameraFrame
from lightsim.render.scene import FrameScene

# Sub-pixel positions of the rays at an edge, a regular grid of 4 x 4: coverage in steps of 1/16 is
# not visible in the noise of 8-bit images. Chosen so; sensitivity not measured.
_GRID = np.stack(np.meshgrid(*[(np.arange(4) + 0.5) / 4] * 2), axis=-1).reshape(-1, 2)


def actor_coverage(
    scene: FrameScene,
    frame: CameraFrame,
    camera: PinholeCamera,
    buffers: GBuffers,
    numbers: Collection[int],
    offsets: Float[np.ndarray, "n 2"] = _GRID,
) -> Float32[np.ndarray, "h w"]:
    """Return the fraction of each pixel that shows one of the given actors.

    Only pixels along the outline, as found at pixel centres, are sampled more finely. Parts of
    actors between the centres of all pixels are missed.

    Args:
        numbers: the actors' numbers in the scenario.
        offsets: positions of the rays within an edge pixel, from its corner; default: 16.
    """
    from scipy.ndimage import binary_dilation

    is_shown = np.isin(buffers.actor_index, list(numbers))
    around = np.ones((3, 3), dtype=bool)
    # Edge pixels have a neighbour of the other kind, in the actors or outside of them.
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
