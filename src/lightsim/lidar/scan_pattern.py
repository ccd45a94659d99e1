"""Directions of LiDAR beams without a return.

A log stores returns only. Actors that are added in front of the sky, and surfaces behind removed
actors, are met by beams that had no return; their directions follow from those of the returns.

A spinning LiDAR has lasers at fixed elevations (rings) that fire at equal steps of azimuth: gaps in
a ring are filled step by step. A forward-looking LiDAR repeats its raster from sweep to sweep, like
the PandarGT (returns of two sweeps of PandaSet's sequence 002 are 0.02 degrees apart, neighbours of
one sweep 0.09): its gaps are filled from other sweeps that had returns there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import KDTree

from lightsim.core.rows import Rows

# Fraction of the rings that begin before the estimated start of a sweep, and end after its end:
# single returns are early, and objects may hide the start of most rings. Chosen; sensitivity not
# measured.
_END = 0.1


@dataclass(frozen=True, eq=False)
class ScanDirections(Rows):
    """Directions of one LiDAR in one sweep.

    Args:
        azimuth_rad: counter-clockwise from ahead, frame `ego`.
        elevation_rad: above the horizontal plane of frame `ego`.
        times_ns: time of each measurement.
    """

    azimuth_rad: Float64[np.ndarray, " n"]
    elevation_rad: Float64[np.ndarray, " n"]
    times_ns: Int64[np.ndarray, " n"]

    @classmethod
    def of(
        cls, directions_ego: Float64[np.ndarray, "n 3"], times_ns: Int64[np.ndarray, " n"]
    ) -> ScanDirections:
        """Return directions from unit vectors in frame `ego`."""
        azimuth = np.arctan2(directions_ego[:, 1], directions_ego[:, 0])
        return cls(azimuth, np.arcsin(np.clip(directions_ego[:, 2], -1.0, 1.0)), times_ns)

    @property
    def vectors(self) -> Float64[np.ndarray, "n 3"]:
        """Unit vectors, frame `ego`."""
        flat = np.cos(self.elevation_rad)
        parts = (np.cos(self.azimuth_rad) * flat, np.sin(self.azimuth_rad) * flat)
        return np.stack([*parts, np.sin(self.elevation_rad)], axis=1)

    @property
    def is_spinning(self) -> bool:
        """True if the directions surround the sensor."""
        # A forward-looking LiDAR spans far less than 300 degrees. In bins of 5 degrees.
        used = np.histogram(self.azimuth_rad, 72, (-np.pi, np.pi))[0] > 0
        return bool(used.mean() * 2 * np.pi > np.radians(300.0))


def find_rings(sweeps: Sequence[ScanDirections]) -> Float64[np.ndarray, " k"]:
    """Return the elevations of the lasers of a spinning LiDAR, ascending, in radians.

    They are the peaks in the histogram of the returns of several sweeps.
    """
    from scipy.signal import find_peaks  # Takes a second to import.

    elevation = np.concatenate([s.elevation_rad for s in sweeps])
    bin_rad = np.radians(0.01)
    edges = np.arange(elevation.min() - 1e-3, elevation.max() + 1e-3, bin_rad)
    # Returns scatter by 0.03 degrees, 3 bins, about their ring if stored in steps of 4 mm.
    counts = gaussian_filter1d(np.histogram(elevation, edges)[0].astype(np.float64), 3)
    # A ring that points at the sky has few returns, so low peaks count (chosen, not measured). The
    # finest rings of the Pandar64 are 0.167 degrees apart: 8 bins are half of that.
    peaks = find_peaks(counts, prominence=0.02 * counts.max(), distance=8)[0]
    return edges[peaks] + bin_rad / 2


def missing_in_rings(found: ScanDirections, rings_rad: Float64[np.ndarray, " k"]) -> ScanDirections:
    """Return the directions in which a spinning LiDAR fired without a return.

    Azimuth advances by equal steps along a ring. Steps continue before a ring's first and after its
    last return to the ends of the sweep. A ring without returns gets the directions of the fullest
    ring. Without rings the result is empty.
    """
    if not len(rings_rad):
        return found.chosen(np.zeros(len(found.times_ns), dtype=bool))
    ring = np.argmin(np.abs(found.elevation_rad[:, None] - rings_rad), axis=1)
    # Steps of 4 mm rotate a beam of 1 m by 0.2 degrees; returns farther from a ring are outliers.
    is_near = np.abs(found.elevation_rad - rings_rad[ring]) < np.radians(0.5)
    turned = _turned(found)
    in_ring = [_in_order(found, turned, is_near & (ring == k)) for k in range(len(rings_rad))]
    steps = np.concatenate([np.diff(angle) for angle, _ in in_ring])
    # The median step is the firing step, since most returns have a neighbour. Steps of 0 are
    # returns of two lasers that were assigned to one ring.
    step = float(np.median(steps[steps > 0])) if (steps > 0).any() else np.inf
    returned = [angle for angle, _ in in_ring if len(angle)]
    ends = [
        float(np.quantile([angle[end] for angle in returned], part)) if returned else 0.0
        for end, part in ((0, _END), (-1, 1.0 - _END))
    ]
    gaps = [_gaps(fired, step, ends, turned.rate) for fired in in_ring]
    counts = [len(a[0]) + len(b[0]) for a, b in zip(in_ring, gaps, strict=True)]
    whole = int(np.argmax(counts))
    every = tuple(np.concatenate(both) for both in zip(in_ring[whole], gaps[whole], strict=True))
    gaps = [every if not len(fired[0]) else gap for fired, gap in zip(in_ring, gaps, strict=True)]
    elevation = [np.full(len(gap[0]), level) for gap, level in zip(gaps, rings_rad, strict=True)]
    return ScanDirections(
        turned.sign * np.concatenate([gap[0] for gap in gaps]),
        np.concatenate(elevation),
        np.concatenate([gap[1] for gap in gaps]),
    )


def missing_in_raster(found: ScanDirections, others: Sequence[ScanDirections]) -> ScanDirections:
    """Return the directions in which a forward-looking LiDAR fired without a return.

    They are directions of other sweeps with no return of this one within the raster's step.

    Args:
        others: of the same LiDAR in other sweeps, nearest in time first.
    """
    have = found.vectors
    nearest = KDTree(have).query(have, k=2, workers=1)[0][:, 1]
    # Returns of two sweeps nearer than 0.7 of the raster's step belong to one beam. Chosen;
    # sensitivity not measured.
    least = 0.7 * float(np.median(nearest))
    start_ns = int(found.times_ns.min())
    parts = [found.chosen(np.zeros(len(have), dtype=bool))]
    for other in others:
        is_new = KDTree(have).query(other.vectors, k=1, workers=1)[0] > least
        new = other.chosen(is_new)
        times_ns = new.times_ns - int(other.times_ns.min()) + start_ns
        parts.append(ScanDirections(new.azimuth_rad, new.elevation_rad, times_ns))
        have = np.concatenate([have, new.vectors])
    return ScanDirections.joined(parts)


_Fired = tuple[Float64[np.ndarray, " _"], Int64[np.ndarray, " _"]]
"""Rotation angles, ascending, and times."""


@dataclass(frozen=True, eq=False)
class _Turned:
    """Rotation angle of a spinning LiDAR at the measurement of each direction.

    Args:
        angle_rad: increasing beyond a full turn.
        rate: radians a nanosecond.
        sign: of the rotation, 1 counter-clockwise.
    """

    angle_rad: Float64[np.ndarray, " n"]
    rate: float
    sign: float


def _turned(found: ScanDirections) -> _Turned:
    """Return rotation angles: azimuths plus full turns from the times.

    Times may be stored in coarse steps, or as one value for the whole sweep.
    """
    order = np.argsort(found.times_ns, kind="stable")
    since_ns = (found.times_ns - found.times_ns[order[0]]).astype(np.float64)
    if not since_ns.any():
        return _Turned(found.azimuth_rad, np.inf, 1.0)
    in_time = np.unwrap(found.azimuth_rad[order])
    rate, start = np.polyfit(since_ns[order], in_time, 1).tolist()
    turns = np.rint((start + rate * since_ns - found.azimuth_rad) / (2 * np.pi))
    sign = float(np.sign(rate)) or 1.0
    return _Turned(sign * (found.azimuth_rad + 2 * np.pi * turns), abs(rate), sign)


def _in_order(found: ScanDirections, turned: _Turned, mask: Bool[np.ndarray, " n"]) -> _Fired:
    """Return the returns of one ring in the order of firing."""
    angle, times_ns = turned.angle_rad[mask], found.times_ns[mask]
    order = np.argsort(angle, kind="stable")
    return angle[order], times_ns[order]


def _gaps(fired: _Fired, step: float, ends: Sequence[float], rate: float) -> _Fired:
    """Return the firings of a ring without returns: in gaps, and to the sweep's start and end."""
    angle, times_ns = fired
    if not len(angle) or not np.isfinite(step):
        return np.empty(0), np.empty(0, dtype=np.int64)
    head = step * np.arange(max(0, round((angle[0] - ends[0]) / step)), 0, -1)
    tail = step * np.arange(1, 1 + max(0, round((ends[1] - angle[-1]) / step)))
    missing = np.maximum(np.rint(np.diff(angle) / step).astype(np.int64) - 1, 0)
    before = np.repeat(np.arange(len(missing)), missing)
    number = np.arange(len(before)) - np.repeat(np.cumsum(missing) - missing, missing) + 1
    fraction = number / (missing[before] + 1)
    # Nanoseconds since 1970 exceed a float's precision; their differences do not.
    passed = (fraction * np.diff(times_ns)[before]).astype(np.int64)
    return (
        np.concatenate(
            [angle[0] - head, angle[before] + fraction * np.diff(angle)[before], angle[-1] + tail]
        ),
        np.concatenate(
            [
                times_ns[0] - (head / rate).astype(np.int64),
                times_ns[before] + passed,
                times_ns[-1] + (tail / rate).astype(np.int64),
            ]
        ),
    )
