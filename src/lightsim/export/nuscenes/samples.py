"""Samples of nuScenes: the frames with annotations, two a second."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from lightsim.export.nuscenes.tables import Tables, link, microseconds
from lightsim.export.scenario_log import ScenarioLog

# Time between samples, in nanoseconds: annotations of nuScenes are at 2 Hz.
_STEP_NS = 500_000_000
# Factor on half of the interval between frames, for clocks that jitter. Chosen; sensitivity not
# measured.
_SLACK = 1.2


@dataclass(frozen=True, eq=False)
class Samples:
    """Samples of a log.

    Args:
        scene: name of the scene.
        key_stems: stems of the key frames, with the time of each sample: that of the sweep, as in
            nuScenes, or without one the median time of the pictures.
        tables: of the scene.
    """

    scene: str
    key_stems: dict[str, int]
    tables: Tables

    @classmethod
    def of(cls, log: ScenarioLog, scene: str, tables: Tables) -> Samples:
        """Return the samples of a log."""
        return cls(scene, _key_stems(log), tables)

    def is_key(self, stem: str) -> bool:
        """Return whether a frame is a sample."""
        return stem in self.key_stems

    def token_of(self, stem: str, time_ns: int) -> str:
        """Return the token of a frame's sample, for other frames that of the next sample.

        The devkit interpolates boxes between a sample and the one before it.
        """
        if stem in self.key_stems:
            return self._token(stem)
        later = [s for s, t in self.key_stems.items() if t >= time_ns]
        return self._token(later[0] if later else list(self.key_stems)[-1])

    def add_rows(self) -> None:
        """Add the samples to the tables."""
        scene_token = self.tables.token("scene")
        for stem, time_ns in self.key_stems.items():
            row = {"timestamp": microseconds(time_ns), "scene_token": scene_token}
            self.tables.add("sample", self._token(stem), row)
        link(self.tables.rows["sample"])

    def _token(self, stem: str) -> str:
        return self.tables.token("sample", stem)

    @cached_property
    def ends(self) -> tuple[str, str]:
        """Tokens of the first and the last sample."""
        stems = list(self.key_stems)
        return self._token(stems[0]), self._token(stems[-1])


def _key_stems(log: ScenarioLog) -> dict[str, int]:
    """Return the frames nearest to multiples of the step, with their times."""
    times = _times_ns(log)
    ordered = sorted(times, key=lambda stem: times[stem])
    # A frame farther than half of an interval from a multiple is not its nearest one.
    intervals = np.diff([times[stem] for stem in ordered])
    reach_ns = float(np.median(intervals)) / 2 * _SLACK if len(intervals) else 0.0
    nearest: dict[int, tuple[float, str]] = {}
    for stem in ordered:
        after_ns = times[stem] - times[ordered[0]]
        step = round(after_ns / _STEP_NS)
        gap_ns = abs(after_ns - step * _STEP_NS)
        if gap_ns <= reach_ns and gap_ns < nearest.get(step, (np.inf, ""))[0]:
            nearest[step] = gap_ns, stem
    return {stem: times[stem] for _, stem in nearest.values()}


def _times_ns(log: ScenarioLog) -> dict[str, int]:
    """Return the time of each frame with all sensors; of all frames if there is none."""
    shown: dict[str, list[int]] = {stem: [] for stem in log.log.stems}
    for frame in log.log.frames:
        shown[frame.stem].append(frame.time_ns)
    sweeps = log.sweep_by_stem
    # Loaders expect all sensors in a sample.
    count = len(log.log.cameras)
    whole = [s for s, t in shown.items() if len(t) == count and (not sweeps or s in sweeps)]
    return {
        stem: sweeps[stem].time_ns if stem in sweeps else int(np.median(shown[stem]))
        for stem in whole or shown
    }
