"""The web server of the viewer: its port, whom it answers, and which files it serves."""

from __future__ import annotations

import http.client
import socket
from collections.abc import Generator
from pathlib import Path
from typing import Any

import pytest

from lightsim.app.server import is_same_origin, open_server, ssh_line, stop_server
from lightsim.errors import InputError

viser = pytest.importorskip("viser")
LOCAL, SHARED = "127.0.0.1", "0.0.0.0"
REPORT = b"<!doctype html><title>report</title>"


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """WORK/scenarios with a report, and files that must not be served."""
    folder = tmp_path_factory.mktemp("work") / "scenarios"
    (folder / "evening").mkdir(parents=True)
    (folder / "evening" / "report.html").write_bytes(REPORT)
    (folder / "evening" / "scenario.json").write_text("{}")
    (folder.parent / "secret.html").write_text("secret")
    (folder / "evening" / "link.html").symlink_to(folder.parent / "secret.html")
    return folder


@pytest.fixture(scope="module")
def server(results: Path) -> Generator[Any]:
    server = open_server(LOCAL, 0, results)
    yield server
    stop_server(server)


@pytest.mark.parametrize(
    ("host", "headers", "is_accepted"),
    [
        (LOCAL, {"Host": "127.0.0.1:8080"}, True),
        (LOCAL, {"Host": "localhost:8080"}, True),
        (LOCAL, {"Host": "[::1]:8080"}, True),
        (LOCAL, {"Host": "127.0.0.1:8080", "Origin": "http://127.0.0.1:8080"}, True),
        (LOCAL, {"Host": "localhost:9000", "Origin": "https://localhost:9000"}, True),
        # Another page of this machine, a file, and a page of the internet.
        (LOCAL, {"Host": "127.0.0.1:8080", "Origin": "http://127.0.0.1:8081"}, False),
        (LOCAL, {"Host": "127.0.0.1:8080", "Origin": "null"}, False),
        (LOCAL, {"Host": "127.0.0.1:8080", "Origin": "https://example.org"}, False),
        # Names of others that resolve to this machine.
        (LOCAL, {"Host": "example.org"}, False),
        (LOCAL, {"Host": "example.org", "Origin": "http://example.org"}, False),
        (LOCAL, {"Host": "192.168.1.2:8080"}, False),
        (LOCAL, {"Host": "127.0.0.1.example.org"}, False),
        (LOCAL, {"Host": "[::1"}, False),
        (LOCAL, {}, False),
        (SHARED, {"Host": "192.168.1.2:8080", "Origin": "http://192.168.1.2:8080"}, True),
        (SHARED, {"Host": f"{socket.gethostname()}:8080"}, True),
        (SHARED, {"Host": "example.org:8080", "Origin": "http://example.org:8080"}, False),
    ],
)
def test_only_the_viewers_own_page_is_answered(
    host: str, headers: dict[str, str], is_accepted: bool
) -> None:
    assert is_same_origin(headers, host) is is_accepted


def answer(server: Any, path: str, **headers: str) -> tuple[int, bytes, str]:
    """Status, body and type of the answer to a request."""
    connection = http.client.HTTPConnection(LOCAL, server.get_port(), timeout=10.0)
    connection.request("GET", path, headers={k.replace("_", "-"): v for k, v in headers.items()})
    response = connection.getresponse()
    try:
        return response.status, response.read(), response.headers.get("Content-Type", "")
    finally:
        connection.close()


def test_the_page_is_served_and_requests_of_other_pages_are_refused(server: Any) -> None:
    status, page, _ = answer(server, "/")
    assert status == 200
    assert b"<html" in page
    assert answer(server, "/", Host="example.org")[0] == 403
    assert answer(server, "/", Origin="https://example.org")[0] == 403


def test_a_websocket_of_another_page_is_refused(server: Any) -> None:
    upgrade = {
        "Connection": "Upgrade",
        "Upgrade": "websocket",
        "Sec_WebSocket_Version": "13",
        "Sec_WebSocket_Key": "dGhlIHNhbXBsZSBub25jZQ==",
        "Sec_WebSocket_Protocol": f"viser-v{viser.__version__}",
    }
    assert answer(server, "/", Origin="https://example.org", **upgrade)[0] == 403
    assert answer(server, "/", Host="example.org", **upgrade)[0] == 403
    own = f"http://{LOCAL}:{server.get_port()}"
    assert answer(server, "/", Origin=own, **upgrade)[0] == 101


def test_reports_of_results_are_served(server: Any) -> None:
    status, body, kind = answer(server, "/scenarios/evening/report.html?frame=1")
    assert (status, body) == (200, REPORT)
    assert kind == "text/html; charset=utf-8"


@pytest.mark.parametrize(
    "path",
    [
        "evening/scenario.json",  # no report
        "evening/missing.html",
        "evening",
        "",
        "../secret.html",
        "..%2Fsecret.html",
        "evening/../../secret.html",
        "evening/link.html",  # leads out of the folder
        "/etc/hostname",
        "%00.html",
        f"{'x' * 5000}.html",
    ],
)
def test_nothing_else_is_served(server: Any, path: str) -> None:
    assert answer(server, f"/scenarios/{path}")[0] == 404


def test_a_port_in_use_is_an_input_error() -> None:
    with socket.socket() as other:
        other.bind((LOCAL, 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(InputError, match=f"--port {port}.*0 for a free one"):
            open_server(LOCAL, port)


def test_an_unknown_host_is_an_input_error() -> None:
    with pytest.raises(InputError, match=r"--host.*no-such-host\.invalid"):
        open_server("no-such-host.invalid", 0)


def test_tunnels_are_switched_off(server: Any) -> None:
    with pytest.raises(InputError, match="tunnels"):
        server.request_share_url()


def test_a_stopped_server_frees_its_port() -> None:
    first = open_server(LOCAL, 0)
    port = first.get_port()
    stop_server(first)
    again = open_server(LOCAL, port)
    assert again.get_port() == port
    assert f"-L {port}:127.0.0.1:{port} " in ssh_line(port)
    stop_server(again)
