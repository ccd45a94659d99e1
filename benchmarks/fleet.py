"""Rehearsal of examples/fleet/paper.yaml: tiny logs in a store on this machine and two Ray workers,
of which one is killed; results are compared with those of a run without store, Ray and faults.

python benchmarks/fleet.py OUT

Needs the extras `fleet` and `s3`, moto, flask and flask-cors.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

from lightsim.fleet.staging import open_store
from lightsim.store.artefact import RECORD_NAME, hash_file
from lightsim_lab.synthetic import shipped_street

PLAN = Path(__file__).resolve().parents[1] / "examples" / "fleet" / "paper.yaml"
PORT = 5055
LOGS = ("001", "002", "003", "005", "006", "008")
STORE = {
    "AWS_ENDPOINT_URL": f"http://127.0.0.1:{PORT}",
    "AWS_ACCESS_KEY_ID": "test",
    "AWS_SECRET_ACCESS_KEY": "test",
    "AWS_DEFAULT_REGION": "us-east-1",
}
VALUES = (
    f"items={' '.join(LOGS)}",
    "build=--preset draft --neural-steps 0 --cameras front_camera --frames 0:4 --image-scale 0.25 "
    "--no-complete crowns,webs,crown_tops,far_walls,roofs,ledges,far_field",
    "frames=1:2",
    "skies=sun:180,20 sun:0,20 sun:90,50 sun:180,50 sun:270,50",
)


def plan(out: Path, logs: str, works: str, *words: str) -> subprocess.Popen[bytes]:
    """Start `lightsim batch plan` of the small experiment."""
    given = ("--out", str(out), *words, "--set", *VALUES, f"logs={logs}", f"works={works}")
    return subprocess.Popen([sys.executable, "-m", "lightsim", "batch", "plan", str(PLAN), *given])


def kill_a_worker() -> None:
    """Kill the first Ray worker that runs a build, 10 s after its start."""
    while True:
        lines = [path for path in Path("/proc").glob("[0-9]*/cmdline") if is_build(path)]
        if lines:
            time.sleep(10.0)
            child = int(lines[0].parent.name)
            worker = int(Path(f"/proc/{child}/stat").read_text().rpartition(")")[2].split()[1])
            os.kill(worker, signal.SIGKILL)
            sys.stdout.write(f"killed worker {worker} of process {child}\n")
            return
        time.sleep(0.5)


def is_build(path: Path) -> bool:
    try:
        words = path.read_bytes().split(b"\0")
    except OSError:
        return False
    return b"lightsim.fleet.child" in words and b"build" in words


def results(folder: Path) -> dict[str, str]:
    """Return the hash of every file of the artefacts, without their records of seconds."""
    records = [p for p in folder.rglob(RECORD_NAME) if not any(x[0] == "." for x in p.parts[1:])]
    files = {p for record in records for p in record.parent.rglob("*") if p.is_file()}
    return {str(p.relative_to(folder)): hash_file(p) for p in files if p.name != RECORD_NAME}


def main(out: Path) -> None:
    shutil.rmtree(out, ignore_errors=True)
    (out / "logs").mkdir(parents=True)
    for name in LOGS:
        shutil.copytree(shipped_street() / "log", out / "logs" / name)
    os.environ.update(STORE)
    server = subprocess.Popen(
        [sys.executable, "-m", "moto.server", "-p", str(PORT)],
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    try:
        time.sleep(10.0)
        store = open_store("s3")
        store.mkdir("rehearsal")
        store.put(str(out / "logs"), "rehearsal/logs", recursive=True)
        words = ("--start", "--engine", "ray", "--cores", "1", "--memory-gb", "2")
        places = ("s3://rehearsal/logs", "s3://rehearsal/works")
        start = time.monotonic()
        running = plan(out / "ray", *places, *words)
        kill_a_worker()
        running.wait()
        sys.stdout.write(f"Ray and store: {time.monotonic() - start:.0f} s\n")
        plan(out / "ray", *places).wait()
        store.get("rehearsal/works", str(out / "stored"), recursive=True)
    finally:
        server.terminate()
    start = time.monotonic()
    plan(out / "local", str(out / "logs"), str(out / "works"), "--start", "--jobs", "2").wait()
    sys.stdout.write(f"local: {time.monotonic() - start:.0f} s\n")
    one, other = results(out / "stored"), results(out / "works")
    differing = sorted(n for n in one.keys() | other.keys() if one.get(n) != other.get(n))
    sys.stdout.write(f"{len(one)} files of {len(other)}, {len(differing)} differ: {differing}\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve())
