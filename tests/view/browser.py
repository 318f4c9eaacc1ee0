"""A headless Chromium shared by the tests of a process, with a separate context for each."""

import atexit
import http.server
import json
import re
import select
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np
from PIL import Image

from bitymi_ns.view import Site, address_of, serve
from tests.required import skip_without

HERE = Path(__file__).resolve().parent
MODULES = HERE.parents[1] / "web" / "node_modules"


@dataclass
class Outcome:
    """Results of the steps, and errors on the page's console."""

    results: list[Any]
    problems: list[str]


@lru_cache(maxsize=1)
def driver() -> subprocess.Popen[str]:
    """Start drive.mjs, which ends with this process; skip the test without a browser."""
    node, chromium = shutil.which("node"), shutil.which("chromium") or shutil.which("google-chrome")
    if node is None or chromium is None:
        skip_without("browser", "no node or no chromium: apt install nodejs chromium")
    if not (MODULES / "playwright-core").is_dir():
        skip_without("browser", "web/node_modules is missing: make web-test")
    command = [node, str(HERE / "drive.mjs"), str(MODULES), chromium]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1)

    def end() -> None:
        if process.stdin is not None:
            process.stdin.close()
        try:
            process.wait(timeout=20)
        except subprocess.TimeoutExpired:
            process.kill()

    atexit.register(end)
    return process


def drive(
    steps: Sequence[Sequence[Any]],
    viewport: tuple[int, int] = (320, 240),
    touch: bool = False,
    drawn: bool = True,
    ratio: float = 1.0,
    patience: float = 90.0,
) -> Outcome:
    """Run steps of drive.mjs in a new page.

    `drawn`: False for a page without shaders, which opens several times faster; its pictures are black, nothing has a
    depth, and everything else is as ever. `patience`: seconds allowed per step.
    """
    process = driver()
    assert process.stdin is not None and process.stdout is not None
    job = {
        "steps": [[str(x) if isinstance(x, Path) else x for x in step] for step in steps],
        "drawn": drawn,
        "viewport": {"width": viewport[0], "height": viewport[1]},
        "touch": touch,
        "ratio": ratio,
        "patience": patience,
    }
    process.stdin.write(json.dumps(job) + "\n")
    ready = select.select([process.stdout], [], [], max(400, 3 * patience))[0]
    line = process.stdout.readline() if ready else ""
    if not line:
        process.kill()
        driver.cache_clear()
        raise AssertionError("the browser does not answer")
    found = json.loads(line)
    assert "error" not in found, found["error"]
    return Outcome(found["results"], found["problems"])


@contextmanager
def running(server: Any) -> Iterator[str]:
    """Run a server of the viewer in a thread; yields its address."""
    thread = Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
    thread.start()
    try:
        yield address_of(server)
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def served(site: Site, **options: Any) -> AbstractContextManager[str]:
    return running(serve(site, **options))


def wait(until: Callable[[], object], tenths: int = 100) -> bool:
    """Wait until something holds, for some tenths of a second at most; returns whether it does."""
    for _ in range(tenths):
        if until():
            return True
        time.sleep(0.1)
    return False


def held_back(site: Site, name: str, until: Path) -> Site:
    """Make the site withhold a file until another one exists."""

    def late() -> bytes:
        wait(until.exists, 600)
        return site.read(name)

    return replace(site, files={**site.files, name: late})


def pixels(picture: Path) -> np.ndarray:
    """Read a picture: float32 [H, W, 3] in [0, 1]."""
    return np.asarray(Image.open(picture).convert("RGB"), np.float32) / 255


@contextmanager
def plain_server(folder: Path, ranges: bool) -> Iterator[tuple[str, list[tuple[str, int]]]]:
    """Serve a folder like a plain file server.

    Yields its address, and range and response bytes of requests for bundles in one file.
    """
    asked: list[tuple[str, int]] = []

    class Plain(http.server.SimpleHTTPRequestHandler):
        def do_GET(self) -> None:
            span = re.fullmatch(r"bytes=(\d*)-(\d*)", self.headers.get("Range") or "")
            path = Path(self.translate_path(self.path))
            if path.suffix != ".bitymi" or not path.is_file():
                super().do_GET()
                return
            data = path.read_bytes()
            first, last = 0, len(data) - 1
            if ranges and span:
                first = int(span[1]) if span[1] else max(0, len(data) - int(span[2]))
                last = min(int(span[2]), last) if span[1] and span[2] else last
            asked.append((self.headers.get("Range") or "", last - first + 1))
            self.send_response(206 if ranges and span else 200)
            if ranges and span:
                self.send_header("Content-Range", f"bytes {first}-{last}/{len(data)}")
            self.send_header("Content-Length", str(last - first + 1))
            self.end_headers()
            self.wfile.write(data[first : last + 1])

        def log_message(self, format: str, *args: object) -> None:
            """Log nothing."""

    with running(http.server.ThreadingHTTPServer(("127.0.0.1", 0), partial(Plain, directory=str(folder)))) as address:
        yield address, asked
