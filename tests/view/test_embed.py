"""The page embedded in another origin: messages (`docs/viewer.md`) and their permissions."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from bitymi_ns.bundle.single import write_single
from bitymi_ns.view import single_site, write_static
from tests.bundle.test_notes import text
from tests.view.browser import drive, plain_server

pytestmark = pytest.mark.slow

HOST = """<!doctype html><link rel="icon" href="data:,"><iframe id="a" src="{a}"></iframe>
<iframe id="b" src="{b}"></iframe>
<script>
window.got = [];
const sender = (window) => (window === a.contentWindow ? 'a' : window === b.contentWindow ? 'b' : 'one gone');
addEventListener('message', (e) => got.push({{ from: sender(e.source), ...e.data }}));
window.post = (id, data) => window[id].contentWindow.postMessage(data, '*');
window.of = (type) => got.filter((m) => m.type === 'bitymi/1/' + type);
</script>"""


def test_messages_of_the_page_around(bundle: Path, tmp_path: Path) -> None:
    shutil.copytree(bundle, noted := tmp_path / bundle.name)
    (noted / "notes.json").write_bytes(text())
    site = single_site(noted)
    for name in ("open", "closed"):
        write_static(site, tmp_path / "pages" / name)
    write_single(bundle, tmp_path / "pages/open/second.bitymi")
    host = tmp_path / "host"
    host.mkdir()
    moved = {"position": [0, -4, 0], "right": [1, 0, 0], "forward": [0, 1, 0], "target": [0, 0, 0]}
    moved["lens"] = [500, 500, 250, 250, 500, 500]
    bad = [{**moved, "right": [2, 0, 0]}, {**moved, "lens": [0] * 6}, {**moved, "position": ["0", 0, 0]}, None]
    files = ["../second.bitymi", "https://example.org/a.bitymi", "//example.org/a.bitymi", "a.json", 5]
    with plain_server(tmp_path / "pages", True) as (pages, _), plain_server(host, True) as (address, _):
        index = tmp_path / "pages/open/index.html"
        empty = '<meta name="embedders" content="" />'
        assert empty in index.read_text()
        index.write_text(index.read_text().replace(empty, empty.replace('""', f'"{address[:-1]}"')))
        (host / "index.html").write_text(HOST.format(a=f"{pages}open/", b=f"{pages}closed/"))

        def send(of: str, frame: str = "a", **content: object) -> list[object]:
            return ["ask", f"post('{frame}', {json.dumps({'type': f'bitymi/1/{of}', **content})})"]

        found = drive(
            [
                ["goto", address],
                ["until", "of('ready').length === 1"],
                send("get-camera", id=7),
                ["until", "of('camera').some((m) => m.id === 7)"],
                send("set-camera", camera=moved),
                ["until", "of('camera').some((m) => m.camera.position[1] === -4)"],
                send("list-views", id=8),
                ["until", "of('views').some((m) => m.id === 8 && m.views.join() === 'door,Tür <b>')"],
                send("go-to-view", name="door"),
                ["until", "of('camera').some((m) => m.camera.position.join() === '0,-3,0.5')"],
                send("go-to-view", id=9, name="window"),
                *(send("set-camera", id=k, camera=camera) for k, camera in enumerate(bad)),
                *(send("load", id=10 + k, file=file) for k, file in enumerate(files)),
                send("explode", id=20),
                *(send(of, "b", id=30, file="") for of in ("get-camera", "load", "explode")),
                ["until", "of('error').some((m) => m.id === 20)"],
                ["ask", "of('error').map((m) => m.id)"],
                send("load", file="second.bitymi"),
                ["until", "of('ready').length === 2"],
                ["ask", "of('ready')"],
                send("load", file="missing.bitymi"),
                ["until", "of('error').some((m) => m.title === 'There is no bundle')"],
                ["ask", "got.filter((m) => m.from === 'b').length"],
            ],
            drawn=False,
            viewport=(700, 200),
        )
        hidden = ["init", "Object.defineProperty(Navigator.prototype, 'gpu', { value: undefined })"]
        told = ["until", "of('error').some((m) => m.title === 'This browser has no WebGPU')"]
        drive([hidden, ["goto", address], told], drawn=False)
    errors, ready, strangers = found.results[-7], found.results[-4], found.results[-1]
    assert errors == [9, 0, 1, 2, 3, 10, 11, 12, 13, 14, 20] and strangers == 0
    assert [each["title"] for each in ready] == [bundle.name, "second"]
    assert np.allclose(ready[0]["camera"]["position"], ready[1]["camera"]["position"])
    assert not [problem for problem in found.problems if "404" not in problem]
