"""Table of the detector's experiment: average precision by row, with intervals over streets and
seeds."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

import numpy as np
from jaxtyping import Bool, Float, Shaped

from lightsim.errors import InputError
from lightsim.store.arrays import load_arrays
from lightsim.store.artefact import read_json
from lightsim_lab.detect.boxes import IOU_THRESHOLDS, average_precision
from lightsim_lab.studies.detector_options import (
    ORACLE,
    RECORDED,
    ROWS,
    TEST_LIGHTS,
    DetectorTableOptions,
)

# Resamples of the bootstrap.
_DRAWS = 10_000
# Least number of test streets for intervals and p-values; with fewer they are too narrow.
_FEWEST_STREETS = 6
RANGES_M = ((0.0, 20.0), (20.0, 40.0), (40.0, 80.0))
"""Ranges of distance, in metres, by which average precision is also given."""


@dataclass(frozen=True, eq=False)
class Run:
    """Detections of one training on the test pictures, compared with the labels."""

    arrays: Mapping[str, Shaped[np.ndarray, "..."]]

    @property
    def streets(self) -> list[str]:
        """Names of the test streets."""
        return sorted({str(name) for name in self.arrays["street"]})

    @property
    def lights(self) -> list[str]:
        """Lights of the test pictures."""
        return [light for light in TEST_LIGHTS if light in self.arrays["light"]]

    @property
    def unseen(self) -> list[str]:
        """Target lights that no training picture has. If only recorded pictures were tested, as in
        the paper, their light."""
        return [light for light in self.lights if light != RECORDED] or [RECORDED]

    def pictures(
        self, lights: Sequence[str] = (), streets: Sequence[str] = ()
    ) -> Bool[np.ndarray, " p"]:
        """Return a mask of the pictures of some lights and streets; empty selects all."""
        is_light = np.isin(self.arrays["light"], list(lights)) if lights else True
        is_street = np.isin(self.arrays["street"], list(streets)) if streets else True
        return np.ones(len(self.arrays["light"]), bool) & is_light & is_street

    def precision(
        self, chosen: Bool[np.ndarray, " p"], range_m: tuple[float, float] = (0.0, np.inf)
    ) -> Float[np.ndarray, " t"]:
        """Return the average precision of some pictures at each of `IOU_THRESHOLDS`; NaN where
        they have no vehicle in the range."""
        a, (low, high) = self.arrays, range_m
        truth_m = a["truth_distance_m"]
        count = int((chosen[a["truth_picture"]] & (low <= truth_m) & (truth_m < high)).sum())
        found = []
        for k in range(len(IOU_THRESHOLDS)):
            own_m = a["distance_m"][:, k]
            use = chosen[a["picture"]] & a["is_counted"][:, k] & (low <= own_m) & (own_m < high)
            found.append(average_precision(a["scores"][use], a["is_true"][use, k], count))
        return np.array(found)


@dataclass(frozen=True)
class DetectorRow:
    """Figures of a row, in percent, means over seeds; differences are to the reference.

    Args:
        map_unseen: mean over IoU thresholds and test logs, under all lights but the recorded; under
            that one if no other was tested (PandaSet).
        ap: the same for each of `IOU_THRESHOLDS`.
        low, high: 95 % interval of the difference; NaN for fewer than six test streets.
        p_value: two-sided, adjusted for the number of rows (Holm 1979), likewise.
        oracle_fraction: part of the oracle's gain over the reference that the row reaches; NaN
            unless the oracle's interval is above 0.
        by_light, by_range: means over thresholds, of all streets together.
    """

    name: str
    seeds: int
    map_unseen: float
    ap: tuple[float, ...]
    difference: float
    low: float
    high: float
    p_value: float
    oracle_fraction: float
    by_light: dict[str, float]
    by_range: dict[str, float]


@dataclass(frozen=True)
class DetectorTable:
    """All rows with finished trainings."""

    reference: str
    streets: int
    rows: tuple[DetectorRow, ...]

    def to_table(self) -> str:
        """Return the table as Markdown."""
        lights, ranges = list(self.rows[0].by_light), list(self.rows[0].by_range)
        names = ["row", "seeds", "mAP", *(f"AP {t}" for t in IOU_THRESHOLDS),
                 f"to {self.reference}, 95 %", "p", "of oracle", *lights, *ranges]  # fmt: skip
        lines = ["| " + " | ".join(names) + " |", "|---" + "|---:" * (len(names) - 1) + "|"]
        for row in self.rows:
            figures = [row.map_unseen, *row.ap]
            span = "" if np.isnan(row.low) else f" [{row.low:+.1f}, {row.high:+.1f}]"
            p = "< .001" if row.p_value < 0.001 else _shown(row.p_value, 3)
            parts = [*row.by_light.values(), *row.by_range.values()]
            difference = "-" if np.isnan(row.difference) else f"{row.difference:+.1f}{span}"
            words = [row.name, str(row.seeds), *map(_shown, figures), difference, p,
                     _shown(row.oracle_fraction, 2), *map(_shown, parts)]  # fmt: skip
            lines.append("| " + " | ".join(words) + " |")
        lines.append("")
        tested = "all lights but the recorded one" if len(lights) > 1 else "the recorded lights"
        lines.append(f"{self.streets} test logs; mAP under {tested}.")
        return "\n".join(lines)

    def to_json(self) -> str:
        """Return the table as JSON; undefined figures are null."""
        return json.dumps(_known(asdict(self)), indent=2, allow_nan=False)


def _shown(value: float, digits: int = 1) -> str:
    return "-" if np.isnan(value) else f"{value:.{digits}f}"


def _known(value: object) -> object:
    """Replace NaN by None, as JSON has no NaN."""
    if isinstance(value, dict):
        return {key: _known(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_known(one) for one in value]
    return None if value != value else value


def detector_table(options: DetectorTableOptions) -> DetectorTable:
    """Return the table of all finished trainings.

    Raises:
        InputError: the reference has no finished training.
    """
    names = (name for name in ROWS if name in (*options.asked, options.reference))
    runs = {row: found for row in names if (found := read_runs(options, row))}
    if options.reference not in runs:
        raise InputError(
            "the reference has no finished training",
            where=options.results / "runs",
            got=", ".join(runs) or "no finished training",
            expected=options.reference,
            remedy="Run: lightsim evaluate detector run, with the same options.",
        )
    return make_table(runs, options.reference)


def read_runs(options: DetectorTableOptions, row: str) -> dict[int, Run]:
    """Return the finished trainings of a row by seed."""
    found = {}
    for path in sorted((options.results / "runs").glob(f"{row}-*/run.json")):
        record = read_json(path)
        if record["row"] == row and (not options.seeds or record["seed"] in options.seeds):
            found[int(record["seed"])] = Run(load_arrays(path.with_name("matches.npz")))
    return found


def make_table(runs: Mapping[str, Mapping[int, Run]], reference: str) -> DetectorTable:
    """Return the table of trainings by row and seed."""
    scores = {row: _by_street(own) for row, own in runs.items()}
    gains = {}
    for row in runs:
        seeds = [seed for seed in runs[row] if seed in runs[reference]]
        pairs = [scores[row][seed] - scores[reference][seed] for seed in seeds]
        gains[row] = np.stack(pairs).mean(axis=-1) if pairs else np.full((1, 1), np.nan)
    others = [row for row in runs if row != reference]
    unknown = (float("nan"),) * 3
    intervals = {reference: unknown} | {row: crossed_interval(gains[row]) for row in others}
    streets = next(iter(runs[reference].values())).streets
    if len(streets) < _FEWEST_STREETS:
        intervals = dict.fromkeys(runs, unknown)
    adjusted = dict(zip(others, holm([intervals[row][2] for row in others]), strict=True))
    has_bound = intervals.get(ORACLE, unknown)[0] > 0
    bound = _mean(gains[ORACLE]) if has_bound else float("nan")
    rows = []
    for row, own in runs.items():
        gain, (low, high, _) = _mean(gains[row]), intervals[row]
        ap = np.nanmean(np.stack(list(scores[row].values())), axis=(0, 1))
        rows.append(DetectorRow(
            row, len(own), float(ap.mean()), tuple(ap.tolist()), gain, low, high,
            adjusted.get(row, float("nan")), gain / bound,
            *_breakdown(list(own.values())),
        ))  # fmt: skip
    return DetectorTable(reference, len(streets), tuple(rows))


def _mean(gains: Float[np.ndarray, "seeds streets"]) -> float:
    """Return the mean of known values; NaN without a seed that the reference has, too."""
    return float("nan") if np.isnan(gains).all() else float(np.nanmean(gains))


def _by_street(runs: Mapping[int, Run]) -> dict[int, Float[np.ndarray, "s t"]]:
    """Return the average precision in percent of each street under the unseen lights, by seed."""
    return {
        seed: 100 * np.stack([run.precision(run.pictures(run.unseen, [s])) for s in run.streets])
        for seed, run in runs.items()
    }


def _breakdown(runs: Sequence[Run]) -> tuple[dict[str, float], dict[str, float]]:
    """Return means over seeds and thresholds in percent, by light and by range."""
    lights, unseen = runs[0].lights, runs[0].unseen

    def mean(lights: Sequence[str], range_m: tuple[float, float]) -> float:
        each = [run.precision(run.pictures(lights), range_m).mean() for run in runs]
        return 100 * float(np.mean(each))

    everywhere = (0.0, np.inf)
    by_range = {f"{low:.0f}-{high:.0f} m": mean(unseen, (low, high)) for low, high in RANGES_M}
    return {light: mean([light], everywhere) for light in lights}, by_range


def crossed_interval(
    differences: Float[np.ndarray, "seeds streets"],
) -> tuple[float, float, float]:
    """Return the 95 % interval of the mean and the two-sided p-value of paired differences.

    Every seed is tested on every street, so that both are resampled independently (pigeonhole
    bootstrap, Owen 2007, doi:10.1214/07-AOAS122). Streets without a vehicle are NaN and left out.
    """
    known = differences[:, ~np.isnan(differences).any(axis=0)]
    if not known.size:
        return float("nan"), float("nan"), float("nan")
    rng, (seeds, streets) = np.random.default_rng(0), known.shape
    i = rng.integers(seeds, size=(_DRAWS, seeds, 1))
    j = rng.integers(streets, size=(_DRAWS, 1, streets))
    means = known[i, j].mean(axis=(1, 2))
    low, high = np.percentile(means, [2.5, 97.5]).tolist()
    fewer = min((means <= 0).sum(), (means >= 0).sum())
    return low, high, min(1.0, 2 * (int(fewer) + 1) / (_DRAWS + 1))


def holm(p_values: Sequence[float]) -> list[float]:
    """Return p-values adjusted for their number (Holm 1979, jstor.org/stable/4615733); NaN stays
    and does not count."""
    values = np.array(p_values, dtype=np.float64)
    order = [k for k in np.argsort(values) if not np.isnan(values[k])]
    largest = 0.0
    for rank, k in enumerate(order):
        largest = max(largest, min(1.0, (len(order) - rank) * float(values[k])))
        values[k] = largest
    return values.tolist()
