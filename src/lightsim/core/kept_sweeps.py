"""Cache of decoded LiDAR sweeps, because many stages of a build read all of them."""

from __future__ import annotations

from dataclasses import fields, replace
from functools import partial

import numpy as np

from lightsim.core.sensors import LazySweep, LidarSweep

MAX_BYTES = 512 << 20
"""Largest memory of the cache: a whole sequence of PandaSet (80 sweeps of 170,000 returns of 36
bytes) takes 490 MB."""


class KeptSweeps:
    """Cache with one form of each sweep, by its stem: the last one loaded, as recorded or aligned.

    Nothing is evicted when `max_bytes` are in use. Stages read all sweeps in order, so that any
    eviction would remove the sweep that is needed next.
    """

    def __init__(self, max_bytes: int = MAX_BYTES) -> None:
        self._bytes_left = max_bytes
        self._kept: dict[str, tuple[LazySweep, LidarSweep]] = {}

    def of(self, sweeps: tuple[LazySweep, ...]) -> tuple[LazySweep, ...]:
        """Return sweeps that are loaded once each, as long as the cache has space. Their arrays are
        read-only, because all callers receive the same arrays."""
        return tuple(replace(lazy, load=partial(self._load, lazy)) for lazy in sweeps)

    def _load(self, lazy: LazySweep) -> LidarSweep:
        # Compared by identity: the recorded and the aligned log have different lazy sweeps with
        # one stem. Only one form is stored, since stages use one log at a time.
        asked, sweep = self._kept.get(lazy.stem, (None, None))
        if sweep is not None and asked is lazy:
            return sweep
        loaded = lazy.load()
        _, former = self._kept.pop(lazy.stem, (None, None))
        self._bytes_left += 0 if former is None else _size(former)
        if _size(loaded) <= self._bytes_left:
            self._bytes_left -= _size(loaded)
            for array in _arrays(loaded):
                array.flags.writeable = False
            self._kept[lazy.stem] = lazy, loaded
        return loaded


def _arrays(sweep: LidarSweep) -> list[np.ndarray]:
    values = [getattr(sweep, field.name) for field in fields(sweep)]
    return [value for value in values if isinstance(value, np.ndarray)]


def _size(sweep: LidarSweep) -> int:
    return sum(array.nbytes for array in _arrays(sweep))
