"""`lightsim batch --engine ray`: lost workers, processes and nodes; every line ends once."""

from __future__ import annotations

import importlib
import importlib.util
import os
import subprocess
import sys
import threading
import time
from collections.abc import Generator
from pathlib import Path
from typing import Any

import pytest

from lightsim.errors import InputError, MissingDependencyError
from lightsim.fleet import process
from lightsim.fleet.batch import BatchOptions, run_batch
from lightsim.fleet.lines import Request, read_records
from lightsim.progress import SilentProgress

STORE_BYTES = 80 * 2**20
FAKE = """
import os, sys, time
from pathlib import Path
from lightsim.fleet.child import end_with_parent
end_with_parent()
log, out = sys.argv[2], Path(sys.argv[3])
with (out / (log + ".tries")).open("a") as tries:
    tries.write("x")
is_first = (out / (log + ".tries")).read_text() == "x"
if log == "worker" and is_first and "here" not in sys.argv:
    os.kill(os.getppid(), 9)
    time.sleep(60)
if log == "child" and is_first and "here" not in sys.argv:
    os.kill(os.getpid(), 9)
if log in ("node", "other") and "here" not in sys.argv:
    ends = time.monotonic() + 100
    # A worker may outlive its node for seconds and still return a result: it must not be able to.
    lost = out / "lost"
    while time.monotonic() < ends and (
        not lost.exists() or lost.read_text() == os.environ["RAY_RAYLET_PID"]
    ):
        time.sleep(0.1)
if log == "broken":
    sys.exit("error: this log is broken")
(out / (log + ".png")).write_bytes(log.encode() * 1000)
print("made", log, "with", os.environ["OMP_NUM_THREADS"], "threads")
"""
"""Stands for lightsim: kills its worker or itself, or waits until a node is lost, unless the last
word is here."""
LOGS = ("worker", "child", "broken", "node", "other")


HAS_RAY = importlib.util.find_spec("ray") is not None
needs_ray = pytest.mark.skipif(not HAS_RAY, reason="ray is not installed")
QUIET = {"RAY_AUTH_MODE": "disabled", "RAY_USAGE_STATS_ENABLED": "0"}


@pytest.fixture
def cluster(monkeypatch: pytest.MonkeyPatch) -> Generator[Any]:
    """Two nodes of one core, as processes of this machine."""
    for name, value in QUIET.items():
        monkeypatch.setenv(name, value)
    cluster_utils: Any = importlib.import_module("ray.cluster_utils")
    own = {"num_cpus": 1, "object_store_memory": STORE_BYTES}
    made = cluster_utils.Cluster(
        initialize_head=True, head_node_args={**own, "include_dashboard": False}
    )
    made.second = made.add_node(**own)
    yield made
    made.shutdown()


@needs_ray
@pytest.mark.slow
@pytest.mark.ray
@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::ResourceWarning")
def test_every_line_ends_once_though_worker_process_and_node_are_lost(
    cluster: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(process, "PROGRAM", ("-c", FAKE))
    results = {name: tmp_path / name for name in ("ray", "here")}
    for folder in results.values():
        folder.mkdir()
    remover = threading.Thread(target=remove_node, args=(cluster, results["ray"]))
    remover.start()
    lines = [(log, str(results["ray"])) for log in LOGS]
    asked: dict[str, Any] = {"engine": "ray", "address": cluster.address, "memory_gb": 0.1}
    options = BatchOptions(out=tmp_path / "batch", cores=1, **asked)
    result = run_batch("build", lines, options, SilentProgress())
    remover.join()
    assert (result.run, result.kept) == (5, 0)
    assert list(result.failed.values()) == ["error: this log is broken"]
    records = read_records(tmp_path / "batch").values()
    assert sorted(record.state for record in records) == ["done"] * 4 + ["failed"]
    assert {record.last_line for record in records if record.words[1] == "child"} == {
        "made child with 1 threads"
    }
    tries = {log: len((results["ray"] / f"{log}.tries").read_text()) for log in LOGS}
    assert [tries[log] for log in ("worker", "child", "broken")] == [2, 2, 1]
    # Of the two lines that were running, the one on the lost node was repeated.
    assert sorted([tries["node"], tries["other"]]) == [1, 2]
    here = [(log, str(results["here"]), "here") for log in LOGS]
    run_batch("build", here, BatchOptions(out=tmp_path / "local"), SilentProgress())
    pictures = [{p.name: p.read_bytes() for p in f.glob("*.png")} for f in results.values()]
    assert len(pictures[0]) == 4
    assert pictures[0] == pictures[1]
    assert run_batch("build", lines, options, SilentProgress()).kept == 4


def remove_node(cluster: Any, folder: Path) -> None:
    """Kill the second node when each of the two nodes runs a line that waits for it."""
    tries = [folder / "node.tries", folder / "other.tries"]
    while not all(file.is_file() and file.read_text() for file in tries):
        time.sleep(0.1)
    raylet = cluster.second.all_processes["raylet"][0].process.pid
    cluster.remove_node(cluster.second, allow_graceful=False)
    (folder / "number").write_text(str(raylet))
    (folder / "number").rename(folder / "lost")


@needs_ray
@pytest.mark.slow
@pytest.mark.ray
def test_ray_is_started_here_without_a_file_in_the_home_folder(tmp_path: Path) -> None:
    (tmp_path / "logs.txt").write_text("nowhere\n")
    home = tmp_path / "home"
    home.mkdir()
    clean = {name: value for name, value in os.environ.items() if not name.startswith("RAY_")}
    words = ["batch", "check", "logs.txt", "--out", "runs", "--engine", "ray", "--cores", "1"]
    done = subprocess.run(
        [sys.executable, "-m", "lightsim", *words], cwd=tmp_path, capture_output=True, text=True,
        env=clean | {"HOME": str(home)}, check=False, timeout=600,
    )  # fmt: skip
    assert done.returncode == 1, done.stderr
    assert "failed 1 times: lightsim: error: nowhere: no such folder" in done.stdout
    assert "1 of 1 commands failed" in done.stderr
    assert not list(home.iterdir())


@needs_ray
def test_a_cluster_that_does_not_answer_is_one_error(tmp_path: Path) -> None:
    options = BatchOptions(out=tmp_path, engine="ray", address="127.0.0.1:1")
    with pytest.raises(InputError, match=r"--address 127\.0\.0\.1:1: no Ray cluster answers"):
        run_batch("build", [("logs/001",)], options, SilentProgress())


def test_without_ray_the_error_has_the_command_that_installs_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("ray", "s3fs", "gcsfs"):
        monkeypatch.setitem(sys.modules, name, None)
    options = BatchOptions(out=tmp_path, engine="ray")
    with pytest.raises(MissingDependencyError, match=r"pip install 'lightsim\[fleet\]'"):
        run_batch("build", [("logs/001",)], options, SilentProgress())


def test_requests_are_at_most_those_of_the_machine() -> None:
    from lightsim.fleet.on_ray import _task_options

    node = {"CPU": 2.0, "memory": 2e9}
    assert _task_options(Request(8, 500, 0.0), [node]) == {"num_cpus": 2, "memory": 500_000_000}
    assert _task_options(Request(1, 9000, 0.5), [node]) == {
        "num_cpus": 1,
        "memory": 2_000_000_000,
        "num_gpus": 0.5,
    }
    # Nodes of a cluster may be started later.
    assert _task_options(Request(64, 9000, 0.0), [])["num_cpus"] == 64
