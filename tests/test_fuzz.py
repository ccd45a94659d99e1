"""Fuzzing with a fixed seed, and proof that the fuzzer finds what it looks for."""

from __future__ import annotations

import contextlib
import os
import pickle
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from tools.fuzz.hostile_pickles import RUNS_CODE
from tools.fuzz.kinds import KINDS, ROUND
from tools.fuzz.runner import CANARY_NAME, Limits, run_case
from tools.fuzz.seeds import Seeds, make_seeds

from lightsim.errors import InputError

ROOT = Path(__file__).resolve().parents[1]
ROUNDS, SEED = 2, 3
COUNT = ROUNDS * len(ROUND)
SMALL = Limits(memory_mb=100_000, processor_s=5, wall_s=0.5)


@pytest.mark.slow
def test_nothing_foreign_endless_large_or_outside(tmp_path: Path) -> None:
    """A process of its own: it forks, which one with threads of other tests must not do."""
    command = [sys.executable, "-m", "tools.fuzz", "synthetic", str(COUNT), str(SEED)]
    paths = [str(ROOT / "src"), *filter(None, [os.environ.get("PYTHONPATH")])]
    done = subprocess.run(
        [*command, "--out", str(tmp_path / "table.md")],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, (done.stdout + done.stderr)[-6000:]
    table = (tmp_path / "table.md").read_text()
    assert all(f"| {kind.name} | {ROUNDS * kind.fraction} |" in table for kind in KINDS)
    assert f"| all | {COUNT} |" in table
    accepted = {
        kind: int(count) for kind, count in re.findall(r"\| ([a-z ]+) \| \d+ \| (\d+)", table)
    }
    # Some damage is harmless: readers that refuse everything would pass otherwise.
    assert sum(accepted[kind.name] for kind in KINDS) > COUNT // 10


def _our_error(folder: Path) -> None:
    raise InputError("broken", where=folder)


def _two_lines(folder: Path) -> None:
    raise InputError("broken", where=folder, remedy="in\ntwo lines")


def _foreign(folder: Path) -> None:
    raise KeyError("x")


def _warning(folder: Path) -> None:
    _ = np.float32(1e30) * np.float32(1e30)


def _blocked(folder: Path) -> None:
    os.mkfifo(folder / "fifo")
    (folder / "fifo").read_bytes()


def _unallocated(folder: Path) -> None:
    try:
        bytearray(1 << 45)
    except MemoryError as error:
        raise InputError("too large") from error


def _dies(folder: Path) -> None:
    os.abort()


def _runs_code(folder: Path) -> None:
    (folder / CANARY_NAME).touch()


def _writes_outside(folder: Path) -> None:
    (folder / ".." / "outside").mkdir()


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
@pytest.mark.parametrize(
    ("read", "result"),
    [
        (lambda folder: None, "accepted"),
        (_our_error, "refused"),
        (_two_lines, "message"),
        (_foreign, "foreign"),
        (_warning, "foreign"),
        (_blocked, "hang"),
        (_unallocated, "memory"),
        (_dies, "crash"),
        (_runs_code, "escape"),
        (_writes_outside, "escape"),
    ],
)
def test_the_runner_tells_outcomes_apart(
    tmp_path: Path, read: Callable[[Path], None], result: str
) -> None:
    outcome = run_case(tmp_path, lambda folder: "damage", read, SMALL)
    assert outcome.result == result, outcome
    assert outcome.damage == "damage"
    assert {path.name for path in tmp_path.iterdir()} == {"case"}


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_memory_is_measured(tmp_path: Path) -> None:
    outcome = run_case(tmp_path, lambda folder: "", lambda folder: None, Limits(memory_mb=1))
    assert outcome.result == "memory"
    assert outcome.peak_mb > 1


@pytest.fixture(scope="module")
def seeds(tmp_path_factory: pytest.TempPathFactory) -> Seeds:
    return make_seeds(tmp_path_factory.mktemp("seeds"), None)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_a_case_is_decided_by_its_number_and_the_seed(seeds: Seeds, tmp_path: Path) -> None:
    for number in range(0, 2 * len(ROUND), 3):
        made = []
        for attempt in ("a", "b"):
            folder = tmp_path / attempt / str(number)
            folder.mkdir(parents=True)
            words = ROUND[number % len(ROUND)].make(seeds, folder, np.random.default_rng(number))
            files = {p.relative_to(folder): p for p in folder.rglob("*") if p.is_file()}
            small = {k: p.read_bytes() for k, p in files.items() if p.stat().st_size < 1 << 26}
            same = {k: v.replace(str(folder).encode(), b"") for k, v in small.items()}
            made.append((words.replace(str(folder), ""), same))
        # Compressed data and Python's own addresses aside, bytes are equal.
        assert made[0][0] == made[1][0]
        assert made[0][1].keys() == made[1][1].keys()


@pytest.mark.parametrize("builder", RUNS_CODE, ids=lambda b: b.__name__)
def test_hostile_pickles_do_run_code_in_the_plain_unpickler(
    tmp_path: Path, builder: Callable[[Path, np.random.Generator], bytes]
) -> None:
    canary = tmp_path / "ran"
    data = builder(canary, np.random.default_rng(1))
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path)
        with contextlib.suppress(Exception):  # what follows the attack may fail
            pickle.loads(data)
    assert canary.exists()
