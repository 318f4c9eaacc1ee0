"""Measures, crops and hidden floaters in a browser, and in the bundle afterwards (`docs/viewer.md`)."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from bitymi_ns.bundle import check_files, read_bundle
from bitymi_ns.bundle.notes import parse_notes
from bitymi_ns.cli import main
from tests.view.browser import drive, plain_server
from tests.view.conftest import write
from tests.view.steps import PHONE, START, Steps
from tests.view.test_browser import MEAN, SCREEN, difference
from tests.view.test_path import FITS

pytestmark = pytest.mark.slow

STATUS = "document.getElementById('status').textContent.split(' · ')[2]"
LABELS = "[...document.querySelectorAll('.label')].filter((e) => !e.hidden).map((e) => e.textContent).join('|')"
WIDE = {"from": -0.7, "to": 0.7}
FIRST, SECOND = (330, 250), (470, 250)


def click(at: tuple[int, int]) -> list[object]:
    return ["drag", at, at]


def measure() -> list[list[object]]:
    """Measure from `FIRST` to `SECOND`."""
    steps = [["press", "#measure"], ["press", "#add-measure"], click(FIRST)]
    steps += [["until", "document.querySelector('.ends').getAttribute('d')"], click(SECOND)]
    return [*steps, ["until", f"{LABELS}.includes('units')"]]


def slide(name: str, value: float) -> list[object]:
    """Move a slider, as a drag with a release does."""
    of = f"document.querySelector('[aria-label=\"{name}\"]')"
    events = "".join(f"s.dispatchEvent(new Event('{each}'));" for each in ("input", "change"))
    return ["ask", f"(() => {{ const s = {of}; s.valueAsNumber = {value}; {events} }})()"]


@pytest.fixture(scope="module")
def cropped(solid: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str, str]:
    """A bundle with notes.json from the page, and what the page showed: surfels, labels of measures."""
    folder = tmp_path_factory.mktemp("cropped")
    page = Steps()
    page.do(*measure(), ["fill", "#known", "2"], ["press", "#set-unit"])
    labels = page.ask(LABELS)
    page.do(["press", "#crop"], ["press", "#crop-hide"], click(FIRST))
    page.do(["until", "!document.getElementById('hide-selected').hidden"])
    page.do(*(slide(f"{axis}, {end}", at) for axis in ("Across", "Along", "Upwards") for end, at in WIDE.items()))
    page.do(["press", "#hide-selected"], ["settle"])
    hidden = page.ask(STATUS)
    page.do(["press", "#crop-floor"], click(SECOND), ["until", "!document.getElementById('floor-row').hidden"])
    page.do(slide("Height of the floor", -0.1), ["press", "#crop-box"], slide("Turn, degrees", 20))
    page.do(slide("Across, to", 0.15), ["settle"])
    status = page.ask(STATUS)
    page.do(["press", "#undo"], ["settle"])
    wide = page.ask(STATUS)
    page.do(slide("Across, to", 0.15), ["settle"])
    again = page.ask(STATUS)
    page.do(["press", "#apply-crop"], ["settle"])
    whole = page.ask(STATUS)
    page.do(["save", "#crop-panel .save-notes", folder / "notes.json"])
    page.run(solid, drawn=True)

    assert page[labels] == "2 m" and page[whole] == "120 surfels"
    assert page[status] == page[again] and page[status] != page[wide] != page[hidden] != "120 surfels"
    shutil.copytree(solid, folder / "b")
    shutil.move(folder / "notes.json", folder / "b")
    return folder / "b", page[status], page[labels]


def test_the_bundle_has_what_the_page_measured_and_hid(cropped: tuple[Path, str, str]) -> None:
    bundle, status, _ = cropped
    found = parse_notes((bundle / "notes.json").read_bytes())
    (measure,) = found.measures
    a, b = np.array(measure.points)
    assert found.unit is not None and found.unit.per_world * np.linalg.norm(a - b) == pytest.approx(2)
    # both clicks hit their pixels' rays
    row = json.loads((bundle / "cameras.json").read_text())["cameras"][0]
    for at, (px, _) in zip((a, b), (FIRST, SECOND), strict=True):
        x, y, z = (np.array(row["viewmat"]).reshape(4, 4) @ [*at, 1])[:3]
        k = min(900 / row["width"], 500 / row["height"])
        assert k * row["fx"] * x / z == pytest.approx(px - 450, abs=1) and abs(y / z) < 0.01
    assert len(found.hidden) == 1 and found.crop is not None and None not in (found.crop.box, found.crop.floor)
    some = read_bundle(bundle, crop=True)
    assert status == f"{len(some)} of 120 surfels" and 0 < len(some) < 110


def test_crop_and_measures_survive_pack_and_export(cropped: tuple[Path, str, str], tmp_path: Path) -> None:
    bundle, status, labels = cropped
    single, picture = tmp_path / "b.bitymi", tmp_path / "p.png"
    assert main(["pack", str(bundle), "--output", str(single)]) == 0
    check = check_files(single)[1][-1]
    assert check.ok and check.detail == "0 views, 0 notes, 1 measures, a crop, 1 hidden boxes"
    assert main(["view", str(single), "--export", str(tmp_path / "one"), "--one-file"]) == 0
    assert main(["view", str(bundle), "--export", str(tmp_path / "site")]) == 0
    with plain_server(tmp_path, True) as (address, _):
        steps: list[list[object]] = []
        for site in ("one", "site"):
            steps += [["goto", f"{address}{site}/"], ["settle"], ["ask", STATUS], ["ask", LABELS]]
        found = drive([*steps, ["save", "#screenshot", picture]], SCREEN)
    assert not found.problems and found.results[2:4] == found.results[6:8] == [status, labels]
    scene = read_bundle(bundle, crop=True).scene
    assert difference(picture, scene)[0] < MEAN < difference(picture, bundle)[0]


@pytest.mark.parametrize("phone", [False, True])
def test_panels_and_help_fit_the_screen(cropped: tuple[Path, str, str], phone: bool) -> None:
    page, size = Steps(), "40" if phone else "16"
    fits = []
    for key, panel in (("r", "measure-panel"), ("b", "crop-panel")):
        page.do(["key", key], *[["press", "#crop-box"]] * (key == "b"))
        fits.append(page.ask(FITS.replace("aside", panel).replace("SIZE", size)))
    page.do(["key", "?"])
    fits.append(page.ask("(({right, bottom}) => right <= innerWidth && bottom <= innerHeight)"
                         "(document.getElementById('help').getBoundingClientRect())"))  # fmt: skip
    page.do(["key", "?"])
    closed = page.ask("document.getElementById('help').open")
    page.run(cropped[0], START, **({"viewport": PHONE, "touch": True} if phone else {}))
    assert all(page[number] for number in fits) and page[closed] is False


HALF = (
    "const has = globalThis.GPUSupportedFeatures?.prototype.has; if (has) GPUSupportedFeatures.prototype.has = "
    "function (name) { return !name.startsWith('float32-') && has.call(this, name); }"
)
"""A device that blends in half floats alone."""


def test_a_device_that_blends_half_floats_measures_scenes_of_any_size(tmp_path: Path) -> None:
    lengths = []
    for unit, script in ((1.0, ""), (1.0, HALF), (1e5, HALF), (1e-5, HALF)):
        page = Steps()
        page.do(*measure())
        label, hint = page.ask(LABELS), page.ask("document.getElementById('measure-hint').textContent")
        page.run(write(tmp_path / f"{unit} {len(script)}", larger=1.5, unit=unit), drawn=True, script=script)
        lengths.append(float(page[label].split()[0]) / unit)
        assert ("three digits" in page[hint]) is bool(script)
    assert np.allclose(lengths, lengths[0], rtol=2e-3)


def test_a_resting_finger_measures(solid: Path) -> None:
    page, dots = Steps(), "document.querySelector('.ends').getAttribute('d').split('M').length - 1"
    hint = "document.getElementById('measure-hint').textContent"
    first, second = (130, 390), (215, 390)
    page.do(["press", "#measure"], ["press", "#add-measure"])
    before = page.ask(hint)
    page.do(["fingers", [first, (300, 300)], [first, (300, 300)]])  # no click
    page.do(["fingers", [first], [first], 900], ["until", f"{dots} === 1"])  # shown without a new frame
    half = page.ask(hint)
    page.do(["fingers", [second], [second]], ["until", f"{LABELS}.includes('units')"])
    after = page.ask(f"[{hint}, {dots}].join()")
    page.run(solid, drawn=True, viewport=PHONE, touch=True)
    assert [page[number] for number in (before, half, after)] == [
        "Click the first surface.",
        "Click the other surface.",
        ",2",
    ]


def test_keys_end_what_they_should(solid: Path) -> None:
    page = Steps()
    pressed = "[...document.querySelectorAll('[aria-pressed=true]')].map((e) => e.id).join()"
    page.do(["press", "#measure"], ["press", "#add-measure"], ["click", "#canvas"])
    page.do(["until", "document.querySelector('.ends').getAttribute('d')"], ["key", "Escape"], ["settle"])
    cancelled = page.ask(f"document.querySelector('.ends').getAttribute('d') + {pressed}")
    page.do(["key", "Escape"])
    closed = page.ask(pressed)
    page.do(*measure(), ["click", "#known"], ["key", "3"], ["key", "Enter"])
    length = page.ask(LABELS)
    page.do(["press", "#crop"], ["press", "#crop-box"], ["press", "#undo"])
    undone = page.ask(f"document.getElementById('crop-hint').textContent + {pressed}")
    page.do(["press", "#notes"], ["click", "#view-name"], ["key", "a"], ["key", "Enter"])
    view = page.ask("document.getElementById('view-rows').textContent")
    page.run(solid, drawn=True)
    assert "measure" in page[cancelled] and "add-measure" not in page[cancelled]
    assert not page[cancelled].startswith("M") and "measure" not in page[closed]
    assert page[length] == "3 m" and page[view].startswith("a")
    assert page[undone].startswith("Hidden surfels stay") and "crop-box" not in page[undone]


def test_the_controls_can_be_hidden(solid: Path) -> None:
    page = Steps()
    shown = "['#panel', '#top', '#menu'].map((id) => Number(document.querySelector(id).offsetWidth > 0)).join('')"
    seen = [page.ask(shown)]
    for step in (["click", "#hide-panel"], ["click", "#menu"], ["key", "u"], ["key", "u"], ["key", "n"]):
        page.do(step)
        seen.append(page.ask(shown))
    page.run(solid)
    assert [page[number] for number in seen] == ["110", "001", "110", "001", "110", "110"]


def test_a_double_click_turns_around_a_surface(solid: Path) -> None:
    page = Steps()
    page.do(["double", FIRST], ["until", "document.documentElement.dataset.frame === 'moving'"], ["settle"])
    middle = page.view()
    page.run(solid, drawn=True)
    seen, row = page.seen(middle), json.loads((solid / "cameras.json").read_text())["cameras"][0]
    x, y, z = (np.array(row["viewmat"]).reshape(4, 4) @ [*seen.target, 1])[:3]
    k = min(900 / row["width"], 500 / row["height"])
    assert k * row["fx"] * x / z == pytest.approx(330 - 450, abs=1) and abs(y / z) < 0.01
    assert np.allclose(seen.on_screen(seen.target), 0, atol=1e-5)


def test_full_screen_is_entered_and_left(solid: Path) -> None:
    # the button follows fullscreenchange, which fires a frame after document.fullscreenElement is set
    page, button = Steps(), "document.getElementById('full-screen').ariaPressed"
    page.do(["key", "g"], ["until", f"{button} === 'true'"])
    entered = page.ask("document.fullscreenElement?.tagName")
    page.do(["key", "g"], ["until", f"{button} === 'false'"])
    left = page.ask("document.fullscreenElement")
    page.run(solid)
    assert page[entered] == "HTML" and page[left] is None
