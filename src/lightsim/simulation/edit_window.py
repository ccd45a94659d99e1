"""Window of a picture that edits may change; only this part of an edited frame is traced."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32

from lightsim.core.outline import nearest_of
from lightsim.core.scenario import ActorPlacement
from lightsim.core.window import Window, window_around
from lightsim.relighting.physical.edited import EditedImage
from lightsim.relighting.physical.filters import box_mean
from lightsim.render.frame_renderer import TransportFrame
from lightsim.render.reach import enlarged_mask, may_be_shaded
from lightsim.render.transport.sky import EnvironmentCells

# Distance from an actor's outline, in metres, within which pixels may change, because reconstructed
# meshes are too small.
_OUTLINE_M = 0.25
# Radius of the filters of edited pixels, as a fraction of the picture's width: uncovered background
# takes the colours of its surroundings (`relighting.physical.edited`).
_FILTER_WIDTH = 24 / 960
# Corners of windows are multiples of this number of pixels, so that blockwise tracing and filtering
# use the same blocks as in the whole picture.
_BLOCK_PX = 64
# Edge, in pixels, of the blocks in which the change of light is evaluated at one pixel.
_PROBE_PX = 8
# Radius, in blocks, of the mean over probes.
_PROBE_RADIUS = 2
# Smallest visible mean change of log light: half of the limit in `relighting.physical.edited`.
_MIN_CHANGE = 0.01
# Light in scene units that is added before logarithms: darker changes are not visible.
_DARKEST = np.float32(1e-3)


@dataclass(frozen=True, eq=False)
class EditWindow:
    """Window of a picture that edits may change.

    Args:
        window: rows and columns.
        is_reached: pixels of the window whose surface or light may change.
    """

    window: Window
    is_reached: Bool[np.ndarray, "h w"]


def edit_window(
    views: tuple[TransportFrame, TransportFrame],
    changed: tuple[tuple[ActorPlacement, ...], tuple[ActorPlacement, ...]],
    numbers: tuple[list[int], list[int]],
    is_covered: Bool[np.ndarray, "h w"],
    sky: EnvironmentCells,
) -> EditWindow | None:
    """Return the window of a picture that edits may change; None if they change nothing.

    Args:
        views: the frame in the log and in the scenario.
        changed: removed and new actors.
        numbers: numbers of these actors in the views.
        is_covered: pixels that the blurred layer of new actors covers.
        sky: the source sky.
    """
    reached = _has_changed_light(views, sky) | is_covered
    sun = sky.sun if sky.sun is not None and sky.sun.direction_world[2] > 0 else None
    for view, shown in zip(views, numbers, strict=True):
        buffers, (frame, camera) = view.geometry, view.view
        reached |= _is_near_actors(
            np.isin(buffers.actor_index, shown), buffers.depth_z_m, camera.fx
        )
        # Shadows of removed and of new actors may fall outside the actors' own pixels.
        if sun is not None:
            towards = sun.direction_world.astype(np.float32)
            reached |= may_be_shaded(buffers, changed[0] + changed[1], frame.time_ns, towards)
    if not reached.any():
        return None
    # The margin provides the filters at the window's border with the pixels that they read.
    around = window_around(reached, round(_FILTER_WIDTH * reached.shape[1]))
    rows, columns = (_in_blocks(s, size) for s, size in zip(around, reached.shape, strict=True))
    return EditWindow((rows, columns), reached[rows, columns])


def _in_blocks(span: slice, size: int) -> slice:
    return slice(
        span.start - span.start % _BLOCK_PX, min(size, -(-span.stop // _BLOCK_PX) * _BLOCK_PX)
    )


def _has_changed_light(
    views: tuple[TransportFrame, TransportFrame], sky: EnvironmentCells
) -> Bool[np.ndarray, "h w"]:
    """Return the pixels whose light changes, estimated from one pixel per block with one diffuse
    bounce."""
    shape = views[0].geometry.depth_z_m.shape
    probes = (slice(_PROBE_PX // 2, None, _PROBE_PX),) * 2
    is_probe = np.zeros(shape, dtype=bool)
    is_probe[probes] = True
    everything = slice(0, shape[0]), slice(0, shape[1])
    # One bounce without reflections is sufficient to detect a change of light.
    lit = [view.part(everything, is_probe).diffuse_once().light(sky) for view in views]
    before, after = (np.log(light.shaded[probes] + _DARKEST) for light in lit)
    change = np.abs(after - before).max(axis=-1)
    return enlarged_mask(box_mean(change, _PROBE_RADIUS) > _MIN_CHANGE, _PROBE_PX, shape)


def _is_near_actors(
    is_shown: Bool[np.ndarray, "h w"], depth_z_m: Float32[np.ndarray, "h w"], focal_px: float
) -> Bool[np.ndarray, "h w"]:
    """Return the pixels of actors, of their uncertain outlines, and within the filter radius."""
    from scipy.ndimage import distance_transform_edt

    if not is_shown.any():
        return is_shown
    distance_px, nearest = nearest_of(is_shown)
    # Uncovered background takes its colours from a margin that grows with the size of the hole.
    inside_px = np.asarray(distance_transform_edt(is_shown)).max()
    margin_px = _FILTER_WIDTH * is_shown.shape[1] + inside_px
    return distance_px <= margin_px + focal_px * _OUTLINE_M / depth_z_m[nearest]


def with_window_replaced(recorded: EditedImage, made: EditedImage, window: Window) -> EditedImage:
    """Return the recorded picture with its window replaced."""
    arrays = {name: array.copy() for name, array in vars(recorded).items()}
    for name, array in arrays.items():
        array[window] = getattr(made, name)
    return EditedImage(**arrays)
