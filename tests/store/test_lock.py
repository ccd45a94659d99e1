"""One command at a time writes into a folder; the other is told which process holds it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from lightsim.errors import ArtefactError
from lightsim.store.lock import locked

HOLD = """
import sys, time
from pathlib import Path
from lightsim.store.lock import locked
with locked(Path(sys.argv[1]), is_shared=sys.argv[2] == "shared"):
    print("held", flush=True)
    time.sleep(60)
"""


def holder(path: Path, how: str) -> subprocess.Popen[str]:
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(path), how], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "held\n"
    return process


def test_a_second_writer_is_refused_and_told_the_process(tmp_path: Path) -> None:
    path = tmp_path / ".lock"
    with holder(path, "alone") as process:
        for is_shared in (False, True):
            with (
                pytest.raises(ArtefactError, match=f"process {process.pid} on"),
                locked(path, is_shared=is_shared),
            ):
                pass
        process.send_signal(signal.SIGKILL)
    with locked(path):
        assert path.read_text().startswith(f"{os.getpid()} ")


def test_readers_hold_it_together_and_keep_writers_out(tmp_path: Path) -> None:
    path = tmp_path / ".lock"
    with holder(path, "shared") as process:
        with locked(path, is_shared=True):
            pass
        with pytest.raises(ArtefactError, match=f"process {process.pid} on"), locked(path):
            pass
        process.kill()


def test_the_lock_is_given_back_after_an_error(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError), locked(tmp_path / ".lock"):
        _ = 1 / 0
    with locked(tmp_path / ".lock"):
        pass
