"""An exported page at every address that servers use for it, and a page without its scripts."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

from bitymi_ns.view import single_site, site_of, write_static
from tests.view.browser import drive, running

pytestmark = pytest.mark.slow

TEXT = "document.getElementById('page').innerText"
PLACE = "location.pathname + ' ' + document.documentElement.dataset.state + ' ' + document.title"


class _Clean(SimpleHTTPRequestHandler):
    """Server that hides extensions and serves a folder's page without a slash, like `npx serve`."""

    def send_head(self):  # type: ignore[no-untyped-def]
        path = Path(self.directory) / unquote(urlsplit(self.path).path).lstrip("/")
        if path.is_dir():
            self.path = f"/{(path / 'index.html').relative_to(self.directory)}"
        elif path.with_name(f"{path.name}.html").is_file():
            self.path = f"/{path.relative_to(self.directory)}.html"
        return super().send_head()

    def log_message(self, format: str, *args: object) -> None:
        """Log nothing."""


@contextmanager
def clean_server(folder: Path) -> Iterator[str]:
    with running(ThreadingHTTPServer(("127.0.0.1", 0), partial(_Clean, directory=str(folder)))) as address:
        yield address.rstrip("/")


@pytest.fixture(scope="module")
def splats(bundle: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A web site with another page, whose script has the same name as ours, and exported pages below it."""
    folder = tmp_path_factory.mktemp("web")
    (folder / "index.js").write_text("document.title = 'other';")
    write_static(site_of(bundle), folder / "splats" / "fox")
    write_static(single_site(bundle), folder / "splats" / "one file")
    shutil.copytree(folder / "splats" / "fox", folder / "plain")
    (folder / "plain" / "index.html").rename(folder / "plain" / "fox.html")
    shutil.copytree(folder / "splats" / "fox", folder / "broken")
    (folder / "broken" / "index.js").unlink()
    return folder


@pytest.mark.parametrize("address", ["/splats/fox?x=1", "/splats/fox/index", "/splats/one%20file", "/plain/fox"])
def test_the_scene_is_shown_at_every_address(splats: Path, address: str) -> None:
    with clean_server(splats) as server:
        steps = [["goto", server + address], ["settle"], ["press", "#share"], ["ask", PLACE]]
        found = drive(
            [*steps, ["ask", "location.href"], ["ask", "getComputedStyle(document.body).margin"]], drawn=False
        )
    state, href, margin = found.results[-3:]
    assert state == f"{address.partition('?')[0]} ready little" and margin == "0px"
    assert href.startswith(f"{server}{address}#")


def test_a_page_without_its_script_says_so(splats: Path) -> None:
    with clean_server(splats) as server:
        for address in ("/broken", "/broken/"):
            found = drive([["goto", server + address], ["settle"], ["ask", TEXT]], drawn=False)
            assert "The viewer cannot start" in found.results[-1] and "index.html at the end" in found.results[-1]
            assert "If this stays" not in found.results[-1]


def test_a_page_whose_scripts_are_forbidden_says_so(splats: Path, tmp_path: Path) -> None:
    page = shutil.copytree(splats / "splats" / "fox", tmp_path / "page") / "index.html"
    page.write_text(page.read_text().replace("script-src 'self'", "script-src 'none'; x 'self'"))
    with clean_server(tmp_path) as server:
        said = f"{TEXT}.includes('If this stays, the scripts of this page are not loaded')"
        assert drive([["goto", f"{server}/page/"], ["ask", said], ["until", said]]).results[1] is False
