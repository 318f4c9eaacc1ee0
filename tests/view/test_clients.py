"""Many and slow clients of the viewer's server: one shared copy of a file, a limit on connections."""

import http.client
import socket
import sys
from contextlib import suppress
from urllib.parse import urlsplit

import pytest

from bitymi_ns.view import serve
from bitymi_ns.view.page import Site
from tests.view.browser import running, served, wait
from tests.view.test_serve import ask


def clients(address: str, path: str, count: int) -> list[socket.socket]:
    """Open connections that request a file and read nothing."""
    parts = urlsplit(address)
    found = []
    for _ in range(count):
        client = socket.create_connection((parts.hostname, parts.port), timeout=20)
        client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        client.sendall(f"GET {path} HTTP/1.1\r\nHost: {parts.netloc}\r\n\r\n".encode())
        found.append(client)
    return found


@pytest.mark.slow
def test_slow_clients_share_one_copy_of_a_file() -> None:
    made: list[int] = []

    def read() -> bytes:
        made.append(1)
        return bytes(16 << 20)

    site = Site({"index.html": lambda: b"", "large": read})
    server = serve(site)
    with running(server) as address:
        waiting = clients(address, "/large", 20)
        assert [client.recv(8) for client in waiting] == [b"HTTP/1.1"] * 20  # all are served
        assert len(made) == 1
        for client in waiting:
            client.close()
        assert wait(lambda: not server._held)  # freed
        assert ask(address, "/large")[2] == bytes(16 << 20) and len(made) == 2


def test_connections_are_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys.modules["bitymi_ns.view.serve"], "MOST_CLIENTS", 3)
    with served(Site({"index.html": lambda: b"", "large": lambda: bytes(16 << 20)})) as address:
        waiting = clients(address, "/large", 3)
        assert [client.recv(8) for client in waiting] == [b"HTTP/1.1"] * 3
        said = b""
        with suppress(ConnectionError):  # the response is lost if the connection ends first
            said = clients(address, "/", 1)[0].recv(12)
        assert said in (b"HTTP/1.1 503", b"")
        waiting.pop().close()

        def served_again() -> bool:
            with suppress(ConnectionError, http.client.HTTPException):
                return ask(address, "/")[0] == 200
            return False

        assert wait(served_again)
        for client in waiting:
            client.close()
