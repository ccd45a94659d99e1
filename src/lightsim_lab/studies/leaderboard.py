"""Leaderboard of relighting methods over several streets.

It contains means by sky with standard errors over streets, differences from a reference method, and
computing costs.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lightsim.build.quality.frame_report import DIGITS, FrameRow, finite
from lightsim.build.quality.statistics import Samples, Spread, clustered_mean
from lightsim.errors import InputError
from lightsim.store.entries import Entries
from lightsim_lab.metrics.compare import ComparedRow, compare_samples, read_rows
from lightsim_lab.metrics.report import Cost

# Column of the mean over the pictures of all skies.
MEAN = "mean"
# Column of all skies without a separate column: the measured skies.
OTHER = "measured"
SCORES = ("psnr_db", "ssim", "lpips")
_NAMES = {"psnr_db": "PSNR dB", "ssim": "SSIM", "lpips": "LPIPS"}


@dataclass(frozen=True)
class Entry:
    """Scores of one method.

    Args:
        means: mean and error by sky and score, on pixels outside the sky (of an edit: where it
            changes the picture).
        against: differences from the reference by score; empty for the reference.
        cost: mean seconds and largest memory over the streets; None if not measured.
    """

    method: str
    means: Mapping[tuple[str, str], Spread]
    against: Mapping[str, ComparedRow]
    cost: Cost | None


@dataclass(frozen=True)
class Leaderboard:
    """Scores of all methods on the same streets; the reference is first.

    Args:
        notes: missing measurements and failures.
    """

    title: str
    streets: tuple[str, ...]
    conditions: tuple[str, ...]
    entries: tuple[Entry, ...]
    notes: tuple[str, ...] = ()

    def tables(self) -> list[tuple[str, list[str], list[list[str]]]]:
        """Return title, columns and lines of each table."""
        reference = self.entries[0].method
        difference = f"PSNR beside {reference}, 95 %"
        head = ["method", *_NAMES.values(), difference, "q", "processor s a picture", "memory MB"]
        by_sky = ["method", "score", *self.conditions]
        return [
            (f"{self.title}: mean of {_counted(self)}", head, [_line(e) for e in self.entries]),
            (f"{self.title}: by condition", by_sky, [*self._by_condition()]),
        ]

    def _by_condition(self) -> Iterator[list[str]]:
        for entry in self.entries:
            for score in SCORES:
                cells = (_cell(entry, sky, score) for sky in self.conditions)
                yield [entry.method, _NAMES[score], *cells]

    def to_table(self) -> str:
        """Return the report as Markdown."""
        parts = []
        for title, columns, lines in self.tables():
            rule = "|---|" + "---:|" * (len(columns) - 1)
            rows = [f"| {' | '.join(cells)} |" for cells in (columns, *lines)]
            parts += [title, "", rows[0], rule, *rows[1:], ""]
        return "\n".join([*parts, *self.notes]).strip()

    def to_json(self) -> str:
        """Return all figures as JSON; undefined values are null."""
        entries = [
            {
                "method": entry.method,
                "scores": [
                    {"condition": sky, "score": score, **asdict(spread)}
                    for (sky, score), spread in entry.means.items()
                ],
                "against": {
                    score: {**asdict(row.found), "q_value": row.q_value, "verdict": row.verdict}
                    for score, row in entry.against.items()
                },
                "cost": None if entry.cost is None else asdict(entry.cost),
            }
            for entry in self.entries
        ]
        board = {
            "title": self.title,
            "streets": list(self.streets),
            "entries": entries,
            "notes": list(self.notes),
        }
        return json.dumps(finite(board), indent=2, allow_nan=False)


def make_leaderboard(
    title: str,
    folder: Path,
    reference: str,
    own_conditions: Sequence[str],
    wanted: Sequence[str] = (),
    notes: Sequence[str] = (),
) -> Leaderboard:
    """Make a leaderboard of evaluations.

    Args:
        folder: folder with one JSON file of `lightsim evaluate` per street.
        reference: method with which all others are compared.
        own_conditions: names of skies with a column of their own; the column `OTHER` is the mean of
            all other skies.
        wanted: streets that every method should have; missing ones are noted.

    Raises:
        InputError, ArtefactError: the folder contains no evaluation of the reference.
    """
    rows_by_method: dict[str, dict[str, list[FrameRow]]] = {reference: {}}
    found = _rows_by_street(folder)
    for street, rows in found.items():
        for row in rows:
            rows_by_method.setdefault(row.method, {}).setdefault(street, []).append(row)
    if not rows_by_method[reference]:
        raise InputError(
            "the reference method was not evaluated",
            where=folder,
            got=", ".join(m for m in rows_by_method if m != reference) or "nothing",
            expected=reference,
            remedy="Run lightsim evaluate benchmark again: it repeats the failed steps.",
        )
    costs = _costs(folder)
    seen = {row.condition for rows in rows_by_method[reference].values() for row in rows}
    conditions = [name for name in own_conditions if name in seen]
    columns = (*conditions, *([OTHER] if seen - set(conditions) else []), MEAN)
    against = _against(reference, rows_by_method)
    entries = [
        Entry(
            method,
            dict(_means(streets, conditions)),
            {score: row for (name, score), row in against.items() if name == method},
            costs.get(method),
        )
        for method, streets in rows_by_method.items()
    ]
    # False sorts before True: the reference is first, the others by PSNR.
    entries.sort(key=lambda e: (e.method != reference, -e.means[MEAN, "psnr_db"].mean))
    # Sorts numbers given as text by value.
    names = tuple(sorted(found, key=lambda name: (len(name), name)))
    missing = {m: [s for s in wanted if s not in has] for m, has in rows_by_method.items()}
    lacking = [f"Not measured: {m} on {', '.join(s)}." for m, s in missing.items() if s]
    return Leaderboard(title, names, columns, tuple(entries), (*notes, *lacking))


def weakest(folder: Path, method: str, count: int) -> list[tuple[str, str, str, str, float]]:
    """Return street, condition, camera, frame and PSNR (dB) of a method's pictures of lowest
    PSNR."""
    found = [
        (street, row.condition, row.camera_name, stem, scores.psnr_db)
        for street, rows in _rows_by_street(folder).items()
        for row in rows
        if row.method == method
        for stem, scores in row.scores_by_stem.items()
    ]
    return sorted(found, key=lambda case: case[-1])[:count]


def _rows_by_street(folder: Path) -> dict[str, list[FrameRow]]:
    """Read the raw scores of the region outside the sky by street."""
    files = sorted(folder.glob("*.json"))
    rows = {file.stem: read_rows(file) for file in files}
    return {
        street: [row for row in found if row.region == "masked" and not row.is_exposed]
        for street, found in rows.items()
    }


def _means(
    streets: Mapping[str, list[FrameRow]], conditions: Sequence[str]
) -> Iterator[tuple[tuple[str, str], Spread]]:
    """Yield means by condition and score; a street is a sequence, the unit of the standard
    error."""
    for score in SCORES:
        samples: dict[str, dict[tuple[Any, str], float]] = {}
        for (street, camera), frame, condition, value in _values(streets, score):
            column = condition if condition in conditions else OTHER
            for name in (column, MEAN):
                samples.setdefault(name, {})[street, f"{camera}/{frame}"] = value
        for name, values in samples.items():
            yield (name, score), clustered_mean(values)


def _against(
    first: str, rows_by_method: Mapping[str, Mapping[str, list[FrameRow]]]
) -> dict[tuple[str, str], ComparedRow]:
    """Return differences from the first method by method and score, adjusted together.

    Frames of one camera of a street, under all skies, are a sequence.
    """

    def samples(method: str, score: str) -> Samples:
        found = _values(rows_by_method[method], score)
        return {(sequence, frame): value for sequence, frame, _, value in found}

    pairs = {
        ("masked", False, method, score): (samples(first, score), samples(method, score))
        for method in rows_by_method
        if method != first
        for score in SCORES
    }
    known = {key: pair for key, pair in pairs.items() if pair[0] and pair[1]}
    return {(row.method, row.score): row for row in compare_samples(known).rows}


def _values(
    streets: Mapping[str, list[FrameRow]], score: str
) -> Iterator[tuple[tuple[str, str], str, str, float]]:
    """Yield (street, camera), frame, condition and value of every picture with a finite value."""
    for street, rows in streets.items():
        for row in rows:
            for stem, scores in row.scores_by_stem.items():
                value = getattr(scores, score)
                # Equal pictures have infinite PSNR, which has no mean.
                if np.isfinite(value):
                    frame = f"{row.condition}/{stem}"
                    yield (street, row.camera_name), frame, row.condition, value


def _costs(folder: Path) -> dict[str, Cost]:
    """Return mean seconds and largest memory by method."""
    found: dict[str, list[Cost]] = {}
    for file in sorted(folder.glob("*.json")):
        report = Entries.of_file(file, "Remove the file, and evaluate again.")
        if "costs" in report:
            costs = report.object("costs")
            for method in costs:
                found.setdefault(method, []).append(Cost.read(costs.object(method)))
    return {
        method: Cost(
            float(np.mean([cost.seconds_a_frame for cost in costs])),
            # The maximum memory determines the machine that a method requires.
            max(cost.peak_memory_mb for cost in costs),
        )
        for method, costs in found.items()
    }


def _counted(board: Leaderboard) -> str:
    count = len(board.streets)
    named = ", ".join(board.streets)
    return f"{count} streets ({named})" if count > 1 else f"street {named}"


def _cell(entry: Entry, condition: str, score: str) -> str:
    spread = entry.means.get((condition, score))
    return "-" if spread is None else spread.format(DIGITS[score])


def _line(entry: Entry) -> list[str]:
    cells = [entry.method, *(_cell(entry, MEAN, score) for score in SCORES)]
    row = entry.against.get("psnr_db")
    if row is None:
        cells += ["-", "-"]
    else:
        f = row.found
        cells += [f"{f.difference:+.2f} [{f.low:+.2f}, {f.high:+.2f}]", row.shown_q]
    if entry.cost is None:
        return [*cells, "-", "-"]
    return [*cells, f"{entry.cost.seconds_a_frame:.1f}", str(entry.cost.peak_memory_mb)]
