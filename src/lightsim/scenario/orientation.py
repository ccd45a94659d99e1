"""Up axis and front of CAD models: from options, else from their shape."""

from __future__ import annotations

from typing import Literal

import numpy as np
from jaxtyping import Float64, Int32, Int64

from lightsim.core.actors import ActorKind
from lightsim.scenario.kinds import is_plausible, named_kinds
from lightsim.scenario.wheels import part_of_vertex, wheels_among

Up = Literal["auto", "x", "y", "z", "-x", "-y", "-z"]
"""Axis of the file that points up, -z for one whose z points down; `auto` decides by wheels and by
how the model rests on the ground, and takes y, the axis of glTF, without evidence for another."""
Front = Literal["auto", "+x", "-x", "+y", "-y", "+z", "-z"]
"""Axis of the file that points ahead. glTF has +z, but many models lie along x: `auto` takes the
longer horizontal side as the length and its lower end, the bonnet, as the front."""
DEFAULT_UP: Up = "y"
# Axes whose ground is searched for wheels; the first one with wheels counts.
_BY_WHEELS: tuple[Up, ...] = ("y", "z", "x", "-y", "-z", "-x")
_AXES = "xyz"
# The thresholds below were chosen on the CAD models of the tests; sensitivity not measured.

# Extent of the front or rear end, as a fraction of the length.
_END = 0.1
# Difference of the ends' heights that is significant, as a fraction of the height.
_EVEN = 0.02
# Length to which a model of unknown unit is scaled to find its connected parts, in metres.
_TYPICAL_M = 5.0
# Largest difference between the widths of a round outline, as a fraction of the width.
_ROUND = 0.04
# Height within which downward faces touch the ground, as a fraction of the model's height.
_LOWEST = 0.01
# Vertical component of the normal of downward faces, at most.
_DOWN = -0.95
# Least fraction of the footprint that touches the ground for a model that rests on it (a base
# plate).
_RESTS = 0.5
# Largest such fraction for a model that does not (the edge of that plate).
_FLOATS = 0.1
# A side is no ground if the opposite one is flat by this fraction too, as are the sides of trucks.
_BOTH_SIDES = 0.5
# Fraction of the surface without a mirror image, at most, for two equal halves.
_MIRRORED = 0.05
# Fraction of the surface without a mirror image, at least, for two different halves.
_UNLIKE = 0.15
# Cells along each side of the grids that compare outlines and halves.
_BINS = 64
# Least ratio of width to height of a car, if only the sides indicate the up axis.
_LIKE_CAR = 1.1
# Vehicles that are wider than high; trucks and buses are often higher than wide.
_LOW_KINDS = frozenset((ActorKind.CAR, ActorKind.PICKUP))
# Vehicles whose cabin is ahead of the middle.
_CAB_AHEAD = frozenset((ActorKind.PICKUP, ActorKind.TRUCK, ActorKind.TRAILER))
# Height from which a surface belongs to the cabin, as a fraction of the height.
_CABIN = 0.75
# Distance of the cabin from the middle that is significant, as a fraction of the length.
_OFF_MIDDLE = 0.02


def find_up(
    vertices: Float64[np.ndarray, "n 3"],
    faces: Int32[np.ndarray, "m 3"],
    name: str,
    scale: float | None,
    ahead: str,
    *,
    is_stated: bool,
) -> tuple[Up, str]:
    """Return the up axis of a model, and the evidence if it is not y.

    Args:
        vertices, faces: all triangles, in axes and units of the file.
        name: of the file.
        scale: metres per unit; None if unknown.
        ahead: axis of the front, which is not up; empty if unknown.
        is_stated: the format's standard states the axis: then only wheels and a size that the name
            excludes are evidence against it.
    """
    extent = np.ptp(vertices, axis=0)
    part = part_of_vertex(vertices * (_TYPICAL_M / extent.max()), faces)
    for up in _BY_WHEELS:
        if up[-1] != ahead and _has_wheels(vertices, part, up):
            return up, "" if up == DEFAULT_UP else "its wheels are on the ground then"
    if ahead == "z":
        return DEFAULT_UP, ""
    if scale is not None:
        for kind in named_kinds(name):
            sizes = {up: extent[list(_horizontal(up)) + [_AXES.index(up)]] * scale for up in _AXES}
            if not is_plausible(kind, sizes[DEFAULT_UP]) and is_plausible(kind, sizes["z"]):
                return "z", f"a {kind} has no other size"
    if not is_stated and _is_car_on_its_side(extent, name, scale):
        return "z", "a car is wider than high"
    evidence = "" if is_stated else _shape_evidence(vertices, faces)
    return ("z", evidence) if evidence else (DEFAULT_UP, "")


def _is_car_on_its_side(extent: Float64[np.ndarray, "3"], name: str, scale: float | None) -> bool:
    """Return whether a model with a car's name is higher than wide for y up, but not for z up."""
    kinds = named_kinds(name)
    if not kinds or kinds[0] not in _LOW_KINDS:
        return False
    if scale is not None and not is_plausible(kinds[0], extent * scale):
        return False
    x, y, z = extent.tolist()
    return y > min(x, z) and min(x, y) >= _LIKE_CAR * z


def find_front(vertices: Float64[np.ndarray, "n 3"], up: Up, name: str = "") -> tuple[Front, str]:
    """Return the axis of the file that points ahead, and the evidence if it is only the cabin.

    The bonnet of cars, pickups and trucks is lower than their other end. If both ends are equally
    high, the cabin of a car is nearer to the rear; other models point along the positive axis.

    Args:
        name: of the file; pickups and trucks have their cabin ahead of the middle.
    """
    low, extent = vertices.min(axis=0), np.ptp(vertices, axis=0)
    first, second = _horizontal(up)
    along = first if extent[first] >= extent[second] else second
    height = vertices[:, _AXES.index(up[-1])] * _sign(up)
    part = (vertices[:, along] - low[along]) / max(extent[along], np.finfo(float).tiny)
    ends = [height[is_end].max() for is_end in (part <= _END, part >= 1 - _END)]
    is_negative, evidence = ends[0] < ends[1] - _EVEN * np.ptp(height), ""
    is_even = abs(ends[0] - ends[1]) <= _EVEN * np.ptp(height)
    if is_even and extent[along] > np.ptp(height) and _CAB_AHEAD.isdisjoint(named_kinds(name)):
        cabin = part[height >= height.min() + _CABIN * np.ptp(height)]
        if (cabin.min() + cabin.max()) / 2 > 0.5 + _OFF_MIDDLE:
            is_negative, evidence = True, "the cabin is nearer to the other end"
    front: Front = f"{'-' if is_negative else '+'}{_AXES[along]}"  # type: ignore[assignment]
    return front, evidence


def turned(
    vertices: Float64[np.ndarray, "n 3"], up: Up, front: Front
) -> Float64[np.ndarray, "n 3"]:
    """Return points of the file in axes of frame `actor`: x ahead, y left, z up.

    Coordinates are permuted and negated, so that equal points stay equal.

    Args:
        front: a horizontal axis; not checked here.
    """
    ahead, above = _AXES.index(front[1]), _AXES.index(up[-1])
    sign, up_sign = _sign(front), _sign(up)
    left = 3 - ahead - above
    # left = up x ahead: the sign is positive for cyclic (up, ahead, left).
    left_sign = sign * up_sign * (1.0 if (ahead - above) % 3 == 1 else -1.0)
    x, y = vertices[:, ahead] * sign, vertices[:, left] * left_sign
    return np.stack([x, y, vertices[:, above] * up_sign], axis=1)


def is_horizontal(front: Front, up: Up) -> bool:
    """Return whether a front is horizontal."""
    return front[1] != up[-1]


def _sign(direction: str) -> float:
    return -1.0 if direction.startswith("-") else 1.0


def _horizontal(up: str) -> tuple[int, int]:
    first, second = (n for n, axis in enumerate(_AXES) if axis != up[-1])
    return first, second


def _has_wheels(
    vertices: Float64[np.ndarray, "n 3"], part: Int64[np.ndarray, " n"], up: Up
) -> bool:
    """Return whether there are wheels on the ground with this axis up, along any horizontal
    axis."""
    for axis in _horizontal(up):
        front: Front = f"+{_AXES[axis]}"  # type: ignore[assignment]
        points = turned(vertices, up, front)
        middle = (points.min(axis=0) + points.max(axis=0)) / 2
        if wheels_among(points - middle, part):
            return True
    return False


def _shape_evidence(vertices: Float64[np.ndarray, "n 3"], faces: Int32[np.ndarray, "m 3"]) -> str:
    """Return why z is up rather than y, which a format does not state; empty without evidence."""
    points = vertices - vertices.min(axis=0)
    points = points / points.max()
    extent = points.max(axis=0)
    if extent.min() < _LOWEST:
        return ""
    round_axes = [axis for axis in range(3) if _is_round(points, axis)]
    if round_axes == [2] and extent[2] >= extent[:2].max():
        return "it is round about z"
    corners = points[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2
    area = np.linalg.norm(normal, axis=1)
    on_y, _ = _contacts(corners, normal, area, 1)
    on_z, above_z = _contacts(corners, normal, area, 2)
    if on_y <= _FLOATS and on_z >= _RESTS and above_z <= _BOTH_SIDES * on_z:
        return "it rests on a flat base then"
    across_y, across_z = _mirror_error(corners, area, 1), _mirror_error(corners, area, 2)
    is_like_car = extent[0] > extent[1] >= _LIKE_CAR * extent[2]
    if is_like_car and across_y <= _MIRRORED and across_z >= _UNLIKE:
        return "its sides mirror each other then"
    return ""


def _is_round(points: Float64[np.ndarray, "n 3"], axis: int) -> bool:
    """Return whether the outline along an axis has the same width in four directions."""
    u, v = (points[:, n] for n in range(3) if n != axis)
    half = np.sqrt(0.5)
    widths = [np.ptp(values) for values in (u, v, (u + v) * half, (u - v) * half)]
    return bool(np.ptp(widths) <= _ROUND * max(widths))


def _contacts(
    corners: Float64[np.ndarray, "m 3 3"],
    normal: Float64[np.ndarray, "m 3"],
    area: Float64[np.ndarray, " m"],
    axis: int,
) -> tuple[float, float]:
    """Return the area of the faces that rest on the ground, and of those that would upside down,
    as fractions of the footprint."""
    height = corners[:, :, axis]
    footprint = np.prod([np.ptp(corners[:, :, n]) for n in range(3) if n != axis])
    slope = normal[:, axis] / np.where(area > 0, area, 1.0)
    is_low = (height <= _LOWEST * height.max()).all(axis=1) & (slope <= _DOWN)
    is_high = (height >= (1 - _LOWEST) * height.max()).all(axis=1) & (slope >= -_DOWN)
    return float(area[is_low].sum() / footprint), float(area[is_high].sum() / footprint)


def _mirror_error(
    corners: Float64[np.ndarray, "m 3 3"], area: Float64[np.ndarray, " m"], axis: int
) -> float:
    """Return the fraction of the surface without a mirror image across the middle of an axis."""
    middle = corners[:, :, axis].mean(axis=1) / corners[:, :, axis].max()
    share = np.histogram(middle, _BINS, (0.0, 1.0), weights=area)[0] / max(area.sum(), 1e-30)
    return float(np.abs(share - share[::-1]).sum() / 2)
