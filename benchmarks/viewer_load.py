#!/usr/bin/env python
"""What a browser loads until the first picture of a bundle, and until the whole of it, over slow networks.

A server of this script sends the page and the bundle as any web server would (scripts, styles and JSON compressed, the
bundle's other files as they are), no faster than a network allows: all connections share its bits per second, a new
connection and every answer wait for a round trip. It slows down the decoder's worker, too. A headless Chromium shows
the page on a small canvas; where graphics are drawn in software, drawing takes seconds, so the table states beside the
picture's time when the last byte that it needs was sent.

Columns: bytes sent, and seconds from asking for the page, until the poster, until the first picture (of a compact
bundle surfels with their mean colours) and until the picture with all texels; `bytes at` is when the last of the needed
bytes was sent. While the poster comes, surfels do, too: its bytes are all that went until it was there.
"""

from __future__ import annotations

import argparse
import gzip
import math
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from common import number, page, publish, say, table

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from bitymi_ns.bundle.manifest import POSTER
from bitymi_ns.bundle.read import read_manifest
from bitymi_ns.view import Site, site_of
from bitymi_ns.view.page import media_type
from tests.view.browser import drive

COLUMNS = ["bundle", "version", "network"]
for shown in ("poster", "first", "all"):
    COLUMNS += [f"{shown}: bytes", "bytes at, s", "picture at, s"]
NETWORKS = {"10 Mbit/s, 40 ms": (10e6, 0.04), "1.6 Mbit/s, 150 ms": (1.6e6, 0.15), "not slowed": (1e12, 0.0)}
PIECE = 4096  # bytes that a connection sends before another has its turn
TEXELS, SHOWN_FIRST = "bundle/texels.bin", f"bundle/{POSTER}"
WATCH = """(() => {
  const seen = (window.pictureTimes = {});
  new MutationObserver(() => {
    const now = (performance.timeOrigin + performance.now()) / 1000;
    if (document.querySelector('#poster:not([hidden])')) seen.poster ??= now;
    const text = document.getElementById('status')?.textContent;
    if (!text) return;
    seen.first ??= now;
    if (!text.includes('on its way')) seen.all ??= now;
  }).observe(document, { childList: true, subtree: true, characterData: true, attributes: true });
})()"""


@dataclass
class Network:
    """A line that all connections share.

    Attributes:
        rate: bits per second.
        round_trip: seconds.
        sent: path, bytes, the time when the last of them went, and all bytes that went until then, of every answer.
        gone: bytes that went so far.
        begin: time of the first request, None before it.
    """

    rate: float
    round_trip: float
    sent: list[tuple[str, int, float, int]] = field(default_factory=list)
    gone: int = 0
    begin: float | None = None
    _free: float = 0.0
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def wait(self, size: int) -> None:
        """Until so many bytes have gone."""
        with self._lock:
            self._free = max(self._free, time.time()) + 8 * size / self.rate
            self.gone += size
            until = self._free
        time.sleep(max(0.0, until - time.time()))


@contextmanager
def slowly(site: Site, network: Network) -> Iterator[str]:
    """The address of a server behind a network."""

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def setup(self) -> None:
            network.begin = network.begin or time.time()
            time.sleep(network.round_trip)
            super().setup()

        def do_GET(self) -> None:
            time.sleep(network.round_trip)
            name = self.path[1:] or "index.html"
            known = name in site.paths
            data, kind = (site.read(name), media_type(name)) if known else (b"", "text/plain")
            packed = kind.startswith("text/") or kind == "application/json"
            data = gzip.compress(data, 6) if packed else data
            self.send_response(HTTPStatus.OK if known else HTTPStatus.NOT_FOUND)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(data)))
            if packed:
                self.send_header("Content-Encoding", "gzip")
            self.end_headers()
            for at in range(0, len(data), PIECE):
                piece = data[at : at + PIECE]
                network.wait(len(piece))
                self.wfile.write(piece)
            network.sent.append((name, len(data), time.time(), network.gone))

        def log_message(self, format: str, *args: object) -> None:
            """Says nothing."""

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        server.daemon_threads = True
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05}, daemon=True)
        thread.start()
        yield f"http://127.0.0.1:{server.server_address[1]}/"
        server.shutdown()
        thread.join()


def measure(bundle: Path, name: str, screen: tuple[int, int]) -> list[str]:
    """The row of a bundle and a network."""
    network = Network(*NETWORKS[name])
    with slowly(site_of(bundle), network) as address:
        steps: list[list[Any]] = [["init", WATCH], ["goto", address], ["settle"], ["ask", "window.pictureTimes"]]
        found = drive(steps, screen, patience=300)
    if found.problems:
        raise SystemExit("\n".join(found.problems))
    times, begin = found.results[-1], network.begin or 0.0
    whole = [(path, size, at) for path, size, at, _ in network.sent if at <= times["all"]]
    needed = [(path, size, at) for path, size, at in whole if path != TEXELS]
    info = read_manifest(bundle)
    cells = [bundle.name, info.version, name]
    poster = [(at, gone) for path, _, at, gone in network.sent if path == SHOWN_FIRST]
    for at, gone in poster[:1]:
        cells += [f"{gone:,}", number(at - begin, 2), number(times.get("poster", math.nan) - begin, 2)]
    cells += [] if poster else ["", "", ""]
    for part, seen in ((needed, times["first"]), (whole, times["all"])):
        last = max(at for _, _, at in part)
        cells += [f"{sum(size for _, size, _ in part):,}", number(last - begin, 2), number(seen - begin, 2)]
    return cells


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("bundles", nargs="+", type=Path, help="folders, or single files")
    parser.add_argument("--screen", nargs=2, type=int, default=(160, 120), help="pixels of the canvas (%(default)s)")
    parser.add_argument("--output", type=Path, help="also write the Markdown to this file")
    options = parser.parse_args()
    rows = []
    for bundle in options.bundles:
        for name in NETWORKS:
            rows.append(measure(bundle, name, tuple(options.screen)))
            say(" ".join(rows[-1]))
    publish(page("Loading a bundle in a browser", table(COLUMNS, rows)), options.output)
    return 0


if __name__ == "__main__":
    sys.exit(main())
