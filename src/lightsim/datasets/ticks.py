"""Frames of cameras and LiDARs that are not synchronised."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Int64

# Largest distance of a picture from its frame, as a fraction of the time between frames: cameras
# fire one after another while a LiDAR turns.
_REACH = 0.6


def ticks_of(times_ns_by_camera: Mapping[str, Int64[np.ndarray, " n"]]) -> Int64[np.ndarray, " t"]:
    """Return the times of the frames: the picture times of the camera with most pictures. Where
    that camera lost a picture, times of other cameras' pictures fill the gap.

    If several cameras have most pictures, the one with the least distance in time to the others is
    used, because cameras expose one after another.
    """
    most = max(len(times_ns) for times_ns in times_ns_by_camera.values())
    candidates = [times_ns for times_ns in times_ns_by_camera.values() if len(times_ns) == most]
    others = np.concatenate(list(times_ns_by_camera.values()))
    distances = [np.abs(others - own[nearest(own, others)]).sum() for own in candidates]
    ticks = candidates[int(np.argmin(distances))]
    reach_ns = _REACH * period_ns(ticks)
    for times_ns in times_ns_by_camera.values():
        if len(times_ns):
            gaps = np.abs(times_ns - ticks[nearest(ticks, times_ns)])
            ticks = np.union1d(ticks, times_ns[gaps > reach_ns])
    return ticks


def period_ns(times_ns: Int64[np.ndarray, " n"]) -> float:
    """Return the median time between frames; 0.1 s for a single one."""
    return float(np.median(np.diff(times_ns))) if len(times_ns) > 1 else 1e8


def nearest(
    ticks_ns: Int64[np.ndarray, " t"], times_ns: Int64[np.ndarray, " n"]
) -> Int64[np.ndarray, " n"]:
    """Return the index of the tick nearest to each time; ticks increase."""
    after = np.clip(np.searchsorted(ticks_ns, times_ns), 1, max(1, len(ticks_ns) - 1))
    if len(ticks_ns) == 1:
        return np.zeros(len(times_ns), dtype=np.int64)
    before = after - 1
    is_after = ticks_ns[after] - times_ns < times_ns - ticks_ns[before]
    return np.where(is_after, after, before)


def assigned(
    ticks_ns: Int64[np.ndarray, " t"], times_ns: Int64[np.ndarray, " n"]
) -> dict[int, int]:
    """Return the index of the item nearest to each tick, by tick. An item is used at its nearest
    tick only; of two items at one tick the nearer one is used.

    Items that are about half a period away from every tick, as pictures of cameras that fire in
    turn, would fall onto the tick before or after by chance, two onto one and none onto another.
    Their median distance is therefore removed first, to the tick before or after, where that leaves
    more items in use.
    """
    ticks = nearest(ticks_ns, times_ns)
    if len(np.unique(ticks)) < min(len(ticks), len(ticks_ns)):
        period, middle_ns = period_ns(ticks_ns), np.median(times_ns - ticks_ns[ticks])
        for shift_ns in (middle_ns, middle_ns + period, middle_ns - period):
            shifted = nearest(ticks_ns, times_ns - int(shift_ns))
            is_near = abs(shift_ns) <= _REACH * period
            if is_near and len(np.unique(shifted)) > len(np.unique(ticks)):
                ticks = shifted
    found: dict[int, int] = {}
    for item, tick in enumerate(ticks.tolist()):
        other = found.get(tick)
        gap = abs(int(times_ns[item] - ticks_ns[tick]))
        if other is None or gap < abs(int(times_ns[other] - ticks_ns[tick])):
            found[tick] = item
    return found


def sweep_numbers(ticks_ns: Int64[np.ndarray, " t"], times_ns: Sequence[int]) -> list[int]:
    """Return a unique number for each sweep: the index of the nearest tick. Further sweeps at the
    same tick get numbers after the last frame."""
    times = np.array(times_ns, dtype=np.int64)
    item_by_tick = assigned(ticks_ns, times)
    number_by_item = {item: tick for tick, item in item_by_tick.items()}
    spare = iter(range(len(ticks_ns), len(ticks_ns) + len(times)))
    return [number_by_item[i] if i in number_by_item else next(spare) for i in range(len(times))]
