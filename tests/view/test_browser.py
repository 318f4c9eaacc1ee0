"""The viewer in a browser with software graphics, against the CPU renderer.

It is slow there, so bundles and screens are small. Still pictures are drawn in single precision if the device can blend
it, else in half.
"""

import hashlib
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from bitymi_ns.bundle import ktx2, read_bundle
from bitymi_ns.bundle.single import write_single
from bitymi_ns.scene.baked import BakedScene
from bitymi_ns.train.losses import psnr
from bitymi_ns.view import Site, site_of, write_static
from tests.bundle.damage import amend
from tests.cuda.baked_scenes import front
from tests.view.browser import drive, held_back, pixels, plain_server, served
from tests.view.conftest import HEIGHT, WIDTH, view, write

SCREEN = (WIDTH, HEIGHT)
MEAN = 1 / 255
"""Largest mean colour difference; docs/viewer.md states that of a single pixel."""
STATE = "document.documentElement.dataset.state"


def difference(path: Path, bundle: Path | BakedScene, share: float = 1.0) -> tuple[float, float]:
    """Compute the mean and largest difference of a saved picture (of relative size `share`) from the CPU's."""
    scene = bundle if isinstance(bundle, BakedScene) else read_bundle(bundle).scene
    want = scene.render(view().scaled(share)).rgb.clamp(0, 1).numpy()
    got = pixels(path)
    assert got.shape == want.shape
    off = np.abs(got - want)
    return float(off.mean()), float(off.max())


def page_of(site: Site, *before: list[object], path: str = "") -> tuple[str, str]:
    """Open a page; returns its state and text."""
    with served(site) as address:
        ask = [["ask", STATE], ["ask", "document.body.innerText"]]
        state, text = drive([*before, ["goto", address + path], ["settle"], *ask], SCREEN, drawn=False).results[-2:]
    return state, text


@pytest.mark.slow
@pytest.mark.parametrize(
    "format, seen, share, alpha",
    [
        *(("fp16", False, 1.0, False), ("bc7", True, 1.0, False)),
        ("bc7", True, 0.25, False),
        *(("bc7", False, 1.0, True), ("compact", True, 0.25, True)),
    ],
)
def test_frames_are_those_of_the_cpu_renderer(
    format: str, seen: bool, share: float, alpha: bool, tmp_path: Path
) -> None:
    """Formats, and sizes at which surfels are filtered; kinds of view colours: test_frames.py."""
    compact = format == "compact"
    bundle = write(tmp_path / "b", "uint8" if compact else format, compact=compact, seen=seen, alpha=alpha)
    screen = (round(WIDTH * share), round(HEIGHT * share))
    with served(site_of(bundle)) as address:
        found = drive([["goto", address], ["settle"], ["save", "#screenshot", tmp_path / "p.png"]], screen)
    assert not found.problems
    mean, largest = difference(tmp_path / "p.png", bundle, share)
    assert mean < MEAN and largest < 12 / 255


@pytest.mark.slow
def test_of_far_scenes_the_part_with_the_scene_is_drawn(tmp_path: Path) -> None:
    bundle = write(tmp_path / "b", "uint8", compact=True, seen=True, alpha=True, larger=0.7)
    camera = front(WIDTH, HEIGHT, 48.0)  # a sixteenth of the size
    (fx, _, cx), (_, fy, cy), _ = camera.K.tolist()
    place = f"#p=0,0,-48&r=1,0,0,0,0,1&t=0,0,0&l={fx},{fy},{cx},{cy},{WIDTH},{HEIGHT}"
    with served(site_of(bundle)) as address:
        steps = [["goto", address + place], ["settle"], ["save", "#screenshot", tmp_path / "p.png"]]
        assert not drive(steps, SCREEN).problems
    scene = read_bundle(bundle).scene
    how = scene.sampling([camera])
    assert how.samples == 9 and how.part is not None and how.part[2] - how.part[0] < WIDTH // 4
    got = torch.from_numpy(pixels(tmp_path / "p.png"))
    want = scene.render(camera).rgb.clamp(0, 1)
    assert psnr(got, want) > 50.0 and float(want.max()) > 0.2


@pytest.mark.slow
def test_the_first_picture_needs_no_texels(tmp_path: Path) -> None:
    """The server withholds them until that picture is saved; the bundle is one file."""
    bundle = write(tmp_path / "b", "uint8", compact=True, alpha=True)
    single, first = tmp_path / "b.bitymi", tmp_path / "first.png"
    write_single(bundle, single)
    steps = [["first"], ["save", "#screenshot", first], ["settle"], ["save", "#screenshot", tmp_path / "p.png"]]
    with served(held_back(site_of(single), "bundle/texels.bin", first)) as address:
        found = drive([["goto", address], *steps], SCREEN)
    assert not found.problems
    scene = read_bundle(single).scene
    plain = replace(scene, atlas=None, tiles=torch.zeros_like(scene.tiles))
    assert difference(first, plain)[0] < MEAN and difference(tmp_path / "p.png", bundle)[0] < MEAN
    assert difference(first, bundle)[0] > 4 * difference(first, plain)[0]


@pytest.mark.slow
def test_a_shared_link_brings_the_same_picture(bundle: Path, tmp_path: Path) -> None:
    with served(site_of(bundle)) as address:
        first = drive(
            [
                *(["goto", address], ["settle"], ["drag", [60, 60], [90, 80]], ["press", "#share"]),
                *(["ask", "location.href"], ["save", "#screenshot", tmp_path / "a.png"]),
            ],
            SCREEN,
        )
        href = next(r for r in first.results if isinstance(r, str))
        drive([["goto", href], ["settle"], ["save", "#screenshot", tmp_path / "b.png"]], SCREEN)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


HIDE = "Object.defineProperty(Navigator.prototype, 'gpu', { value: undefined })"
NO_ADAPTER = "Object.defineProperty(Navigator.prototype, 'gpu', { value: { requestAdapter: () => null } })"


def test_a_browser_without_webgpu_gets_a_page_that_says_so(bundle: Path) -> None:
    _, text = page_of(site_of(bundle), ["init", HIDE])
    assert "no WebGPU" in text and "Update the browser" in text


@pytest.mark.slow
@pytest.mark.parametrize("script", [HIDE, NO_ADAPTER])
@pytest.mark.parametrize("pictures", [{"preview.jpg": 64, "poster.webp": 32}, {"preview.jpg": 0, "poster.webp": 32}])
def test_without_webgpu_the_preview_is_shown_or_else_the_poster(
    bundle: Path, script: str, pictures: dict[str, int]
) -> None:
    for name, side in pictures.items():
        image = Image.new("RGB", (side or 1, side or 1), (200, 30, 30))
        image.save(bundle / name) if side else (bundle / name).write_bytes(b"no picture")
    amend(bundle, lambda info: info["files"].update({name: stated(bundle / name) for name in pictures}))
    width = "document.getElementById('poster').naturalWidth"
    shown = "document.getElementById('poster').hidden"
    steps = [["until", f"{STATE} === 'picture'"], ["ask", "document.body.innerText"], ["ask", width], ["ask", shown]]
    with served(site_of(bundle)) as address:
        found = drive([["init", script], ["goto", address], *steps], SCREEN, drawn=False)
    text, size, hidden = found.results[-3:]
    assert "No WebGPU here: this is a picture" in text and "Update the browser" not in text
    assert size == (pictures["preview.jpg"] or pictures["poster.webp"]) and hidden is False


def stated(path: Path) -> dict[str, object]:
    return {"bytes": path.stat().st_size, "sha256": hashlib.sha256(path.read_bytes()).hexdigest()}


@pytest.mark.parametrize("damage", ["altered", "newer"])
def test_a_damaged_bundle_gets_a_page_that_says_so(damage: str, bundle: Path) -> None:
    """On a plain server, so that only the browser can detect it."""
    site, name, data = site_of(bundle), "bundle/surfels.ply", (bundle / "surfels.ply").read_bytes()
    newer = json.dumps({**json.loads((bundle / "bundle.json").read_text()), "version": "9.0"}).encode()

    sent: dict[str, dict[str, Callable[[], bytes]]] = {
        "altered": {name: lambda: data[:-4] + bytes([data[-4] ^ 1]) + data[-3:]},
        "newer": {"bundle/bundle.json": lambda: newer},
    }
    state, text = page_of(replace(site, files={**site.files, **sent[damage]}))
    assert state == "error"
    expected = "newer than the viewer" if damage == "newer" else "damaged"
    assert expected in text and ("Update" in text or "Copy the bundle again" in text)


def test_an_exported_folder_is_shown_by_a_plain_file_server(bundle: Path, tmp_path: Path) -> None:
    write_static(site_of(bundle), tmp_path / "site")
    with plain_server(tmp_path / "site", ranges=False) as (address, _):
        found = drive([["goto", address], ["settle"], ["save", "#screenshot", tmp_path / "p.png"]], SCREEN)
    assert not found.problems
    mean, largest = difference(tmp_path / "p.png", bundle)
    assert mean < MEAN and largest < 12 / 255


def test_an_atlas_of_more_pages_than_the_device_takes_is_too_large(tmp_path: Path) -> None:
    bundle = write(tmp_path / "b", "uint8")
    image = ktx2.parse_ktx2((bundle / "atlas.ktx2").read_bytes())
    pages = [bytes(page) for page in image.payload] * 300
    ktx2.write_ktx2(bundle / "atlas.ktx2", pages, "uint8", image.width, image.height, "test")
    amend(bundle, lambda info: info["atlas"].update(layers=len(pages)))
    state, text = page_of(site_of(bundle))
    assert state == "error" and "too large for this device" in text and "300 pages" in text


ERRORS = {
    "refused": (
        "const made = GPUDevice.prototype.createTexture; GPUDevice.prototype.createTexture = function (what) {"
        "return made.call(this, { ...what, size: [16, 16, 100000] }); }",
        "The graphics device reports an error",
    ),
    "no memory": (
        "GPUDevice.prototype.createSampler = function () {"
        "this.dispatchEvent(new GPUUncapturedErrorEvent('uncapturederror', { error: new GPUOutOfMemoryError('') })); }",
        "too large for this device",
    ),
    "lost": (
        "Object.defineProperty(GPUDevice.prototype, 'lost', { get: () => new Promise((resolve) =>"
        "setTimeout(resolve, 1500, { reason: 'unknown', message: 'gone' })) })",
        "The graphics device was lost",
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("what", ERRORS)
def test_what_the_device_says_of_itself_has_a_page(what: str, bundle: Path) -> None:
    """The page stays whatever happens later; for a lost device also after the first picture."""
    script, said = ERRORS[what]
    wait = "new Promise((resolve) => setTimeout(resolve, 2000))"
    with served(site_of(bundle)) as address:
        steps = [["init", script], ["goto", address], ["settle"], ["ask", wait]]
        found = drive(
            [*steps, ["ask", STATE], ["ask", "document.getElementById('page').innerText"]], SCREEN, drawn=False
        )
    assert found.results[-2] == "error" and said in found.results[-1]


def test_a_page_that_is_opened_as_a_file_says_what_to_do(bundle: Path, tmp_path: Path) -> None:
    """Browsers do not load modules from files."""
    write_static(site_of(bundle), tmp_path / "site")
    ask = [["ask", STATE], ["ask", "document.getElementById('page').innerText"]]
    found = drive([["goto", f"file://{tmp_path}/site/index.html"], ["settle"], *ask], SCREEN, drawn=False)
    assert found.results[-2] == "error"
    assert "opened as a file" in found.results[-1] and "web server" in found.results[-1]
    assert "Loading" not in found.results[-1]


@pytest.mark.parametrize("data", [None, b"let let = ;"], ids=["missing", "not understood"])
def test_a_page_whose_script_does_not_run_says_so(data: bytes | None, bundle: Path) -> None:
    site = site_of(bundle)

    def read() -> bytes:
        if data is None:
            raise OSError
        return data

    state, text = page_of(replace(site, files={**site.files, "index.js": read}))
    assert state == "error" and "cannot start" in text and "Reload" in text
