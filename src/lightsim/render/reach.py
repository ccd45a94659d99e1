"""Where shadows of actors may fall that come or go, by their boxes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float32

from lightsim.core.buffers import GBuffers
from lightsim.core.scenario import ActorPlacement

_SHADOW_ERROR_M = 0.5
"""Meshes reach this far out of their boxes, and shadows that pictures show beyond those of the
meshes, at most."""
_STEP_PX = 4
"""One pixel in this many, along rows and columns, is asked, and stands for its neighbours."""


def may_be_shaded(
    buffers: GBuffers,
    placements: Sequence[ActorPlacement],
    time_ns: int,
    sun_direction: Float32[np.ndarray, "3"],
) -> Bool[np.ndarray, "h w"]:
    """Surfaces in actors' boxes, or between which and the sun such a box stands."""
    coarse = buffers.part((slice(None, None, _STEP_PX), slice(None, None, _STEP_PX)))
    has_surface = coarse.has_surface
    points = coarse.position_world[has_surface]
    is_met = np.zeros(len(points), dtype=bool)
    for placement in placements:
        is_met |= _meets_box(points, sun_direction, placement, time_ns)
    shaded = np.zeros(has_surface.shape, dtype=bool)
    shaded[has_surface] = is_met
    return brought_up(shaded, _STEP_PX, buffers.depth_z_m.shape)


def brought_up(
    coarse: Bool[np.ndarray, "_ _"], step_px: int, shape: tuple[int, ...]
) -> Bool[np.ndarray, "h w"]:
    """A mask of blocks of pixels, and the blocks beside, as pixels."""
    from scipy.ndimage import binary_dilation

    grown = np.asarray(binary_dilation(coarse, np.ones((3, 3), dtype=bool)), dtype=bool)
    fine = grown.repeat(step_px, axis=0).repeat(step_px, axis=1)
    # Blocks at the lower and right border may have no pixel that was asked.
    missing = [(0, max(0, wanted - there)) for wanted, there in zip(shape, fine.shape, strict=True)]
    return np.pad(fine, missing, mode="edge")[: shape[0], : shape[1]]


def _meets_box(
    points: Float32[np.ndarray, "n 3"],
    direction: Float32[np.ndarray, "3"],
    placement: ActorPlacement,
    time_ns: int,
) -> Bool[np.ndarray, " n"]:
    """Whether rays from the points meet an actor's box, grown by the error (slab test)."""
    pose = placement.world_from_actor(time_ns)
    axes = pose.rotation.astype(np.float32)
    origins = (points - pose.translation_m.astype(np.float32)) @ axes
    along = direction @ axes
    along = np.where(np.abs(along) < 1e-6, np.float32(1e-6), along)
    half = (placement.track.size_lwh_m / 2 + _SHADOW_ERROR_M).astype(np.float32)
    # Centre and half length of the way through each pair of sides.
    middle, reach = origins / -along, half / np.abs(along)
    entry = (middle - reach).max(axis=1)
    return (middle + reach).min(axis=1) >= np.maximum(entry, 0.0)
