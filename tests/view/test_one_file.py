"""An exported page with its bundle as one file, on servers with and without ranges."""

import json
from pathlib import Path

import pytest

from bitymi_ns.bundle import read_bundle
from bitymi_ns.bundle.single import write_single
from bitymi_ns.cli import main
from bitymi_ns.view import single_site, write_static
from tests.view.browser import drive, plain_server
from tests.view.conftest import WIDTH, write
from tests.view.test_browser import MEAN, SCREEN, STATE, difference

pytestmark = pytest.mark.slow

NAME = "scene.bitymi"


def test_the_command_writes_the_page_and_one_file(bundle: Path, tmp_path: Path, capsys) -> None:
    folder = tmp_path / "site"
    assert main(["view", str(bundle), "--export", str(folder), "--one-file"]) == 0
    names = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    assert {"index.html", "index.js", "view.json", NAME} <= names and not any("/" in name for name in names)
    assert f'name="bundle" content="{NAME}"' in (folder / "index.html").read_text()
    assert json.loads((folder / "view.json").read_text()) == {"title": "little", "notes": False}
    assert len(read_bundle(folder / NAME)) == len(read_bundle(bundle))
    single = tmp_path / "little.bitymi"
    write_single(bundle, single)
    # an earlier export of either kind is replaced
    assert main(["view", str(single), "--export", str(folder), "--one-file", "--overwrite"]) == 0
    assert (folder / NAME).read_bytes() == single.read_bytes()
    assert main(["view", str(single), "--export", str(folder), "--overwrite"]) == 0
    assert not (folder / NAME).exists() and (folder / "bundle" / "bundle.json").is_file()
    assert main(["view", str(bundle), "--one-file"]) == 1
    assert "--export" in capsys.readouterr().err


@pytest.mark.parametrize("ranges", [True, False], ids=["ranges", "whole"])
def test_one_file_is_shown(ranges: bool, tmp_path: Path) -> None:
    bundle = write(tmp_path / "b", "uint8", compact=True)
    write_static(single_site(bundle), tmp_path / "site")
    picture, width = tmp_path / "p.png", "document.getElementById('photograph-image').naturalWidth"
    steps = [["settle"], ["save", "#screenshot", picture], ["press", "#beside"], ["loaded", "#photograph-image"]]
    with plain_server(tmp_path / "site", ranges) as (address, asked):
        found = drive([["goto", address], *steps, ["ask", width]], SCREEN)
    assert not found.problems
    assert difference(picture, bundle)[0] < MEAN and found.results[-1] == WIDTH
    size = (tmp_path / "site" / NAME).stat().st_size
    if not ranges:
        assert [count for _, count in asked] == [size]
        return
    # the end, bundle.json, cameras.json, surfels, texels and the photograph, once each, in order of need
    assert asked[0][0] == "bytes=-16384" and len(asked) == 6
    texels = (bundle / "texels.bin").stat().st_size
    assert [texels <= count <= texels + 200 for _, count in asked].index(True) == 4
    assert sum(count for _, count in asked) < size + 16384 + 1000


@pytest.mark.parametrize(
    "query, words",
    [
        ("?file=altered.bitymi", "damaged"),
        ("?file=none.bitymi", "There is no bundle"),
        ("?file=../scene.bitymi", "not the name"),
        ("?file=whole.bitymi", ""),
        ("?file=photograph.bitymi", ""),
    ],
)
def test_another_file_beside_the_page(query: str, words: str, bundle: Path, tmp_path: Path) -> None:
    site = tmp_path / "site"
    write_static(single_site(bundle), site)
    data = (site / NAME).read_bytes()
    (site / "whole.bitymi").write_bytes(data)
    at = data.index(b"end_header") + 40  # in the rows of surfels.ply
    (site / "altered.bitymi").write_bytes(data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :])
    at = data.index(b"JFIF")  # of the photograph, which is not drawn
    (site / "photograph.bitymi").write_bytes(data[:at] + b"x" + data[at + 1 :])
    ask = [["ask", STATE], ["ask", "document.body.innerText"], ["ask", "document.title"]]
    if "photograph" in query:
        told = "document.getElementById('notice').textContent.includes('photograph-0001.jpg is altered')"
        ask = [["press", "#beside"], ["until", told], *ask]
    with plain_server(site, True) as (address, _):
        found = drive([["goto", address + query], ["settle"], *ask], SCREEN, drawn=False)
    state, text, title = found.results[-3:]
    if words:
        assert state == "error" and words in text
    else:
        assert state == "ready" and title == query[6:].removesuffix(".bitymi")
