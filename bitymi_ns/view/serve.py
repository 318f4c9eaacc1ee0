"""A small web server for one page and one bundle."""

from __future__ import annotations

import socket
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import unquote, urlsplit

from bitymi_ns.bundle.manifest import BundleError

from .page import POLICY, PageError, Site, media_type

LOOPBACK = "127.0.0.1"
LOCAL_NAMES = ("127.0.0.1", "localhost", "[::1]")
_HEADERS = {
    "Content-Security-Policy": POLICY,
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cache-Control": "no-cache",
}


def serve(site: Site, host: str = LOOPBACK, port: int = 0) -> ThreadingHTTPServer:
    """A server that listens and waits for `serve_forever`; `address_of` says where.

    Args:
        site: what is served; any other path is not found.
        host: address to listen at. On a loopback address, requests that name another host are refused: a page of the
            web could otherwise have its own name point here.
        port: 0 = any that is free.

    Raises:
        PageError: the address cannot be listened at.
    """

    class Handler(BaseHTTPRequestHandler):
        server_version, sys_version = "bitymi", ""
        protocol_version = "HTTP/1.1"

        def do_GET(self) -> None:
            self._answer(True)

        def do_HEAD(self) -> None:
            self._answer(False)

        def _answer(self, body: bool) -> None:
            if is_loopback(host) and not self._is_local():
                self._send(HTTPStatus.FORBIDDEN, b"this server answers requests for this machine alone\n", "", body)
                return
            path = unquote(urlsplit(self.path).path)
            name = "index.html" if path == "/" else path[1:]
            if not path.startswith("/") or name not in site:
                self._send(HTTPStatus.NOT_FOUND, b"there is no such file\n", "", body)
                return
            try:
                data = site.read(name)
            except (BundleError, OSError, MemoryError):
                self._send(HTTPStatus.NOT_FOUND, b"the file cannot be read\n", "", body)
                return
            self._send(HTTPStatus.OK, data, media_type(name), body)

        def _is_local(self) -> bool:
            name = self.headers.get("Host", "").lower()
            return name.rpartition(":")[0] in LOCAL_NAMES or name in LOCAL_NAMES

        def _send(self, status: HTTPStatus, data: bytes | bytearray, kind: str, body: bool) -> None:
            self.send_response(status)
            self.send_header("Content-Type", kind or "text/plain; charset=utf-8")
            self.send_header("Content-Length", str(len(data)))
            for header, value in _HEADERS.items():
                self.send_header(header, value)
            self.end_headers()
            if body:
                self.wfile.write(data)

        def log_message(self, format: str, *args: object) -> None:
            """Says nothing."""

    class Server(ThreadingHTTPServer):
        address_family = socket.AF_INET6 if ":" in host else socket.AF_INET
        daemon_threads = True

        def handle_error(self, request: object, client_address: object) -> None:
            """A browser that goes away in the middle of an answer is no error."""

    try:
        return Server((host, port), Handler)
    except OSError as error:
        raise PageError(f"{host} port {port} cannot be listened at: {error.strerror or error}") from error


def is_loopback(host: str) -> bool:
    """Whether nothing but this machine can reach an address."""
    return host in ("localhost", "::1") or host.startswith("127.")


def address_of(server: ThreadingHTTPServer) -> str:
    """Where a browser on this machine finds the page."""
    host, port = server.server_address[:2]
    shown = LOOPBACK if host in ("0.0.0.0", "::") else f"[{host}]" if ":" in str(host) else host
    return f"http://{shown}:{port}/"
