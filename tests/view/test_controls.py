"""Every control of the viewer in a browser changes the view or the picture as documented.

Views are read from links; `docs/viewer.md` lists the controls.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from bitymi_ns.bake import export
from tests.view.conftest import baked_scene
from tests.view.steps import MIDDLE, PHONE, START, Steps

pytestmark = pytest.mark.slow


def by(across: int, down: int) -> list[tuple[int, int]]:
    return [MIDDLE, (MIDDLE[0] + across, MIDDLE[1] + down)]


def test_orbit_slide_and_wheel(bundle: Path) -> None:
    page = Steps()
    start = page.view()
    page.do(["drag", *by(80, 0)])
    right = page.view()
    page.do(["key", "h"], ["ask", f"location.hash = '{START}'"], ["drag", *by(0, 60)])
    down = page.view()
    slides = []
    for drag in (
        [["drag", *by(90, 0), "right"]],
        [["hold", "Shift"], ["drag", *by(0, 60)], ["release", "Shift"]],
        [["drag", *by(-50, 0), "middle"]],
    ):
        page.do(*drag)
        slides.append(page.view())
    wheels = []
    for turned in (-300, 500):
        page.do(["wheel", MIDDLE, turned])
        wheels.append(page.view())
    page.run(bundle, START)

    first = page.seen(start)
    near = first.position + 0.7 * first.away * first.forward
    for number, axis in ((right, 0), (down, 1)):
        after = page.seen(number)
        assert np.allclose(after.target, first.target) and after.away == pytest.approx(first.away)
        assert np.allclose(after.on_screen(after.target), 0, atol=1e-6)
        # points in front of the target follow the pointer
        assert after.on_screen(near)[axis] > 0.05 and abs(after.on_screen(near)[1 - axis]) < 1e-6
    view = page.seen(down)
    for number, expected in zip(slides, ([-1, 0, 0], [0, -1, 0], [1, 0, 0]), strict=True):
        after = page.seen(number)
        steps = view.steps_to(after)
        assert np.dot(steps, expected) > 0.1 and np.allclose(np.cross(steps, expected), 0, atol=1e-6)
        assert np.allclose(after.target - view.target, after.position - view.position, atol=1e-6)
        assert np.allclose(view.turned_to(after), 0, atol=1e-6)
        view = after
    for number, closer in zip(wheels, (True, False), strict=True):
        after = page.seen(number)
        assert (after.away < 0.8 * view.away) if closer else (after.away > 1.3 * view.away)
        assert np.allclose(after.target, view.target) and np.allclose(view.turned_to(after), 0, atol=1e-6)
        view = after


KEYS = {
    "w": (0, 0, 1),
    "s": (0, 0, -1),
    "a": (-1, 0, 0),
    "d": (1, 0, 0),
    "q": (0, 1, 0),
    "e": (0, -1, 0),
}
TURNS = {
    "ArrowLeft": (-1, 0, 0),
    "ArrowRight": (1, 0, 0),
    "ArrowUp": (0, -1, 0),
    "ArrowDown": (0, 1, 0),
    "z": (0, 0, -1),
    "x": (0, 0, 1),
}


def test_keys_walk_turn_and_roll(bundle: Path) -> None:
    page = Steps()
    views = [page.view()]
    for key in (*KEYS, *TURNS):
        page.do(["key", key, 60])
        views.append(page.view())
    slow, fast = [], []
    for _ in range(3):
        page.do(["key", "w"])
        slow.append(page.view())
    for _ in range(3):
        page.do(["hold", "Shift"], ["key", "W"], ["release", "Shift"])
        fast.append(page.view())
    page.run(bundle, START)

    seen = [page.seen(number) for number in views]
    for key, before, after in zip((*KEYS, *TURNS), seen[:-1], seen[1:], strict=True):
        steps, turns = before.steps_to(after), before.turned_to(after)
        way, rest = (steps, turns) if key in KEYS else (turns, steps)
        expected = np.array(KEYS.get(key) or TURNS[key])
        assert np.dot(way, expected) > 0.01, key
        # arrow keys rotate about the vertical, which is not the rolled camera's up
        assert np.allclose(way * (1 - abs(expected)), 0, atol=1e-4) and np.allclose(rest, 0, atol=1e-6), key
    walked = [page.seen(number).position for number in (views[-1], *slow, *fast)]
    lengths = np.linalg.norm(np.diff(walked, axis=0), axis=1)
    assert lengths[3:].min() > 2.5 * lengths[:3].min()


def test_fly_looks_around_and_the_wheel_walks(bundle: Path) -> None:
    page = Steps()
    pressed = "['orbit', 'fly'].map((id) => document.getElementById(id).ariaPressed).join()"
    page.do(["click", "#fly"])
    by_button = page.ask(pressed)
    page.do(["key", "o"])
    orbit = page.ask(pressed)
    page.do(["key", "f"])
    by_key = page.ask(pressed)
    views = [page.view()]
    for step in (["drag", *by(80, 0)], ["drag", *by(0, 60)], ["wheel", MIDDLE, -300]):
        page.do(step)
        views.append(page.view())
    page.do(["click", "#orbit"])
    again = page.ask(pressed)
    page.run(bundle, START)

    assert page[by_button] == page[by_key] == "false,true" and page[orbit] == page[again] == "true,false"
    first, across, down, walked = (page.seen(number) for number in views)
    assert np.allclose(first.position, across.position) and np.allclose(first.position, down.position)
    # the scene follows the pointer: right and down, so the camera turns left and up
    assert first.turned_to(across)[0] < -0.1 and abs(first.turned_to(across)[1]) < 1e-6
    assert across.turned_to(down)[1] < -0.1
    assert down.steps_to(walked)[2] > 0.05 and walked.away == pytest.approx(down.away)


def test_the_capture_s_cameras_and_the_way_home(bundle: Path) -> None:
    page = Steps()
    chosen = "document.getElementById('camera').value"
    views = [page.view()]
    for step in (
        ["click", "#next"],
        ["click", "#next"],
        ["key", ","],
        ["click", "#previous"],
        ["key", "."],
        ["select", "#camera", "0"],
        ["select", "#camera", "1"],
        ["click", "#home"],
        ["key", "d"],
        ["key", "h"],
    ):
        page.do(step)
        views.append(page.view())
    last = page.ask(chosen)
    page.run(bundle)

    rows = json.loads((bundle / "cameras.json").read_text())["cameras"]
    places = []
    for row in rows:
        viewmat = np.array(row["viewmat"]).reshape(4, 4)
        places.append(-viewmat[:3, :3].T @ viewmat[:3, 3])
    seen = [page.seen(number) for number in views]
    for k, view in zip((0, 1, 0, 1, 0, 1, 0, 1, 0, None, 0), seen, strict=True):
        if k is not None:
            assert np.allclose(view.position, places[k], atol=1e-6)
            assert view.focal == pytest.approx(rows[k]["fx"])
    assert not np.allclose(seen[9].position, places[0], atol=1e-3)
    assert page[last] == "1"  # home is the first view, not a chosen camera


def test_keys_for_cameras_do_nothing_without_cameras(tmp_path: Path) -> None:
    export(baked_scene("bc7", 120, False, False, "sv", 0.0, False, ()), tmp_path / "bare")
    page = Steps()
    page.do(["key", ","], ["key", "."])
    state = page.ask("document.documentElement.dataset.state")
    page.run(tmp_path / "bare")
    assert page[state] == "ready"


def test_the_photograph_is_beside_the_picture(bundle: Path) -> None:
    page = Steps()
    there = "!document.getElementById('photograph').hidden"
    width = "document.getElementById('canvas').clientWidth"
    before = page.ask(width)
    page.do(["click", "#beside"], ["loaded", "#photograph-image"])
    shown, half = page.ask(there), page.ask(width)
    side = page.ask("document.getElementById('photograph-image').naturalWidth")
    name = "document.getElementById('photograph-name').textContent"
    page.do(["key", "."])
    none = page.ask(name)
    page.do(["key", "p"])
    hidden = page.ask(there)
    page.do(["key", "p"])
    again, back, view = page.ask(there), page.ask(name), page.view()
    page.run(bundle)

    assert page[shown] and page[again] and not page[hidden]
    assert page[half] < 0.51 * page[before] and page[side] == 160
    # without a photograph a notice says so; the next request goes to a camera with one
    assert "No photograph" in page[none] and page[back] == "Photograph"
    assert np.allclose(page.seen(view).position[0], 0, atol=1e-6)


def test_what_is_shown(bundle: Path, tmp_path: Path) -> None:
    page, names = Steps(), {}

    def shot(name: str) -> None:
        names[name] = tmp_path / f"{name}.png"
        page.do(["save", "#screenshot", names[name]])

    shot("color")
    for show in ("residual", "depth", "normal", "overdraw"):
        page.do(["select", "#show", show])
        shot(show)
    mode = page.view()
    page.do(["select", "#show", "color"])
    pressed = "['texture', 'colors'].map((id) => document.getElementById(id).ariaPressed).join()"
    page.do(["click", "#texture"])
    shot("plain")
    without, link = page.ask(pressed), page.view()
    page.do(["key", "t"])
    shot("textured")
    page.do(["click", "#colors"], ["click", "#next"])
    held = page.ask(pressed)
    shot("held")
    page.do(["key", "c"])
    shot("followed")
    page.do(["click", "#previous"])
    shot("again")
    page.run(bundle, drawn=True, viewport=(800, 300))

    pictures = {name: np.asarray(Image.open(path).convert("RGB"), np.float32) for name, path in names.items()}
    off = {name: np.abs(picture - pictures["color"]).mean() for name, picture in pictures.items()}
    for name in ("residual", "depth", "normal", "overdraw", "plain"):
        assert off[name] > 0.2, name
    assert off["textured"] == 0 and off["again"] == 0
    assert np.abs(pictures["held"] - pictures["followed"]).mean() > 0.02
    assert page[without] == "false,true" and page[held] == "true,false"
    assert "show=overdraw" in page[mode] and page[link].endswith("texture=off")


def test_screenshot_link_resolution_and_theme(bundle: Path, tmp_path: Path) -> None:
    page = Steps()
    page.do(["save", "#screenshot", tmp_path / "a.png"], ["save by key", "Control+s", tmp_path / "b.png"])
    named = len(page.steps) - 1
    before = page.ask("location.hash")
    page.do(["key", "l"])
    # copying takes a moment; the earlier notice says that there is no graphics card
    notice = "document.getElementById('notice').textContent"
    told = page.ask(
        "new Promise((give) => { const look = () => "
        f"{notice}.includes('link') ? give({notice}) : setTimeout(look, 20); look(); }})"
    )
    after = page.ask("location.hash")
    sizes = []
    for share in ("0.25", "0.5", "0.75", "1"):
        page.do(["select", "#resolution", share], ["settle"])
        sizes.append(page.ask("document.getElementById('status').textContent.split(' · ')[1]"))
        sizes.append(page.ask("document.getElementById('canvas').width"))
    colours = []
    for _ in range(3):
        page.do(["click", "#theme"])
        colours.append(page.ask("getComputedStyle(document.body.parentElement).backgroundColor"))
    page.run(bundle, drawn=True, viewport=(800, 200))

    a, b = (np.asarray(Image.open(tmp_path / name)) for name in ("a.png", "b.png"))
    assert a.shape[:2] == (200, 800) and np.array_equal(a, b) and page[named] == f"{bundle.name}.png"
    assert page[before] == "" and page[after].startswith("#p=") and "link" in page[told]
    assert [page[number] for number in sizes] == ["25 %", 200, "50 %", 400, "75 %", 600, "100 %", 800]
    light, dark, system = (page[number] for number in colours)
    assert light == system and light != dark


def test_fingers_and_the_menu_on_a_phone(bundle: Path) -> None:
    page = Steps()
    panel = "getComputedStyle(document.getElementById('panel')).display"
    closed = page.ask(panel)
    page.do(["click", "#menu"])
    opened, told = page.ask(panel), page.ask("document.getElementById('menu').ariaExpanded")
    page.do(["click", "#texture"])
    texture = page.ask("document.getElementById('texture').ariaPressed")
    wide = page.ask(
        "[...document.querySelectorAll('#panel button, #panel select')].filter((e) => !e.hidden)"
        ".every((e) => { const r = e.getBoundingClientRect();"
        " return r.height >= 40 && r.left >= 0 && r.right <= innerWidth && r.bottom <= innerHeight; })"
    )
    page.do(["click", "#menu"])
    shut = page.ask(panel)
    views = [page.view()]
    for fingers in (
        [[[150, 300]], [[210, 300]]],
        [[[150, 300], [200, 300]], [[100, 300], [250, 300]]],
        [[[150, 300], [200, 300]], [[210, 300], [260, 300]]],
    ):
        page.do(["fingers", *fingers])
        views.append(page.view())
    page.run(bundle, START, viewport=PHONE, touch=True)

    assert page[closed] == page[shut] == "none" and page[opened] != "none" and page[told] == "true"
    assert page[texture] == "false" and page[wide]
    first, turned, closer, slid = (page.seen(number) for number in views)
    near = first.position + 0.7 * first.away * first.forward
    assert np.allclose(turned.target, first.target) and turned.on_screen(near)[0] > 0.05
    assert closer.away < 0.5 * turned.away and np.allclose(turned.turned_to(closer), 0, atol=1e-6)
    steps = closer.steps_to(slid)
    assert steps[0] < -0.05 and np.allclose(steps[1:], 0, atol=0.2 * abs(steps[0]))
