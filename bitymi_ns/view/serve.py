"""Web server for one page and one bundle."""

from __future__ import annotations

import io
import ipaddress
import socket
import threading
import time
from contextlib import suppress
from dataclasses import dataclass, field
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import unquote, urlsplit

from bitymi_ns.bundle.manifest import BundleError
from .page import PageError, Site, media_type

LOOPBACK = "127.0.0.1"
LOCAL_NAMES = ("127.0.0.1", "localhost", "[::1]")
REQUEST_SECONDS, SEND_SECONDS = 20.0, 60.0  # timeouts of receiving a request and of sending a piece of a response
MOST_CLIENTS = 64  # maximum number of connections; a browser opens six
_BUSY = b"HTTP/1.1 503 Service Unavailable\r\nContent-Length: 0\r\nConnection: close\r\n\r\n"
_PIECE = 1 << 20
_HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cache-Control": "no-cache",
}


class _Timed(io.RawIOBase):
    """Raw reader of a connection with the deadline `until`."""

    def __init__(self, connection: socket.socket) -> None:
        self._connection, self.until = connection, 0.0

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: memoryview) -> int:
        left = self.until - time.monotonic()
        if left <= 0:
            raise TimeoutError
        self._connection.settimeout(left)
        return self._connection.recv_into(buffer)


class _Handler(BaseHTTPRequestHandler):
    """Handler of GET and HEAD for the files of the server's site."""

    server: _Server
    server_version, sys_version = "bitymi", ""
    protocol_version = "HTTP/1.1"

    def setup(self) -> None:
        super().setup()
        self.rfile.close()
        self._timed = _Timed(self.connection)
        self.rfile = io.BufferedReader(self._timed)

    def handle_one_request(self) -> None:
        self._timed.until = time.monotonic() + self.server.request_seconds
        super().handle_one_request()

    def do_GET(self) -> None:
        if not self._is_whole():
            self.send_error(HTTPStatus.BAD_REQUEST)
            return
        if not self.server.is_named(self.headers.get("Host", "")):
            self._send(HTTPStatus.FORBIDDEN, b"this server answers requests for this machine alone\n")
            return
        try:
            path = unquote(urlsplit(self.path).path)
        except ValueError:
            self.send_error(HTTPStatus.BAD_REQUEST)
            return
        name, site = "index.html" if path == "/" else path[1:], self.server.site
        if not path.startswith("/") or name not in site:
            self._send(HTTPStatus.NOT_FOUND, b"there is no such file\n")
            return
        try:
            held = self.server.hold(name)
        except (BundleError, OSError, MemoryError):
            self._send(HTTPStatus.NOT_FOUND, b"the file cannot be read\n")
            return
        try:
            self._send(HTTPStatus.OK, held.data, media_type(name))
        finally:
            self.server.release(held)

    do_HEAD = do_GET

    def _is_whole(self) -> bool:
        """Return True for a request without body and with unambiguous headers."""
        bodies = self.headers.get_all("Content-Length", ["0"]) + self.headers.get_all("Transfer-Encoding", [])
        return set(bodies) == {"0"} and len(self.headers.get_all("Host", [])) < 2 and not self.headers.defects

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Send an error and close the connection."""
        self.close_connection = True
        self.request_version = self.protocol_version  # else malformed requests get a response without headers
        status = HTTPStatus(code)
        self._send(status, f"{status.phrase}\n".encode())

    def _send(self, status: HTTPStatus, data: bytes | bytearray, kind: str = "text/plain; charset=utf-8") -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(data)))
        for header, value in {**_HEADERS, "Content-Security-Policy": self.server.site.policy}.items():
            self.send_header(header, value)
        if self.close_connection:
            self.send_header("Connection", "close")
        self.connection.settimeout(SEND_SECONDS)
        self.end_headers()
        view = memoryview(data if self.command != "HEAD" else b"")
        for at in range(0, len(view), _PIECE):
            self.connection.settimeout(SEND_SECONDS)
            self.wfile.write(view[at : at + _PIECE])

    def log_message(self, format: str, *args: object) -> None:
        """Log nothing."""


@dataclass(eq=False)
class _SharedFile:
    """Contents of a file being sent, shared by all connections that read it."""

    key: tuple[str, object]
    reading: threading.Lock = field(default_factory=threading.Lock)
    data: bytes | bytearray = b""
    readers: int = 0
    is_read: bool = False


class _Server(ThreadingHTTPServer):
    daemon_threads = True

    def __init__(self, site: Site, host: str, port: int, request_seconds: float) -> None:
        self.address_family = socket.AF_INET6 if ":" in host else socket.AF_INET
        self.site, self.request_seconds = site, request_seconds
        self._held: dict[tuple[str, object], _SharedFile] = {}
        self._count_lock, self._connections = threading.Lock(), threading.BoundedSemaphore(MOST_CLIENTS)
        super().__init__((host, port), _Handler)
        self._names = {*LOCAL_NAMES, host.lower(), _shown(self)}

    def is_named(self, host: str) -> bool:
        """Return True if a Host header is allowed: any, unless the server listens on a loopback address."""
        host = host.lower()
        return not is_loopback(self) or host in self._names or host.rpartition(":")[0] in self._names

    def hold(self, name: str) -> _SharedFile:
        """Read a file, shared until `release` was called once per `hold`. Raises as `Site.read`."""
        key = (name, self.site.stamp(name))
        with self._count_lock:
            held = self._held.setdefault(key, _SharedFile(key))
            held.readers += 1
        try:
            with held.reading:
                if not held.is_read:
                    held.data, held.is_read = self.site.read(name), True
        except BaseException:
            self.release(held)
            raise
        return held

    def release(self, held: _SharedFile) -> None:
        with self._count_lock:
            held.readers -= 1
            if not held.readers:
                del self._held[held.key]

    def process_request(self, request: Any, client_address: Any) -> None:
        """Handle a request in a new thread, or respond 503 beyond `MOST_CLIENTS`."""
        if not self._connections.acquire(blocking=False):
            with suppress(OSError):
                request.settimeout(0.0)
                request.send(_BUSY)
            self.shutdown_request(request)
            return
        try:
            super().process_request(request, client_address)
        except BaseException:
            self._connections.release()
            raise

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._connections.release()

    def handle_error(self, request: object, client_address: object) -> None:
        """Ignore errors: a browser may close the connection during a response."""


def serve(
    site: Site, host: str = LOOPBACK, port: int = 0, request_seconds: float = REQUEST_SECONDS
) -> ThreadingHTTPServer:
    """Create a listening server; call its `serve_forever`. On a loopback `host`, requests for another host name are
    refused, against DNS rebinding by web pages. `port`: 0: any free one. `request_seconds`: timeout of receiving a
    request. Raises PageError: the address cannot be used."""
    if not 0 <= port <= 0xFFFF:
        raise PageError(f"the port must be from 0 to 65535, not {port}")
    try:
        return _Server(site, host, port, request_seconds)
    except (OSError, ValueError) as error:  # ValueError: an invalid host name
        why = getattr(error, "strerror", None) or error
        raise PageError(f"cannot listen at {host} port {port}: {why}") from error


def is_loopback(server: ThreadingHTTPServer) -> bool:
    return ipaddress.ip_address(str(server.server_address[0]).partition("%")[0]).is_loopback


def address_of(server: ThreadingHTTPServer) -> str:
    """Return the URL of the page for a browser on this machine."""
    return f"http://{_shown(server)}:{server.server_address[1]}/"


def _shown(server: ThreadingHTTPServer) -> str:
    host = str(server.server_address[0])
    return LOOPBACK if host in ("0.0.0.0", "::") else f"[{host}]" if ":" in host else host
