"""The web server of the viewer: one port, only this machine by default, no cross-origin requests.

Viser listens on all interfaces by default, takes the next port if one is in use, and accepts
WebSocket connections from any page. The functions here change all three.
"""

from __future__ import annotations

import contextlib
import io
import ipaddress
import logging
import socket
import threading
from collections.abc import Callable, Generator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn
from urllib.parse import unquote, urlsplit

from lightsim.errors import InputError, need

if TYPE_CHECKING:
    import viser

LOOPBACK = ("127.0.0.1", "localhost", "::1")
"""Hosts on which only this machine can connect."""
# Status of a refused request (RFC 9110).
_FORBIDDEN = 403
_RESULTS = "/scenarios/"
# Types of the files of results that are served.
_KINDS = {".html": "text/html; charset=utf-8", ".png": "image/png", ".mp4": "video/mp4"}
# Largest upload, in bytes: an HDR sky of 8192 x 4096 pixels as OpenEXR with half floats. Viser
# reads an upload into memory.
MAX_UPLOAD_BYTES = 256 * 1024 * 1024
_starting = threading.Lock()


def open_server(host: str, port: int, results: Path | None = None) -> viser.ViserServer:
    """Return a running server.

    Args:
        host: name or address of the interface.
        port: 1 to 65535; 0 takes a free one.
        results: folder WORK/scenarios, whose reports are served as /scenarios/...; None: none.

    Raises:
        InputError: the port is in use, or the host is not one of this machine.
        MissingDependencyError: viser is not installed.
    """
    viser = need("viser", extra="view")
    serving = need("websockets.asyncio.server", extra="view")
    _check_free(host, port)
    # Each connection is a line at the level INFO.
    logging.getLogger("websockets").setLevel(logging.WARNING)
    # Viser starts its thread in the constructor and prints a table.
    with _starting, _guarded(serving, host, results), contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host=host, port=port, verbose=False)
    if port and server.get_port() != port:
        stop_server(server)
        raise _port_in_use(host, port)
    # The tunnel would publish the viewer through a server on the internet.
    server.request_share_url = _refuse_tunnel
    _bound_uploads(server)
    return server


def stop_server(server: viser.ViserServer) -> None:
    """Stop a server and close its connections."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


def ssh_line(port: int) -> str:
    """Return the command that makes the viewer of this machine visible on another one."""
    return f"ssh -N -L {port}:127.0.0.1:{port} {socket.gethostname()}"


def is_same_origin(headers: Mapping[str, str], host: str) -> bool:
    """Return True if a request comes from the viewer's own page or from no page.

    The header Host must be a name of the server, otherwise a page could reach the server through a
    domain that resolves to this machine (DNS rebinding). The header Origin must equal it, so that
    pages of other origins cannot control the viewer.

    Args:
        headers: of an HTTP or WebSocket request.
        host: of the server.
    """
    place = headers.get("Host", "")
    origin = headers.get("Origin")
    try:
        name = urlsplit(f"//{place}").hostname or ""
    except ValueError:
        return False
    if name not in (*LOOPBACK, host) and not (host not in LOOPBACK and _is_address(name)):
        return False
    return origin is None or origin in (f"http://{place}", f"https://{place}")


def _is_address(name: str) -> bool:
    if name == socket.gethostname():
        return True
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


@contextlib.contextmanager
def _guarded(serving: Any, host: str, results: Path | None) -> Generator[None]:
    """Check the origin of all requests to servers started in this context, and serve reports."""
    serve: Callable[..., Any] = serving.serve

    def guarded_serve(*args: Any, process_request: Any = None, **options: Any) -> Any:
        def check(connection: Any, request: Any) -> Any:
            if not is_same_origin(request.headers, host):
                return connection.respond(
                    _FORBIDDEN, "The viewer refuses requests of other pages.\n"
                )
            if results is not None and request.path.startswith(_RESULTS):
                return _result(connection, results, unquote(urlsplit(request.path).path))
            return process_request(connection, request) if process_request else None

        return serve(*args, process_request=check, **options)

    serving.serve = guarded_serve
    try:
        yield
    finally:
        serving.serve = serve


def _result(connection: Any, results: Path, path: str) -> Any:
    """Return the response with a file of a result: report, picture or video."""
    file = results / path.removeprefix(_RESULTS)
    kind = _KINDS.get(file.suffix)
    if kind is None or not _is_inside(results, file):
        return connection.respond(404, "There is no such result.\n")
    response = connection.respond(200, "")
    response.body = file.read_bytes()
    for name, value in (("Content-Type", kind), ("Content-Length", str(len(response.body)))):
        del response.headers[name]
        response.headers[name] = value
    return response


def _bound_uploads(server: viser.ViserServer) -> None:
    """Drop uploads that are announced as larger than `MAX_UPLOAD_BYTES`; viser accepts any size."""
    messages = need("viser._messages", extra="view")
    unfinished = server.gui._current_file_upload_states  # pyright: ignore[reportPrivateUsage]

    def check(client_id: int, message: Any) -> None:
        if message.size_bytes <= MAX_UPLOAD_BYTES:
            return
        # Parts of an unknown upload are ignored.
        unfinished.pop(message.transfer_uuid, None)
        client = server.get_clients().get(client_id)
        if client is not None:
            limit = f"at most {MAX_UPLOAD_BYTES // 2**20} MB can be uploaded"
            client.add_notification("Too large", f"{message.filename[:80]}: {limit}", color="red")

    # Handlers of one message are called in the order of registration: this one after viser's own.
    server._websock_server.register_handler(  # pyright: ignore[reportPrivateUsage]
        messages.FileTransferStartUpload, check
    )


def _is_inside(folder: Path, file: Path) -> bool:
    """Return True for an existing file of a folder; links and .. must not lead out of it."""
    try:
        return file.resolve().is_relative_to(folder.resolve()) and file.is_file()
    except (OSError, ValueError):  # names that are too long, or contain a null character
        return False


def _check_free(host: str, port: int) -> None:
    """Raise an InputError if a host is unknown here or a port is in use."""
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM
        )[0]
        with socket.socket(family, kind, protocol) as probe:
            # Like the server, treat a port whose last connection is closing as free.
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
    except socket.gaierror as error:
        raise InputError(
            "the host is unknown", where="--host", got=host, expected="127.0.0.1 or an own address"
        ) from error
    except OSError as error:
        raise _port_in_use(host, port) from error


def _port_in_use(host: str, port: int) -> InputError:
    return InputError(
        "the viewer cannot listen there: the port is in use, reserved, or not of this machine",
        where=f"--host {host} --port {port}",
        expected="a free port",
        remedy="Choose another --port, or 0 for a free one.",
    )


def _refuse_tunnel(verbose: bool = True) -> NoReturn:
    raise InputError(
        "tunnels to the internet are switched off", where="the viewer", remedy="Use ssh -L."
    )
