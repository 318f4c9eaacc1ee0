"""A headless Chromium, for tests."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from threading import Thread
from typing import Any

from bitymi_ns.view import Site, address_of, serve
from tests.required import skip_without

HERE = Path(__file__).resolve().parent
MODULES = HERE.parents[1] / "web" / "node_modules"


@dataclass
class Outcome:
    """What the steps gave, and what the page complained of."""

    results: list[Any]
    problems: list[str]


def drive(
    steps: Sequence[Sequence[Any]],
    viewport: tuple[int, int] = (320, 240),
    touch: bool = False,
    scheme: str = "light",
    ratio: float = 1.0,
    patience: float = 90.0,
) -> Outcome:
    """Runs steps of drive.mjs; skips the test where there is no browser."""
    node, chromium = shutil.which("node"), shutil.which("chromium") or shutil.which("google-chrome")
    if node is None or chromium is None:
        skip_without("browser", "no node or no chromium: apt install nodejs chromium")
    if not (MODULES / "playwright-core").is_dir():
        skip_without("browser", "web/node_modules is missing: make web-test")
    job = {
        "steps": [[str(x) if isinstance(x, Path) else x for x in step] for step in steps],
        "viewport": {"width": viewport[0], "height": viewport[1]},
        "touch": touch,
        "scheme": scheme,
        "ratio": ratio,
        "patience": patience,
    }
    command = [node, str(HERE / "drive.mjs"), str(MODULES), chromium]
    done = subprocess.run(
        command, input=json.dumps(job), capture_output=True, text=True, timeout=max(400, 3 * patience), check=False
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    return Outcome(found["results"], found["problems"])


@contextmanager
def served(site: Site) -> Iterator[str]:
    """The address of a server in a thread of this process."""
    server = serve(site)
    thread = Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05})
    thread.start()
    try:
        yield address_of(server)
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
