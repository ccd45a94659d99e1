"""Region where shadows of added or removed actors may fall, from the actors' boxes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float32

from lightsim.core.buffers import GBuffers
from lightsim.core.scenario import ActorPlacement

# Margin around actors' boxes, in metres: upper bound on how far meshes exceed their boxes, and on
# how far observed shadows lie outside of those of the meshes. Sensitivity not measured.
_SHADOW_ERROR_M = 0.5
# One pixel in this many, along rows and columns, is tested and represents its block. Chosen for
# speed; blocks are grown by one, so that shadows narrower than a block are still found.
_STEP_PX = 4


def may_be_shaded(
    buffers: GBuffers,
    placements: Sequence[ActorPlacement],
    time_ns: int,
    sun_direction: Float32[np.ndarray, "3"],
) -> Bool[np.ndarray, "h w"]:
    """Return the surfaces in the actors' boxes, or with such a box between them and the sun."""
    coarse = buffers.part((slice(None, None, _STEP_PX), slice(None, None, _STEP_PX)))
    has_surface = coarse.has_surface
    points = coarse.position_world[has_surface]
    is_met = np.zeros(len(points), dtype=bool)
    for placement in placements:
        is_met |= _meets_box(points, sun_direction, placement, time_ns)
    shaded = np.zeros(has_surface.shape, dtype=bool)
    shaded[has_surface] = is_met
    return enlarged_mask(shaded, _STEP_PX, buffers.depth_z_m.shape)


def enlarged_mask(
    coarse: Bool[np.ndarray, "_ _"], step_px: int, shape: tuple[int, ...]
) -> Bool[np.ndarray, "h w"]:
    """Return the pixels of a mask of blocks, grown by one block on each side."""
    from scipy.ndimage import binary_dilation

    grown = np.asarray(binary_dilation(coarse, np.ones((3, 3), dtype=bool)), dtype=bool)
    fine = grown.repeat(step_px, axis=0).repeat(step_px, axis=1)
    # The pixel that represents a block may be outside the image at the lower and right border.
    missing = [(0, max(0, wanted - there)) for wanted, there in zip(shape, fine.shape, strict=True)]
    return np.pad(fine, missing, mode="edge")[: shape[0], : shape[1]]


def _meets_box(
    points: Float32[np.ndarray, "n 3"],
    direction: Float32[np.ndarray, "3"],
    placement: ActorPlacement,
    time_ns: int,
) -> Bool[np.ndarray, " n"]:
    """Return the rays from the points that meet an actor's box, grown by the error (slab test)."""
    pose = placement.world_from_actor(time_ns)
    axes = pose.rotation.astype(np.float32)
    origins = (points - pose.translation_m.astype(np.float32)) @ axes
    along = direction @ axes
    along = np.where(np.abs(along) < 1e-6, np.float32(1e-6), along)
    half = (placement.track.size_lwh_m / 2 + _SHADOW_ERROR_M).astype(np.float32)
    # Middle and half length of the ray's section between each pair of parallel sides.
    middle, reach = origins / -along, half / np.abs(along)
    entry = (middle - reach).max(axis=1)
    return (middle + reach).min(axis=1) >= np.maximum(entry, 0.0)
