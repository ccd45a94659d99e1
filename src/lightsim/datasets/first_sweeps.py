"""Checks on few sweeps for the whole log: scale of the intensities, and frame of the points."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float64

from lightsim.core.sensors import LidarSweep
from lightsim.datasets.recorded import PointsProvenance, RawSweep, RecordedSweep
from lightsim.errors import InputError

# Usual ranges of stored intensities: fractions, bytes, and 16 bits.
_RANGES = (1.0, 255.0, 65535.0)
# Distance from whole numbers above which intensities are fractions: division by 255 and back errs
# by less.
_FRACTION = 1e-4
# Largest fraction of negative intensities: no LiDAR has any. Files with other columns or another
# type of number, read as rows of float32, have a fifth and more.
_MOST_NEGATIVE = 0.02
# Least distance between the LiDAR's positions in two sweeps whose points are compared, in metres:
# the median point moves with the vehicle to 16 % over 13 m and 5 % over 18 m (PandaSet 002), and
# less well where streets end.
_FAR_M = 30.0
# Accepted movements of the median point along the LiDAR's, as a fraction of it. It is 0 if points
# are in the sensor's frame in place of the world's, and 2 in the reverse case.
_MOVES = (0.3, 1.7)


def full_scale(intensity: Float[np.ndarray, " n"], expected: float) -> float:
    """Return the intensity of the strongest return: `expected`, unless a sweep shows that the
    intensities have another range, 0 to 1, 255 or 65535.

    They are of a smaller one if none is above its limit, and of a larger one if most exceed
    `expected`: single returns of retro-reflectors may exceed it.
    """
    values = intensity[np.isfinite(intensity) & (intensity > 0)]
    most = float(values.max(initial=0.0))
    larger = [limit for limit in _RANGES if limit > expected and limit >= most]
    smaller = [limit for limit in _RANGES if most <= limit < expected]
    if len(values) and float(np.median(values)) > expected:
        return larger[0] if larger else most
    # Whole numbers may be few counts of a large range, as in darkness.
    is_smaller = bool(smaller) and bool((np.abs(values - np.rint(values)) > _FRACTION).any())
    return smaller[0] if is_smaller else expected


def scale_note(name: str, found: float, expected: float) -> tuple[str, ...]:
    """Return a note on intensities of another range; none if it is the expected one."""
    if found == expected:
        return ()
    return (f"{name}: intensities have the range 0 to {found:g}, not 0 to {expected:g}",)


def with_known_scale(
    sweeps_by_lidar: Mapping[str, tuple[RecordedSweep, ...]],
) -> tuple[dict[str, tuple[RecordedSweep, ...]], tuple[str, ...]]:
    """Return the sweeps with intensities of the range 0 to 1, which the first sweep of each LiDAR
    shows, and notes.

    Raises:
        InputError: the first sweep of a LiDAR is broken.
    """
    found: dict[str, tuple[RecordedSweep, ...]] = {}
    notes: tuple[str, ...] = ()
    for name, sweeps in sweeps_by_lidar.items():
        found[name] = sweeps
        if not sweeps or sweeps[0].provenance is PointsProvenance.GIVEN:
            continue
        first = sweeps[0].load()
        check_returns(first.intensity, sweeps[0].path)
        # Readers have divided by the data set's range already: bytes twice divided end at 1/255.
        stored = first.full_scale
        scale = full_scale(first.intensity * stored, stored)
        notes += scale_note(name, scale, stored)
        if scale != stored:
            factor = stored / scale
            found[name] = tuple(replace(s, load=partial(_scaled, s.load, factor)) for s in sweeps)
    return found, notes


def check_returns(intensity: Float[np.ndarray, " n"], path: Path) -> None:
    """Check that the numbers of a sweep are those of returns.

    Raises:
        InputError: many intensities are negative.
    """
    share = float((intensity < 0).mean()) if len(intensity) else 0.0
    if share > _MOST_NEGATIVE:
        raise InputError(
            "the numbers of the sweep are not those of returns",
            where=path,
            got=f"negative intensities in {share:.0%} of the rows",
            expected="the columns and the type of number of the data set",
            remedy="Write the file in the data set's own format: number of columns, and float32"
            " rather than float64.",
        )


def check_frame(first: LidarSweep, last: LidarSweep, where: Path) -> None:
    """Check that points of two sweeps are in frame `world`: the median point moves with the LiDAR.

    Raises:
        InputError: it stays where it is, or moves twice as far.
    """
    step = _median(last.origins_world) - _median(first.origins_world)
    distance_m = float(np.linalg.norm(step))
    if distance_m < _FAR_M:
        return
    moved = _median(last.points_world) - _median(first.points_world)
    ratio = float(moved @ step) / distance_m**2
    if not _MOVES[0] <= ratio <= _MOVES[1]:
        raise InputError(
            "the points do not move with the vehicle",
            where=where,
            got=f"the median point moves {ratio * distance_m:.1f} m along the {distance_m:.1f} m "
            "that the LiDAR moves between the first and the last sweep",
            expected="points in the frame that the data set has"
            + (", not in that of the sensor" if ratio < 1.0 else ", not in the world frame"),
            remedy="Write the points without that transform.",
        )


def _median(points: Float[np.ndarray, "n 3"]) -> Float64[np.ndarray, "2"]:
    return np.median(points[:, :2].astype(np.float64), axis=0)


def _scaled(load: Callable[[], RawSweep], factor: float) -> RawSweep:
    raw = load()
    return replace(raw, intensity=raw.intensity * factor)
