"""The poster on the page: shown before the surfels, aligned with the first picture, removed with it."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from bitymi_ns.bundle import read_bundle
from bitymi_ns.bundle.manifest import POSTER
from bitymi_ns.bundle.single import write_single
from bitymi_ns.view import Site, single_site, site_of, write_static
from tests.bundle.damage import amend
from tests.view.browser import Outcome, drive, held_back, pixels, plain_server, served
from tests.view.conftest import HEIGHT, WIDTH, view, write
from tests.view.steps import START
from tests.view.test_browser import MEAN, SCREEN, STATE, difference

pytestmark = pytest.mark.slow

SHOWN = "!document.getElementById('poster').hidden"
BARE = (
    "for (const id of ['page', 'top', 'panel', 'menu', 'notice'])"
    "document.getElementById(id).style.visibility = 'hidden'"
)


def kept(site: Site, asked: list[str]) -> Site:
    """Make the site record which files of the bundle are requested."""

    def noted(name: str) -> Callable[[], bytes]:
        def read() -> bytes:
            asked.append(name)
            return site.read(name)

        return read

    return Site({name: noted(name) for name in site.paths})


def shots(bundle: Path, folder: Path, size: tuple[int, int], **options: Any) -> tuple[np.ndarray, np.ndarray, Outcome]:
    """Take pictures of the page with the poster, and with the surfels, without toolbars."""
    first, second = folder / "poster.png", folder / "picture.png"
    steps: list[list[Any]] = [["goto"], ["poster"], ["ask", STATE], ["ask", BARE]]
    steps += [["shot", first], ["settle"], ["ask", SHOWN], ["ask", BARE], ["shot", second]]
    with served(held_back(site_of(bundle), "bundle/surfels.bin", first)) as address:
        steps[0] = ["goto", address]
        found = drive(steps, size, **options)
    assert not found.problems
    return pixels(first), pixels(second), found


@pytest.mark.parametrize(
    "size, options", [(SCREEN, {}), ((150, 260), {"touch": True})], ids=["like the photograph", "phone"]
)
def test_it_is_there_before_the_surfels_and_where_their_picture_will_be(
    size: tuple[int, int], options: dict[str, Any], tmp_path: Path
) -> None:
    bundle = write(tmp_path / "b", "uint8", compact=True, poster=True)
    poster, picture, found = shots(bundle, tmp_path, size, **options)
    assert found.results[2] == "poster" and found.results[6] is False
    k = min(size[0] / WIDTH, size[1] / HEIGHT)
    width, height = round(k * WIDTH), round(k * HEIGHT)
    left, top = (size[0] - width) // 2, (size[1] - height) // 2

    def inside(image: np.ndarray, across: int = 0, down: int = 0) -> np.ndarray:
        return image[top + 6 + down : top + height - 6 + down, left + 6 + across : left + width - 6 + across]

    def off(across: int, down: int) -> float:
        return float(np.abs(inside(poster, across, down) - inside(picture)).mean())

    here = off(0, 0)
    assert here < 0.02
    assert all(here < off(*moved) for moved in ((3, 0), (-3, 0), (0, 3), (0, -3)))


def test_a_link_to_another_view_shows_none(tmp_path: Path) -> None:
    bundle, asked = write(tmp_path / "b", "uint8", compact=True, poster=True), list[str]()
    with served(kept(site_of(bundle), asked)) as address:
        found = drive([["goto", address + START], ["settle"], ["ask", SHOWN]], SCREEN, drawn=False)
    assert not found.problems and found.results[-1] is False
    assert "bundle/texels.bin" in asked and f"bundle/{POSTER}" not in asked


@pytest.mark.parametrize("damage", ["no picture", "missing"])
def test_a_damaged_poster_is_not_shown_and_the_scene_is(damage: str, tmp_path: Path) -> None:
    """Other invalid posters: web/test/poster.test.ts."""
    bundle = write(tmp_path / "b", "uint8", compact=True, poster=True)
    site, path = site_of(bundle), bundle / POSTER
    data = path.read_bytes()
    if damage == "missing":
        path.unlink()
    else:  # with a valid hash
        data = data[:23] + bytes(3) + data[26:]  # the start code
        path.write_bytes(data)
        amend(bundle)
    watch = (
        "window.seen = false; new MutationObserver(() => {"
        "const poster = document.getElementById('poster'); if (poster && !poster.hidden) window.seen = true;"
        "}).observe(document, { subtree: true, attributes: true, childList: true })"
    )
    steps = [["init", watch], ["goto"], ["settle"], ["ask", STATE], ["ask", "window.seen"]]
    with served(site) as address:
        steps[1] = ["goto", address]
        found = drive([*steps, ["save", "#screenshot", tmp_path / "p.png"]], SCREEN)
    assert found.results[3] == "ready" and found.results[4] is False
    if damage != "missing":  # the browser logs a 404
        assert not found.problems
    amend(bundle, lambda info: info["files"].pop(POSTER))
    assert difference(tmp_path / "p.png", bundle)[0] < MEAN


def test_it_is_a_range_of_one_file(tmp_path: Path) -> None:
    bundle = write(tmp_path / "b", "uint8", compact=True, poster=True)
    write_single(bundle, tmp_path / "b.bitymi")
    write_static(single_site(tmp_path / "b.bitymi"), tmp_path / "site")
    size = (bundle / POSTER).stat().st_size
    with plain_server(tmp_path / "site", True) as (address, asked):
        found = drive(
            [["goto", address], ["settle"], ["ask", "document.getElementById('poster').naturalWidth"]],
            SCREEN,
            drawn=False,
        )
    assert not found.problems and found.results[-1] > 0
    # the end, bundle.json, the poster
    assert size <= asked[2][1] <= size + 200


def test_it_is_the_picture_of_the_first_camera(tmp_path: Path) -> None:
    bundle = write(tmp_path / "b", "uint8", compact=True, poster=True)
    picture = Image.open(bundle / POSTER).convert("RGB").resize(SCREEN, Image.Resampling.BICUBIC)
    want = read_bundle(bundle).scene.render(view()).rgb.clamp(0, 1).numpy()
    assert np.abs(np.asarray(picture, np.float32) / 255 - want).mean() < 0.04
