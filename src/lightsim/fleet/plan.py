"""Plans: a YAML file with the steps of an experiment over many logs, and their cost."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, get_args

from lightsim.core.checks import check_choice
from lightsim.errors import InputError, need
from lightsim.fleet.batch import BatchOptions, BatchResult, run_batch
from lightsim.fleet.lines import BatchCommand, line_of, read_records, split_words
from lightsim.progress import Progress
from lightsim.store.reading import MAX_JSON_BYTES, read_bytes

_FORM = "values: {items: ..., NAME: ...} and steps: [{command: ..., line: ..., core_seconds: ...}]"


@dataclass(frozen=True)
class Step:
    """A command with one line for each item.

    Args:
        command: the command.
        lines: words of the line of each item.
        core_seconds: measured processor time of a line, used until lines of the batch are measured.
    """

    command: BatchCommand
    lines: Mapping[str, tuple[str, ...]]
    core_seconds: float


@dataclass(frozen=True)
class StepCost:
    """Lines, pictures and processor time of a step.

    Args:
        lines: number of lines.
        done: number of finished lines.
        pictures: number of relit or simulated pictures; None if lines do not bound the frames.
        core_seconds: processor time of a line.
        is_measured: the time is the mean of finished lines of this batch.
    """

    command: str
    lines: int
    done: int
    pictures: int | None
    core_seconds: float
    is_measured: bool

    @property
    def core_hours_left(self) -> float:
        """Processor time of the lines that are not finished."""
        return (self.lines - self.done) * self.core_seconds / 3600


def read_plan(path: Path, changes: Sequence[str] = ()) -> tuple[Step, ...]:
    """Return the steps of a plan.

    A line is a text in which {item} and {NAME} are replaced by an item and by values of the plan.

    Args:
        path: YAML file.
        changes: NAME=VALUE, in place of values of the plan.

    Raises:
        InputError: the file or a change cannot be used.
        MissingDependencyError: PyYAML is not installed.
    """
    yaml = need("yaml", extra="fleet")
    text = read_bytes(path, "plan", MAX_JSON_BYTES)
    try:
        plan = yaml.safe_load(text)
        values = {str(name): str(value) for name, value in plan["values"].items()}
        values |= _changes(changes, values)
        items = values.pop("items").split()
        return tuple(_step(path, step, items, values) for step in plan["steps"])
    except (yaml.YAMLError, KeyError, TypeError, AttributeError, ValueError) as error:
        raise InputError(
            "the plan cannot be read",
            where=path,
            got=f"{type(error).__name__}: {error}",
            expected=_FORM,
        ) from error


def cost_of(step: Step, out: Path) -> StepCost:
    """Return what a step makes and costs, from the records in the folder of its batch."""
    lines = [line_of((step.command, *words), out) for words in step.lines.values()]
    records = [r for r in read_records(out).values() if r.words[0] == step.command]
    measured = [record.cpu_seconds for record in records if record.state == "done"]
    pictures = [_picture_count(words) for words in step.lines.values()]
    return StepCost(
        step.command,
        len(lines),
        sum(line.is_done() for line in lines),
        None if None in pictures else sum(count or 0 for count in pictures),
        sum(measured) / len(measured) if measured else step.core_seconds,
        bool(measured),
    )


def run_plan(steps: Sequence[Step], options: BatchOptions, progress: Progress) -> BatchResult:
    """Run the steps in order; an item whose line failed has no line in the later steps."""
    total = BatchResult(0, 0, {})
    items = list(steps[0].lines)
    if options.only:
        items, options = items[options.only - 1 : options.only], replace(options, only=0)
    for step in steps:
        lines = {item: step.lines[item] for item in items}
        if not lines:
            break
        result = run_batch(step.command, list(lines.values()), options, progress)
        logs = {item: line_of((step.command, *words), options.out) for item, words in lines.items()}
        items = [item for item in items if logs[item].log not in result.failed]
        total = BatchResult(
            total.run + result.run, total.kept + result.kept, {**total.failed, **result.failed}
        )
    return total


def _changes(changes: Sequence[str], values: Mapping[str, str]) -> dict[str, str]:
    pairs = [change.partition("=") for change in changes]
    for name, equals, _ in pairs:
        check_choice("--set", name if equals else f"{name} without =", sorted(values))
    return {name: value for name, _, value in pairs}


def _step(path: Path, step: Any, items: Sequence[str], values: Mapping[str, str]) -> Step:
    check_choice(f"{path}: command", step["command"], get_args(BatchCommand))
    lines = {
        item: split_words(step["line"].format_map({**values, "item": item}), f"{path}")
        for item in items
    }
    return Step(step["command"], lines, float(step.get("core_seconds", 0.0)))


def _picture_count(words: Sequence[str]) -> int | None:
    """Return the number of pictures of a line of relight or simulate; 0 for other lines, None if
    --frames is open."""
    if "--sky" not in words:
        return 0
    after = list(words[words.index("--sky") + 1 :])
    skies = next((k for k, word in enumerate(after) if word.startswith("--")), len(after))
    given = {name: words[words.index(name) + 1] for name in words if name.startswith("--")
             and words.index(name) + 1 < len(words)}  # fmt: skip
    parts = given.get("--frames", "").split(":")
    if not all(part.isdigit() for part in parts) or len(parts) < 2:
        return None
    return skies * len(range(*map(int, parts))) * len(given.get("--cameras", "a").split(","))
