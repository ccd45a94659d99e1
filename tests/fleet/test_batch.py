"""`lightsim batch` on one machine: a process for each line, finished lines are kept."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import pytest

from lightsim import cli
from lightsim.errors import InputError
from lightsim.fleet import lines, process
from lightsim.fleet.batch import BatchOptions, BatchResult, request_of, run_batch
from lightsim.fleet.lines import Record, Request, grouped, line_of, read_list, read_records
from lightsim.progress import SilentProgress
from lightsim.store.artefact import peak_memory_mb

T = TypeVar("T")
FAKE = """
import sys
from pathlib import Path
command, log, out = sys.argv[1:4]
with Path(out).open("a") as file:
    file.write(command + " " + log + "\\n")
if Path(log).name == "broken" and not Path(out).with_name("mended").exists():
    sys.exit("error: this log is broken")
print("made", log)
"""
"""Stands for lightsim: notes what it was asked for, and fails for the log named broken."""


@pytest.fixture
def asked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(process, "PROGRAM", ("-c", FAKE))
    return tmp_path / "asked.txt"


def run(asked: Path, **options: object) -> BatchResult:
    lines = [(f"logs/{name}", str(asked)) for name in ("001", "broken", "003")]
    chosen = BatchOptions(out=asked.parent / "batch", **options)  # type: ignore[arg-type]
    return run_batch("build", lines, chosen, SilentProgress())


def names(asked: Path) -> list[str]:
    return [line.split("/")[1] for line in asked.read_text().splitlines()]


@pytest.mark.parametrize("jobs", [1, 3])
def test_the_rest_goes_on_and_only_what_failed_is_run_again(asked: Path, jobs: int) -> None:
    result = run(asked, jobs=jobs)
    assert sorted(names(asked)) == ["001", "003", "broken"]
    assert (result.run, result.kept) == (3, 0)
    assert list(result.failed.values()) == ["error: this log is broken"]
    (log,) = result.failed
    assert log.name.startswith("broken-")
    asked.unlink()
    (asked.parent / "mended").touch()
    assert run(asked, jobs=jobs) == BatchResult(1, 2, {})
    assert names(asked) == ["broken"]
    assert run(asked) == BatchResult(0, 3, {})


def test_processes_share_the_cores(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    reported = "import os, sys; open(sys.argv[2], 'w').write(os.environ['OMP_NUM_THREADS'])"
    monkeypatch.setattr(process, "PROGRAM", ("-c", reported))
    monkeypatch.setattr(process, "core_count", lambda: 8)
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    for jobs, asked, threads in ((3, None, "2"), (16, None, "1"), (3, "5", "5")):
        if asked is not None:
            monkeypatch.setenv("OMP_NUM_THREADS", asked)
        out = tmp_path / f"{jobs}-{asked}"
        run_batch("build", [(str(out),)], BatchOptions(out=tmp_path, jobs=jobs), SilentProgress())
        assert out.read_text() == threads


def test_a_limit_on_threads_holds_after_numbas_first_loop() -> None:
    """Whose start sets the threads of torch."""
    program = (
        "from lightsim.reconstruct.fusion.tsdf_kernels import integrate_view\n"
        "import numba.np.ufunc.parallel as parallel, torch\n"
        "parallel._launch_threads()\n"
        "print(torch.get_num_threads(), parallel.get_thread_count())"
    )
    environment = {k: v for k, v in os.environ.items() if k != "NUMBA_NUM_THREADS"}
    reported = subprocess.run(
        [sys.executable, "-c", program], env=environment | {"OMP_NUM_THREADS": "1"},
        check=True, capture_output=True, text=True,
    )  # fmt: skip
    assert reported.stdout.split() == ["1", "1"]


def test_tasks_of_an_array_take_a_line_each(asked: Path) -> None:
    (asked.parent / "mended").touch()
    assert [run(asked, only=number).run for number in (3, 1)] == [1, 1]
    assert names(asked) == ["003", "001"]
    assert run(asked) == BatchResult(1, 2, {})
    with pytest.raises(InputError, match="--only 4: the list has no such line"):
        run(asked, only=4)


def test_records_have_the_cost_and_the_end_of_each_line(asked: Path) -> None:
    result = run(asked)
    records = {record.words[1]: record for record in read_records(asked.parent / "batch").values()}
    assert {log: record.state for log, record in records.items()} == {
        "logs/001": "done",
        "logs/broken": "failed",
        "logs/003": "done",
    }
    record = records["logs/001"]
    assert record.last_line == "made logs/001"
    assert 0 < record.cpu_seconds < 10
    # Linux counts from the size of the process that starts it: here, of the tests.
    assert 5 < record.peak_memory_mb < 500 + peak_memory_mb()
    assert records["logs/broken"].exit_code == 1
    (path,) = result.failed
    path.with_suffix(".json").write_text("{")
    assert run(asked).run == 1


def test_a_line_that_was_killed_is_reported_and_run_again(
    asked: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(process, "PROGRAM", ("-c", "import os; os.kill(os.getpid(), 9)"))
    assert set(run(asked).failed.values()) == {"killed by SIGKILL (out of memory?)"}
    monkeypatch.setattr(process, "PROGRAM", ("-c", FAKE))
    (asked.parent / "mended").touch()
    assert run(asked) == BatchResult(3, 0, {})


def test_lines_end_with_the_process_that_runs_them(tmp_path: Path) -> None:
    """A batch that is killed leaves no command behind that holds a work folder."""
    child = (
        "import os, time; from lightsim.fleet.child import end_with_parent; end_with_parent();"
        f"open({str(tmp_path / 'pid')!r}, 'w').write(str(os.getpid())); time.sleep(60)"
    )
    program = (
        "from pathlib import Path; from lightsim.fleet import process;"
        f"process.PROGRAM = ('-c', {child!r});"
        "from lightsim.fleet.lines import line_of; line = line_of(('build', 'x'), Path('.'));"
        "list(process.run_here([line], 1))"
    )
    parent = subprocess.Popen([sys.executable, "-c", program], cwd=tmp_path)
    pid = wait_for(lambda: (tmp_path / "pid").exists() and (tmp_path / "pid").read_text())
    parent.kill()
    parent.wait()
    assert wait_for(lambda: has_ended(pid))


def wait_for(found: Callable[[], T], seconds: float = 20.0) -> T:
    """Return the first value that is not empty."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if value := found():
            return value
        time.sleep(0.05)
    raise AssertionError("timed out")


def has_ended(pid: object) -> bool:
    """Return True for a process that has ended; nobody may have reaped it."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().split()[2] == "Z"
    except OSError:
        return True


def test_resources_are_those_of_earlier_lines(tmp_path: Path) -> None:
    options = BatchOptions(out=tmp_path, gpus_per_log=0.5)
    line = line_of(("build", "logs/001"), tmp_path)
    assert request_of(line, [], options) == Request(2, 3000, 0.5)
    other = Record(
        ("build", "logs/002"), state="done", seconds=10.0, cpu_seconds=35.0, peak_memory_mb=2000
    )
    assert request_of(line, [other], options) == Request(4, 2600, 0.5)
    own = Record(line.words, state="done", seconds=10.0, cpu_seconds=9.0, peak_memory_mb=1000)
    assert request_of(line, [other, own], options) == Request(1, 1300, 0.5)
    given = BatchOptions(out=tmp_path, cores=3, memory_gb=1.5)
    assert request_of(line, [other, own], given) == Request(3, 1500, 0.0)


def test_failures_are_grouped_by_error() -> None:
    last = {Path("b"): "full disk", Path("a"): "a/1: no sky", Path("c"): "nowhere: no sky"}
    assert grouped(last) == {"* no sky": [Path("a"), Path("c")], "full disk": [Path("b")]}


def test_another_version_or_other_words_are_not_taken_for_finished(
    asked: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (asked.parent / "mended").touch()
    run(asked)
    monkeypatch.setattr(lines, "__version__", "9.9")
    assert run(asked).run == 3
    options = BatchOptions(out=asked.parent / "batch")
    other = [("logs/001", str(asked), "--preset", "draft")]
    assert run_batch("build", other, options, SilentProgress()).run == 1


def test_lists_are_read_as_a_shell_does(tmp_path: Path) -> None:
    path = tmp_path / "list.txt"
    path.write_text('# all\nlogs/001 --work "a b"\n\n  logs/002 --work c # night\n')
    assert read_list(path) == [("logs/001", "--work", "a b"), ("logs/002", "--work", "c")]
    path.write_text("logs/001 --work 'a\n")
    with pytest.raises(InputError, match=r"list\.txt:1"):
        read_list(path)
    with pytest.raises(InputError, match="contains no log"):
        run_batch("build", [], BatchOptions(out=tmp_path), SilentProgress())


def test_the_command_says_what_failed(asked: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = asked.parent / "list.txt"
    path.write_text("logs/001\nlogs/broken\n")
    words = ["batch", "relight", str(path), "--out", str(asked.parent / "batch")]
    with pytest.raises(SystemExit) as stopped:
        cli.main([*words, f"--words={asked} --name noon"])
    assert stopped.value.code == 1
    shown = capsys.readouterr()
    assert "done: 1, finished before: 0, failed: 1" in shown.out
    assert "failed 1 times: error: this log is broken" in shown.out
    assert "1 of 2 commands failed" in shown.err
    cli.main(["batch", "status", str(asked.parent / "batch")])
    shown = capsys.readouterr()
    assert "done: 1, failed: 1" in shown.out
    assert "failed 1 times: error: this log is broken" in shown.out


@pytest.mark.slow
def test_real_commands_run(tmp_path: Path) -> None:
    """Without the fake: a log that is not there ends with our own error."""
    options = BatchOptions(out=tmp_path)
    lines = [("nowhere", "--work", str(tmp_path / "w"))]
    result = run_batch("build", lines, options, SilentProgress())
    log, last = next(iter(result.failed.items()))
    assert "lightsim: error:" in last
    assert log.name.startswith("nowhere-")
