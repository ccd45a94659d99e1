"""Panes of glass in facades: upright rectangles that look darker than the wall around them, and
from which beams do not come back.

Glass sends back little of what falls on it: beams go through or are reflected away, and a camera
sees a dim room and the sky's reflection. Both are told against the wall around, which needs no
camera gain and no exposure. Shadows and tree tops are as dark, but no upright rectangles, and
beams come back from them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float16, Float32, Float64

from lightsim.core.buildings import Wall, WallPart
from lightsim.core.camera import PinholeCamera
from lightsim.core.casting import RayCaster
from lightsim.core.colour import linear_from_srgb8, luminance
from lightsim.core.sensors import CameraFrame
from lightsim.geometry.completion.silhouettes import spaced_views
from lightsim.geometry.completion.walls import returns_near, surface_offset_m

# Chosen while looking at the streets of seeds 0 and 77; benchmarks/panes.py says how many panes
# are found.

# Cells in which panes are told: a pixel of a camera that stands across the street.
_CELL_M = 0.125
# Surface this far before and behind a wall's plane lies on it.
_FRONT_M, _BEHIND_M = 0.5, 0.7
# Walls have no panes above what was measured or shown of them, but for this.
_ABOVE_M = 3.0
# Holes up to this wide are part of the wall.
_HOLE_M = 1.5
# Views: how far apart, how far away, and the least cosine to the wall's normal.
_BASELINE_M, _MAX_VIEW_M, _LEAST_COSINE = 0.7, 40.0, 0.15
# Fewer views are no evidence.
_LEAST_VIEWS = 2
# Half the width of the wall around, with which a cell is compared.
_AROUND_M = 1.5
# Half the width and height over which beams that came back are counted: along the wall and up,
# where their density changes quickly.
_BEAMS_M = (2.0, 0.25)
_LEAST_RETURNS = 0.2
# Of the returns of the wall around: what panes' bars and edges give still; more speaks for wall.
_USUAL = 0.7
_DARKEST = 2e-3
# Most that brightness (log) and missing returns (fraction) say of one cell.
_DARK, _MISSING = (-1.0, 1.5), (-1.0, 1.0)
# Evidence from which on a cell is glass rather than wall, half way between what they show; and by
# which it must differ across each side of a pane, as a fraction of the pane's own.
_BETWEEN, _LEAST_STEP = 0.45, 0.4
# Strips on both sides of an edge that are compared, in cells, and the part that must be known.
_STRIP, _LEAST_KNOWN = 2, 0.6
# Panes' least and greatest width and height.
_WIDTHS_M, _HEIGHTS_M = (0.5, 4.0), (0.75, 3.0)
_ROUNDS = 4
# Returns that tell how deep a pane lies in its frame, and between which depths.
_LEAST_ON_FRAME, _RECESS_M = 8, (0.03, 0.35)
# Percentile of these returns: rectangles may hold some of the wall, too.
_DEEPEST = 25


@dataclass(frozen=True)
class Pane(WallPart):
    """A rectangle of glass in a wall.

    Args:
        wall_m, out_m: of the wall around and of the glass before the wall's plane.
    """

    wall_m: float
    out_m: float


@dataclass(frozen=True, eq=False)
class _Facade:
    """Cells [s, z] of a wall.

    Args:
        offset_m: of the surface before the plane; NaN where there is none.
        evidence: for glass; 0 where nothing is known.
        is_known: whether views or beams tell.
    """

    wall: Wall
    offset_m: Float64[np.ndarray, "s z"]
    evidence: Float64[np.ndarray, "s z"]
    is_known: Bool[np.ndarray, "s z"]


def find_glass(
    walls: Sequence[Wall],
    frames: Callable[[], Iterable[tuple[CameraFrame, PinholeCamera]]],
    returns_world: Float32[np.ndarray, "n 3"],
    caster: RayCaster,
) -> list[Pane]:
    """Panes of all walls.

    Args:
        walls: planes, frame world.
        frames: with their cameras, any number of times.
        returns_world: of LiDAR beams, from what stands still.
        caster: over everything that stands still, walls closed.
    """
    offsets = [_offsets(wall, caster) for wall in walls]
    looks = _look(walls, offsets, frames(), caster)
    panes: list[Pane] = []
    for wall, offset, look in zip(walls, offsets, looks, strict=True):
        out, place = _on_wall(wall, returns_world)
        dark, is_shown = _darkness(look, offset)
        missing, is_met = _missing(offset, place)
        evidence = np.where(is_shown, dark, 0.0) + np.where(is_met, missing, 0.0)
        is_known = (is_shown | is_met) & _is_closed(offset)
        facade = _Facade(wall, offset, np.where(is_known, evidence, 0.0), is_known)
        panes += [pane for pane in _panes(facade, out, place) if not _is_among(pane, panes)]
    return panes


def _is_among(pane: Pane, others: Sequence[Pane]) -> bool:
    """Whether a pane's middle lies in one of another wall: planes may lie close together."""
    middle = pane.middle()
    return any(other.holds(middle, 0.0, _BEHIND_M) for other in others)


def _offsets(wall: Wall, caster: RayCaster) -> Float64[np.ndarray, "s z"]:
    """How far before the plane each cell's surface lies; NaN where there is none."""
    size = wall.span_m[1] - wall.span_m[0], wall.height_m[1] + _ABOVE_M - wall.height_m[0]
    shape = tuple(max(int(np.ceil(length / _CELL_M)), 1) for length in size)
    return surface_offset_m(wall, *wall.grid(_CELL_M, shape), caster, (_FRONT_M, _BEHIND_M))


def _look(
    walls: Sequence[Wall],
    offsets: Sequence[Float64[np.ndarray, "_ _"]],
    frames: Iterable[tuple[CameraFrame, PinholeCamera]],
    caster: RayCaster,
) -> list[list[Float16[np.ndarray, "_ _"]]]:
    """Of each wall, log luminance of its cells against the wall around in each view; NaN where the
    view does not show them."""
    looks: list[list[Float16[np.ndarray, "_ _"]]] = [[] for _ in walls]
    points = [_surface(wall, offset) for wall, offset in zip(walls, offsets, strict=True)]
    for frame, camera in spaced_views(frames, _BASELINE_M):
        image = np.log(luminance(linear_from_srgb8(frame.load_srgb8())) + _DARKEST)
        for wall, place, look in zip(walls, points, looks, strict=True):
            seen = _seen(wall, place, (frame, camera), image, caster)
            if np.isfinite(seen).any():
                look.append((seen - _mean_around(seen, _AROUND_M)).astype(np.float16))
    return looks


def _surface(wall: Wall, offset_m: Float64[np.ndarray, "s z"]) -> Float64[np.ndarray, "s z 3"]:
    """Middle of each cell as far before the plane as its surface, or as most of the wall."""
    out = np.where(np.isfinite(offset_m), offset_m, _typical(offset_m))
    return wall.at(*wall.grid(_CELL_M, offset_m.shape)) + out[..., None] * wall.normal


def _seen(
    wall: Wall,
    place: Float64[np.ndarray, "s z 3"],
    view: tuple[CameraFrame, PinholeCamera],
    image: Float32[np.ndarray, "h w"],
    caster: RayCaster,
) -> Float64[np.ndarray, "s z"]:
    """What an image has at the cells that it shows; NaN elsewhere."""
    frame, camera = view
    eye = frame.world_from_camera.translation_m
    seen = np.full(place.shape[:2], np.nan)
    way = place.reshape(-1, 3) - eye
    distance = np.linalg.norm(way, axis=1)
    is_near = (distance < _MAX_VIEW_M) & (-(way @ wall.normal) > _LEAST_COSINE * distance)
    rows = np.flatnonzero(is_near)
    uv, is_inside = frame.project(camera, place.reshape(-1, 3)[rows])
    rows, uv = rows[is_inside], uv[is_inside].astype(np.int64)
    if len(rows) == 0:
        return seen
    rays = way[rows] / distance[rows, None]
    hits = caster.intersect(np.broadcast_to(eye, rays.shape).copy(), rays)
    is_shown = ~(hits.distance_m < distance[rows] - _FRONT_M)
    seen.reshape(-1)[rows[is_shown]] = image[uv[is_shown, 1], uv[is_shown, 0]]
    return seen


def _typical(offset_m: Float64[np.ndarray, "s z"]) -> float:
    return float(np.nanmedian(offset_m)) if np.isfinite(offset_m).any() else 0.0


def _mean_around(values: Float64[np.ndarray, "s z"], reach_m: float) -> Float64[np.ndarray, "s z"]:
    from scipy.ndimage import uniform_filter

    size = 2 * round(reach_m / _CELL_M) + 1
    is_known = np.isfinite(values)
    total = np.asarray(uniform_filter(np.where(is_known, values, 0.0), size))
    return total / np.maximum(uniform_filter(is_known.astype(np.float64), size), 1e-6)


def _darkness(
    look: Sequence[Float16[np.ndarray, "s z"]], offset_m: Float64[np.ndarray, "s z"]
) -> tuple[Float64[np.ndarray, "s z"], Bool[np.ndarray, "s z"]]:
    """How much darker than the wall around each cell looks in the middle of its views (log), and
    where enough views show it."""
    dark, is_shown = np.zeros(offset_m.shape), np.zeros(offset_m.shape, dtype=bool)
    if not look:
        return dark, is_shown
    views = np.stack(look)
    is_shown = np.isfinite(views).sum(axis=0) >= _LEAST_VIEWS
    dark[is_shown] = -np.nanmedian(views[:, is_shown].astype(np.float32), axis=0)
    return np.clip(dark, *_DARK), is_shown


def _on_wall(
    wall: Wall, returns_world: Float32[np.ndarray, "n 3"]
) -> tuple[Float64[np.ndarray, " m"], Float64[np.ndarray, "m 2"]]:
    """Of the returns near a wall's plane: how far before it, and their place in cells."""
    near = returns_near(wall, returns_world, (_FRONT_M, _BEHIND_M))
    s, out = wall.place(near)
    place = np.stack([s - wall.span_m[0], near[:, 2] - wall.height_m[0]], axis=1) / _CELL_M
    return out, place


def _missing(
    offset_m: Float64[np.ndarray, "s z"], place: Float64[np.ndarray, "m 2"]
) -> tuple[Float64[np.ndarray, "s z"], Bool[np.ndarray, "s z"]]:
    """Fraction of the returns that the wall around gives and a cell does not, and where the wall
    around gives any, above and below."""
    from scipy.ndimage import gaussian_filter, minimum_filter, uniform_filter1d

    cell = np.floor(place).astype(np.int64)
    is_inside = ((cell >= 0) & (cell < offset_m.shape)).all(axis=1)
    count = np.zeros(offset_m.shape)
    np.add.at(count, tuple(cell[is_inside].T), 1.0)
    size = [2 * round(reach / _CELL_M) + 1 for reach in _BEAMS_M]
    around = uniform_filter1d(uniform_filter1d(count, size[0], axis=0), size[1], axis=1)
    own = np.asarray(gaussian_filter(count, 0.7))
    missing = _USUAL - own / np.maximum(around, _LEAST_RETURNS)
    # Above the highest beam nothing is missing.
    is_met = np.asarray(minimum_filter(around, (1, size[1]))) > _LEAST_RETURNS
    return np.clip(missing, *_MISSING), is_met


def _is_closed(offset_m: Float64[np.ndarray, "s z"]) -> Bool[np.ndarray, "s z"]:
    """Cells with surface, and holes between them."""
    from scipy.ndimage import binary_closing

    reach = round(_HOLE_M / _CELL_M)
    is_on = np.pad(np.isfinite(offset_m), reach)
    closed = np.asarray(binary_closing(is_on, np.ones((reach + 1, reach + 1), dtype=bool)))
    return closed[reach:-reach, reach:-reach]


def _panes(
    facade: _Facade, out_m: Float64[np.ndarray, " m"], place: Float64[np.ndarray, "m 2"]
) -> list[Pane]:
    """The most evident rectangles first; none overlap."""
    boxes = find_rectangles(facade.evidence, facade.is_known)
    level = [_level_m(facade.offset_m, box) for box in boxes]
    recess = np.array(
        [_recess_m(out_m, place, box, around) for box, around in zip(boxes, level, strict=True)]
    )
    # Panes of one wall lie equally deep: what beams tell of some holds for the others.
    usual = float(np.nanmedian(recess)) if np.isfinite(recess).any() else _RECESS_M[0]
    depth = np.where(np.isfinite(recess), recess, usual)
    wall = facade.wall
    panes: list[Pane] = []
    for (i, j, width, height), around, deep in zip(boxes, level, depth.tolist(), strict=True):
        s, z = wall.span_m[0] + i * _CELL_M, wall.height_m[0] + j * _CELL_M
        span, rise = (s, s + width * _CELL_M), (z, z + height * _CELL_M)
        panes.append(Pane(wall, span, rise, around, around - deep))
    return panes


def find_rectangles(
    evidence: Float64[np.ndarray, "s z"], is_known: Bool[np.ndarray, "s z"]
) -> list[tuple[int, int, int, int]]:
    """Rectangles (first s, first z, width, height; cells) in which the evidence for glass sums up
    to most, greatest sums first, and which differ from what lies beyond each of their sides."""
    from lightsim.geometry.completion.glass_kernels import best_rectangles

    sizes = [[max(1, round(m / _CELL_M)) for m in limits] for limits in (_WIDTHS_M, _HEIGHTS_M)]
    found: list[tuple[int, int, int, int]] = []
    is_free = np.ones(evidence.shape, dtype=bool)
    for _ in range(_ROUNDS):
        score, size = best_rectangles(
            np.pad(np.where(is_known, evidence, 0.0), _STRIP),
            np.pad(is_known, _STRIP),
            np.pad(is_free, _STRIP),
            (*sizes[0], *sizes[1]),
            (_BETWEEN, _LEAST_STEP, _STRIP, _LEAST_KNOWN),
        )
        order = np.argsort(-score, axis=None, kind="stable")
        order = order[score.reshape(-1)[order] > 0]
        for i, j in zip(*np.unravel_index(order, score.shape), strict=True):
            width, height = size[i, j].tolist()
            # Padding moves the numbers of cells.
            own = slice(i - _STRIP, i - _STRIP + width), slice(j - _STRIP, j - _STRIP + height)
            if is_free[own].all():
                is_free[own] = False
                found.append((int(i) - _STRIP, int(j) - _STRIP, width, height))
        if len(order) == 0:
            break
    return found


def _level_m(offset_m: Float64[np.ndarray, "s z"], box: tuple[int, int, int, int]) -> float:
    """Of the wall around a rectangle, before the plane."""
    i, j, width, height = box
    outer = (
        slice(max(i - _STRIP, 0), i + width + _STRIP),
        slice(max(j - _STRIP, 0), j + height + _STRIP),
    )
    ring = offset_m.copy()
    ring[i : i + width, j : j + height] = np.nan
    values = ring[outer]
    return float(np.nanmedian(values)) if np.isfinite(values).any() else _typical(offset_m)


def _recess_m(
    out_m: Float64[np.ndarray, " m"],
    place: Float64[np.ndarray, "m 2"],
    box: tuple[int, int, int, int],
    level_m: float,
) -> float:
    """How far behind the wall around it a pane and its bars lie; NaN where no beams tell."""
    low, size = np.array(box[:2]), np.array(box[2:])
    is_inside = ((place > low + 1) & (place < low + size - 1)).all(axis=1)
    is_inside &= np.abs(out_m - level_m) < _RECESS_M[1]
    if is_inside.sum() < _LEAST_ON_FRAME:
        return np.nan
    return float(np.clip(level_m - np.percentile(out_m[is_inside], _DEEPEST), *_RECESS_M))
