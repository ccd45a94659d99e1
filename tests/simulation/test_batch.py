"""Many logs: a process each, kept where finished, told where failed."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from lightsim import cli
from lightsim.errors import InputError
from lightsim.fleet import batch
from lightsim.fleet.batch import BatchOptions, BatchResult, read_list, run_batch
from lightsim.progress import SilentProgress

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
    monkeypatch.setattr(batch, "_PROGRAM", (sys.executable, "-c", FAKE))
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
    told = "import os, sys; open(sys.argv[2], 'w').write(os.environ['OMP_NUM_THREADS'])"
    monkeypatch.setattr(batch, "_PROGRAM", (sys.executable, "-c", told))
    monkeypatch.setattr(batch, "core_count", lambda: 8)
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
    told = subprocess.run(
        [sys.executable, "-c", program], env=environment | {"OMP_NUM_THREADS": "1"},
        check=True, capture_output=True, text=True,
    )  # fmt: skip
    assert told.stdout.split() == ["1", "1"]


def test_shards_share_a_folder_and_the_work(asked: Path) -> None:
    (asked.parent / "mended").touch()
    results = [run(asked, shard=f"{i}/2") for i in (1, 2)]
    assert [r.run for r in results] == [1, 2]
    assert names(asked) == ["001", "broken", "003"]
    assert run(asked) == BatchResult(0, 3, {})


def test_another_version_or_other_words_are_not_taken_for_finished(
    asked: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (asked.parent / "mended").touch()
    run(asked)
    monkeypatch.setattr(batch, "__version__", "9.9")
    assert run(asked).run == 3
    options = BatchOptions(out=asked.parent / "batch")
    lines = [("logs/001", str(asked), "--preset", "draft")]
    assert run_batch("build", lines, options, SilentProgress()).run == 1


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
    assert "error: this log is broken" in shown.out
    assert "1 of 2 commands failed" in shown.err


@pytest.mark.slow
def test_real_commands_run(tmp_path: Path) -> None:
    """Without the fake: a log that is not there ends with our own error."""
    options = BatchOptions(out=tmp_path)
    lines = [("nowhere", "--work", str(tmp_path / "w"))]
    result = run_batch("build", lines, options, SilentProgress())
    log, last = next(iter(result.failed.items()))
    assert "lightsim: error:" in last
    assert log.name.startswith("nowhere-")
