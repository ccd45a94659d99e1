"""URLs in command lines: staged to this machine and back, whole or not at all."""

from __future__ import annotations

import contextlib
import http.client
import http.server
import importlib
import importlib.util
import json
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Generator
from pathlib import Path
from typing import Any

import pytest

from lightsim.cli.app import main
from lightsim.errors import ArtefactError, InputError, MissingDependencyError
from lightsim.fleet.staging import StagedTree, open_store, shown, staged
from lightsim.store.artefact import ArtefactKey, make_artefact

HAS_STORE = all(importlib.util.find_spec(name) for name in ("s3fs", "moto", "flask_cors"))
needs_store = pytest.mark.skipif(not HAS_STORE, reason="s3fs, moto, flask or flask-cors is missing")
# Of libraries of others: event loops that a process leaves to the system at its end.
quiet = pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::DeprecationWarning")
BUILD = ["build", "s3://logs/001", "--work", "s3://works/001"]


@pytest.fixture(scope="module")
def server() -> Generator[int]:
    """Port of a server of S3 on this machine."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    words = ["-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)]
    with subprocess.Popen(
        [sys.executable, *words], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    ) as process:
        try:
            wait_for_port(port)
            yield port
        finally:
            process.terminate()


def wait_for_port(port: int) -> None:
    end = time.monotonic() + 60
    while time.monotonic() < end:
        with contextlib.suppress(OSError):
            socket.create_connection(("127.0.0.1", port), timeout=1).close()
            return
        time.sleep(0.1)
    raise AssertionError("the server did not start")


@pytest.fixture
def store(server: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Empty store with a recording and a sky; commands use it, and tmp_path as their disk."""
    reset = http.client.HTTPConnection("127.0.0.1", server)
    reset.request("POST", "/moto-api/reset")
    assert reset.getresponse().status == 200
    reset.close()
    use(monkeypatch, server, tmp_path / "disk")
    made = open_store("s3")
    for bucket in ("logs", "works", "skies"):
        made.mkdir(bucket)
    made.pipe({"logs/001/log.json": b"{}", "logs/001/front/0.jpg": b"x" * 300_000})
    made.pipe_file("skies/noon.exr", b"sky")
    return made


def use(monkeypatch: pytest.MonkeyPatch, port: int, disk: Path) -> None:
    """Let the store be that at a port, and the disk of this machine a folder."""
    # Connections are kept for the first address.
    importlib.import_module("s3fs").S3FileSystem.clear_instance_cache()
    disk.mkdir(exist_ok=True)
    for name, value in {
        "AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}",
        "AWS_ACCESS_KEY_ID": "test",
        "AWS_SECRET_ACCESS_KEY": "test",
        "AWS_DEFAULT_REGION": "us-east-1",
        "LIGHTSIM_SCRATCH": str(disk),
    }.items():
        monkeypatch.setenv(name, value)


def make(work: Path, stage: str, *files: str, seed: int = 0) -> None:
    """Make an artefact of `work` whose files depend on the seed."""

    def write(folder: Path) -> list[str]:
        for file in files:
            (folder / file).parent.mkdir(parents=True, exist_ok=True)
            (folder / file).write_bytes(f"{stage} {file} {seed}".encode() * 1000)
        return []

    make_artefact(work / stage, ArtefactKey(stage, {}, {}, {}, seed), write)


def build(words: list[str], seed: int = 0) -> None:
    """Stand for `lightsim build`: two stages, the options, and what is hidden."""
    source, work = Path(words[1]), Path(words[3])
    assert (source / "front" / "0.jpg").read_bytes() == b"x" * 300_000
    work.mkdir(parents=True, exist_ok=True)
    (work / ".lock").write_text("held")
    (work / "build.json").write_text(json.dumps({"reading": {"source": str(source)}}))
    make(work, "masks", "a/0.png", "a/1.png", seed=seed)
    make(work, "twin", "twin.json", seed=seed)


def content(store: Any, bucket: str) -> dict[str, bytes]:
    return {name: store.cat_file(name) for name in store.find(bucket)}


@needs_store
@quiet
def test_another_machine_finds_the_twin_and_its_recording(
    store: Any, server: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with staged(BUILD) as words:
        assert words[1].endswith("/s3/logs/001")
        build(words)
    found = {name.removeprefix("works/001/") for name in store.find("works")}
    assert found == {
        "build.json",
        *(f"masks/{name}" for name in ("a/0.png", "a/1.png", "artefact.json")),
        *(f"twin/{name}" for name in ("twin.json", "artefact.json")),
    }
    assert json.loads(store.cat_file("works/001/build.json")) == {
        "reading": {"source": "s3://logs/001"}
    }
    assert not list((tmp_path / "disk").rglob("*.png"))
    use(monkeypatch, server, tmp_path / "other")
    with staged(["relight", "s3://works/001", "--sky=s3://skies/noon.exr"]) as words:
        work, sky = Path(words[1]), Path(words[2].removeprefix("--sky="))
        assert sky.read_bytes() == b"sky"
        source = Path(json.loads((work / "build.json").read_text())["reading"]["source"])
        assert source.is_relative_to(tmp_path / "other")
        assert (source / "log.json").read_bytes() == b"{}"
        make(work, "scenarios/noon", "frames/a/0.png")
        (work / "note.txt").write_text("new")
    added = {name.removeprefix("works/001/") for name in store.find("works")} - found
    names = ("frames/a/0.png", "artefact.json")
    assert added == {"note.txt", *(f"scenarios/noon/{name}" for name in names)}
    # A scenario is of no use without its work folder.
    with staged(["export", "s3://works/001/scenarios/noon", "--out", "s3://works/kitti"]) as words:
        assert (Path(words[1]).parents[1] / "twin" / "twin.json").is_file()
        make(Path(words[3]).parent, "kitti", "image_2/0.png")
    assert store.exists("works/kitti/artefact.json")
    with staged(["status", "s3://works/001"]) as words:
        (Path(words[1]) / "note.txt").unlink()
    assert not store.exists("works/001/note.txt")


@needs_store
@quiet
@pytest.mark.parametrize("fails_at", range(1, 6))
def test_an_upload_that_was_cut_is_not_read_and_continues(
    store: Any, fails_at: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Cut before each request that writes: files of artefacts, records, options and marks."""
    with staged(BUILD) as words:
        build(words, seed=0)
    expected = content(store, "works")
    store.rm("works/001", recursive=True)
    with staged(BUILD) as words:
        build(words, seed=1)

    calls, upload = 0, StagedTree._upload

    def cut(tree: StagedTree, names: list[str]) -> None:
        nonlocal calls
        calls += 1
        if calls >= fails_at:
            # Half of the files arrive, as when the process is killed.
            upload(tree, names[: len(names) // 2])
            raise ConnectionError("cut")
        upload(tree, names)

    monkeypatch.setattr(StagedTree, "_upload", cut)
    with contextlib.suppress(ArtefactError), staged(BUILD) as words:
        build(words, seed=0)
    monkeypatch.setattr(StagedTree, "_upload", upload)
    with staged(["status", "s3://works/001"]) as words:
        work = Path(words[1])
        for record in work.glob("*/artefact.json"):
            # Those of the first build or of the second, nothing between.
            seed = json.loads(record.read_text())["seed"]
            written = {p.read_bytes()[-1:] for p in record.parent.rglob("*.*") if p != record}
            assert written == {str(seed).encode()}
        assert {p.parent.name for p in work.rglob("*.png")} <= {"a"}
        assert all((work / p.relative_to(work).parts[0] / "artefact.json").exists()
                   for p in work.rglob("*.png"))  # fmt: skip
    with staged(BUILD) as words:
        build(words, seed=0)
    again = content(store, "works")
    assert again.keys() == expected.keys()
    assert all(again[n] == expected[n] for n in expected if not n.endswith("artefact.json"))


@needs_store
@quiet
def test_after_an_error_finished_stages_are_kept(store: Any) -> None:
    def fail(words: list[str]) -> None:
        build(words)
        (Path(words[3]) / ".sky.partial").mkdir()
        (Path(words[3]) / ".sky.partial" / "half.exr").write_bytes(b"half")
        raise InputError("no sky", expected="one")

    with pytest.raises(InputError, match="no sky"), staged(BUILD) as words:
        fail(words)
    names = {name.removeprefix("works/001/").split("/")[0] for name in store.find("works")}
    assert names == {"masks", "twin"}
    with staged(BUILD) as words:
        before = (Path(words[3]) / "masks" / "artefact.json").stat().st_mtime_ns
        build(words)
        assert (Path(words[3]) / "masks" / "artefact.json").stat().st_mtime_ns == before


class Refusing(http.server.BaseHTTPRequestHandler):
    """Proxy of a store that answers every third request with 503."""

    protocol_version = "HTTP/1.1"
    port = 0
    count = 0

    def do_any(self) -> None:
        kind = type(self)
        kind.count += 1
        body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
        if kind.count % 3 == 0:
            return self._answer(503, {}, b"<Error><Code>SlowDown</Code></Error>")
        inner = http.client.HTTPConnection("127.0.0.1", kind.port)
        inner.request(self.command, self.path, body, dict(self.headers))
        answer = inner.getresponse()
        content = answer.read()
        inner.close()
        return self._answer(answer.status, dict(answer.headers), content)

    do_GET = do_PUT = do_HEAD = do_POST = do_DELETE = do_any  # noqa: N815

    def _answer(self, status: int, headers: dict[str, str], content: bytes) -> None:
        self.send_response(status)
        if self.command != "HEAD":
            headers["Content-Length"] = str(len(content))
        for name, value in headers.items():
            if name.lower() not in ("connection", "date", "server", "transfer-encoding"):
                self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(content)

    def log_message(self, format: str, *args: object) -> None:
        pass


@needs_store
@quiet
def test_a_store_that_refuses_requests_gives_the_same_results(
    store: Any, server: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with staged(BUILD) as words:
        build(words)
    expected = content(store, "works")
    store.rm("works/001", recursive=True)
    Refusing.port = server
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Refusing) as proxy:
        threading.Thread(target=proxy.serve_forever, daemon=True).start()
        use(monkeypatch, proxy.server_port, tmp_path / "disk")
        with staged(BUILD) as words:
            build(words)
        proxy.shutdown()
    assert Refusing.count > 20
    found = content(store, "works")
    assert found.keys() == expected.keys()
    assert all(found[n] == expected[n] for n in expected if not n.endswith("artefact.json"))


@needs_store
@pytest.mark.slow
def test_a_full_disk_is_one_error_and_the_next_run_succeeds(store: Any, tmp_path: Path) -> None:
    """A limit on the size of files fails like a full disk, in the middle of a download."""
    script = (
        "import resource, sys; from lightsim.cli import main;"
        "limit = int(sys.argv[1]); resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit));"
        "main(['check', 's3://logs/001', '--out', 's3://works/check'])"
    )
    said = []
    for limit in (100_000, 10**9):
        done = subprocess.run(
            [sys.executable, "-c", script, str(limit)],
            capture_output=True, text=True, check=False, timeout=120,
        )  # fmt: skip
        assert done.returncode == 1
        said.append(done.stderr.strip().splitlines()[-1])
        assert not list((tmp_path / "disk").rglob("*.jpg"))
    assert said[0].startswith("lightsim: error: s3://logs/001: the store cannot be read")
    assert "File too large" in said[0]
    # The recording is no more than a stand-in, which the second run says of its URL.
    assert said[1].startswith("lightsim: error: s3://logs/001")
    assert "store" not in said[1]


@needs_store
@quiet
def test_names_do_not_lead_out_of_the_folder(store: Any, tmp_path: Path) -> None:
    with (
        pytest.raises(InputError, match=r"the URL leads out of its folder"),
        staged(["check", "s3://logs/../../001"]),
    ):
        pass
    store.pipe_file("logs/002/../../../evil", b"x")
    with (
        pytest.raises(InputError, match=r"an object leads out"),
        staged(["check", "s3://logs/002"]),
    ):
        pass
    assert not list(tmp_path.rglob("evil"))


def test_without_the_package_the_error_has_the_command_that_installs_it(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("ray", "s3fs", "gcsfs"):
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.setenv("LIGHTSIM_SCRATCH", str(tmp_path))
    with pytest.raises(MissingDependencyError, match=r"pip install 'lightsim\[gs\]'"):
        open_store("gs")
    with pytest.raises(SystemExit):
        main(["check", "s3://logs/001"])
    assert "pip install 'lightsim[s3]'" in capsys.readouterr().err


def test_other_words_and_batches_are_left_as_they_are(tmp_path: Path) -> None:
    for words in (["check", "logs/001"], ["batch", "build", "l.txt", "--words=--sky s3://a/b"]):
        with staged(words) as same:
            assert same == words
    text = f"{tmp_path}/lightsim-stage-0/0123abcd/s3/works/001: no sky, got 3."
    assert shown(text) == "s3://works/001: no sky, got 3."


def test_what_killed_commands_left_is_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("LIGHTSIM_SCRATCH", str(tmp_path))
    monkeypatch.setattr("lightsim.fleet.staging._download", lambda urls, folder: [])
    left = tmp_path / f"lightsim-stage-{os.getuid()}" / "0123"
    (left / "s3").mkdir(parents=True)
    left.with_suffix(".lock").touch()
    with staged(["check", "s3://logs/001"]):
        assert not left.exists()
