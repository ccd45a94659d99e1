"""`lightsim batch plan`: what an experiment makes and costs, and its run."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from lightsim.cli.app import main, parse_command
from lightsim.errors import InputError
from lightsim.fleet import process
from lightsim.fleet.batch import BatchOptions
from lightsim.fleet.plan import cost_of, read_plan, run_plan
from lightsim.progress import SilentProgress

pytest.importorskip("yaml", reason="PyYAML is not installed")
FLEET = Path(__file__).resolve().parents[2] / "examples" / "fleet"
PAPER = FLEET / "paper.yaml"
PLAN = """
values: {items: "001 002 003", out: OUT}
steps:
  - {command: build, line: "logs/{item} --work {out}/{item}", core_seconds: 7200}
  - {command: relight, line: "{out}/{item} --name noon --sky a.exr b.exr --frames 0:10:3"}
"""
FAKE = """
import sys
open("{asked}", "a").write(" ".join(sys.argv[1:3]) + chr(10))
if sys.argv[1] == "build" and "002" in sys.argv[2]:
    sys.exit("error: no sky")
"""


@pytest.fixture
def plan(tmp_path: Path) -> Path:
    path = tmp_path / "plan.yaml"
    path.write_text(PLAN)
    return path


def test_the_papers_experiment_has_47_logs_23_skies_and_4_frames(tmp_path: Path) -> None:
    steps = read_plan(PAPER)
    assert [(step.command, len(step.lines)) for step in steps] == [("build", 47), ("relight", 47)]
    costs = [cost_of(step, tmp_path) for step in steps]
    assert [cost.pictures for cost in costs] == [0, 47 * 23 * 4]
    for step in steps:
        for words in step.lines.values():
            parse_command((step.command, *words))


def test_an_item_that_failed_has_no_line_in_later_steps(
    plan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = tmp_path / "asked.txt"
    monkeypatch.setattr(process, "PROGRAM", ("-c", FAKE.format(asked=asked)))
    steps, options = read_plan(plan, ["out=works"]), BatchOptions(out=tmp_path / "runs")
    before = [cost_of(step, options.out) for step in steps]
    assert [cost.core_hours_left for cost in before] == [6.0, 0.0]
    assert [cost.pictures for cost in before] == [0, 3 * 2 * 4]
    result = run_plan(steps, options, SilentProgress())
    assert list(result.failed.values()) == ["error: no sky"]
    builds = [f"build logs/{item}" for item in ("001", "002", "003")]
    assert asked.read_text().splitlines() == [*builds, "relight works/001", "relight works/003"]
    after = [cost_of(step, options.out) for step in steps]
    assert [(cost.done, cost.is_measured) for cost in after] == [(2, True), (2, True)]
    assert 0 < after[0].core_seconds < 10
    asked.unlink()
    assert run_plan(steps, BatchOptions(out=options.out, only=1), SilentProgress()).kept == 2
    assert not asked.exists()


def test_the_command_shows_the_plan_and_runs_it(
    plan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = tmp_path / "asked.txt"
    monkeypatch.setattr(process, "PROGRAM", ("-c", FAKE.format(asked=asked)))
    words = ["batch", "plan", str(plan), "--out", str(tmp_path / "runs"), "--set", "items=001"]
    main(words)
    shown = capsys.readouterr().out.splitlines()
    assert shown[1].split() == ["build", "1", "0", "-", "7200.0", "of", "the", "plan", "2.00"]
    assert shown[2].split()[:4] == ["relight", "1", "0", "8"]
    assert not asked.exists()
    main([*words, "--start"])
    assert "done: 2, finished before: 0, failed: 0" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("steps: [", "cannot be read"),
        ("values: {items: a}", "cannot be read"),
        ("values: {items: a}\nsteps: [{command: build, line: '{other}'}]", "other"),
        ("values: {items: a}\nsteps: [{command: remove, line: x}]", "command"),
        ("values: !!python/object/apply:os.getcwd []\nsteps: []", "cannot be read"),
    ],
)
def test_plans_that_cannot_be_used_are_one_error(plan: Path, text: str, message: str) -> None:
    plan.write_text(text)
    with pytest.raises(InputError, match=message):
        read_plan(plan)


def test_only_values_of_the_plan_are_set(plan: Path) -> None:
    for change in ("other=1", "items"):
        with pytest.raises(InputError, match="--set"):
            read_plan(plan, [change])


@pytest.mark.parametrize("script", sorted(FLEET.glob("*.slurm")), ids=lambda path: path.name)
def test_scripts_of_slurm_are_read_by_bash(script: Path) -> None:
    subprocess.run(["bash", "-n", str(script)], check=True)
