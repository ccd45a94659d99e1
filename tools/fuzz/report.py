"""The table of a run, and the list of its failures."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

from .runner import FAILURES, Outcome, Result

_HEAD = (
    "| kind | cases | accepted | refused | foreign | hang | memory | crash | code or outside | "
    "peak MB | slowest s |"
)
_COLUMNS: tuple[tuple[Result, ...], ...] = (
    ("accepted",), ("refused",), ("foreign", "message", "harness"), ("hang",), ("memory",),
    ("crash",), ("escape",),
)  # fmt: skip


@dataclass
class Report:
    """Outcomes by kind, and every failing case."""

    outcomes: dict[str, list[Outcome]] = field(default_factory=dict)
    failures: list[tuple[int, str, Outcome]] = field(default_factory=list)

    def add(self, number: int, kind: str, outcome: Outcome) -> None:
        self.outcomes.setdefault(kind, []).append(outcome)
        if outcome.result in FAILURES:
            self.failures.append((number, kind, outcome))

    def to_table(self) -> str:
        """Markdown: one row a kind, and their sum."""
        rows = [_HEAD, "|---|" + "---:|" * (_HEAD.count("|") - 2)]
        rows += [_row(kind, found) for kind, found in self.outcomes.items()]
        rows.append(_row("all", [o for found in self.outcomes.values() for o in found]))
        return "\n".join(rows)

    def to_failures(self, command: str) -> str:
        """Failures by place, each with its first case's reproduction; then one line a case."""
        by_place: dict[tuple[str, str, str], list[tuple[int, str, Outcome]]] = {}
        for number, kind, outcome in self.failures:
            key = (outcome.result, outcome.place, outcome.detail.split(":")[0])
            by_place.setdefault(key, []).append((number, kind, outcome))
        lines = [f"{len(self.failures)} failures in {len(by_place)} places"]
        for (result, place, name), cases in sorted(by_place.items()):
            number, kind, outcome = cases[0]
            lines.append(f"{len(cases):5d} x {result} {place} {name}")
            lines.append(f"        {kind}: {outcome.damage}")
            lines.append(f"        {outcome.detail}")
            lines.append(f"        {command} --case {number}")
            others = ", ".join(str(n) for n, _, _ in cases[1:])
            lines += [f"        also cases {others}"] if others else []
        return "\n".join(lines)


def _row(kind: str, outcomes: list[Outcome]) -> str:
    count = Counter(outcome.result for outcome in outcomes)
    cells = [sum(count[result] for result in column) for column in _COLUMNS]
    peak_mb = max(o.peak_mb for o in outcomes)
    slowest_s = max(o.processor_s for o in outcomes)
    numbers = " | ".join(str(c) for c in (len(outcomes), *cells))
    return f"| {kind} | {numbers} | {peak_mb:.0f} | {slowest_s:.2f} |"
