"""Saved views and notes in a browser: lists, markers, file (`docs/viewer.md`)."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from bitymi_ns.bundle.notes import parse_notes
from bitymi_ns.view import single_site, site_of, write_static
from tests.bundle.test_notes import NOTES, text
from tests.view.browser import drive, plain_server
from tests.view.steps import PHONE, START, Steps
from tests.view.test_path import FITS, SECOND, there

pytestmark = pytest.mark.slow

VIEWS, REMARKS = (
    f"[...document.querySelectorAll('#{part} .name')].map((e) => e.value || e.textContent).join('|')"
    for part in ("view-rows", "note-rows")
)
MARKERS = (
    "[...document.querySelectorAll('.marker')].map((e) => ({hidden: e.hidden, text: e.textContent, "
    "behind: e.classList.contains('behind'), x: parseFloat(e.style.left), y: parseFloat(e.style.top)}))"
)
HTML = "<img src=x onerror=alert(1)>"


@pytest.fixture
def noted(solid: Path, tmp_path: Path) -> Path:
    copy = tmp_path / "noted"
    shutil.copytree(solid, copy)
    (copy / "notes.json").write_bytes(text())
    return copy


def test_views_are_saved_gone_to_renamed_and_removed(bundle: Path, tmp_path: Path) -> None:
    page = Steps()
    page.do(["key", "m"], ["click", "#save-view"], there(SECOND), ["settle"])
    page.do(["fill", "#view-name", f"Door {HTML}"], ["click", "#save-view"])
    names = page.ask(VIEWS)
    page.do(["click", "#view-rows .name"])
    onway = page.ask("document.documentElement.dataset.frame")
    page.do(["settle"])
    first = page.view()
    page.do(["click", "#view-rows [aria-label='Edit View 1']"], ["ask", "document.activeElement.select()"])
    page.do(*(["key", key] for key in "abmk"), ["key", "Enter"])
    renamed = page.ask(VIEWS)
    page.do(["click", "#view-rows [aria-label='Edit abmk']"], ["key", "x"], ["key", "Escape"])
    kept, keyframes = page.ask(VIEWS), page.ask("document.querySelectorAll('#keyframes li').length")
    page.do(["click", "#view-rows [aria-label^='Remove Door']"])
    removed = page.ask(VIEWS)
    page.do(["save", "#save-notes", tmp_path / "notes.json"])
    named = len(page.steps) - 1
    page.do(["key", "m"])
    closed = page.ask("document.getElementById('notes-panel').hidden")
    page.run(bundle, START)

    assert page[names] == f"View 1|Door {HTML}" and page[onway] == "moving"
    assert np.allclose(page.seen(first).position, [0, -3, 0], atol=1e-6)
    assert page[renamed] == page[kept] == f"abmk|Door {HTML}" and page[removed] == "abmk" and page[keyframes] == 0
    assert page[named] == "notes.json" and page[closed]
    found = parse_notes((tmp_path / "notes.json").read_bytes())
    assert [view.name for view in found.views] == ["abmk"] and found.views[0].lens == [500, 500, 250, 250, 500, 500]
    assert np.allclose(found.views[0].position, [0, -3, 0], atol=1e-6)


def test_a_note_is_pinned_to_the_surface_that_was_clicked(solid: Path, tmp_path: Path) -> None:
    page = Steps()
    page.do(["press", "#notes"], ["press", "#add-note"], ["drag", (200, 200), (260, 200)])
    waiting = page.ask("document.getElementById('add-note').ariaPressed")
    page.do(["key", "h"], ["settle"], ["drag", (330, 250), (330, 250)])
    page.do(["until", "document.querySelector('#note-rows textarea')"], *(["key", key] for key in HTML))
    page.do(["key", "Enter"], ["until", f"{MARKERS}.length"])
    marker, rows = page.ask(f"{MARKERS}[0]"), page.ask(REMARKS)
    page.do(["save", "#save-notes", tmp_path / "notes.json"])
    page.do(["press", "#show-notes"])
    shown = page.ask("document.getElementById('markers').hidden")
    page.do(["press", "#show-notes"], ["click", "#note-rows .name"], ["settle"])
    center, view = page.ask(f"{MARKERS}[0]"), page.view()
    page.do(["key", "h"], ["settle"], ["press", "#add-note"], ["drag", (3, 3), (3, 3)])
    page.do(["until", "document.getElementById('notice').textContent.includes('surface')"])
    none = page.ask(REMARKS)
    page.run(solid, drawn=True)

    assert page[waiting] == "true" and page[rows] == HTML and page[none] == HTML and page[shown]
    assert (page[marker]["text"], page[marker]["hidden"], page[marker]["behind"]) == (HTML, False, False)
    assert [page[marker]["x"], page[marker]["y"]] == pytest.approx([100 * 330 / 900, 50], abs=0.2)
    assert [page[center]["x"], page[center]["y"]] == pytest.approx([50, 50], abs=0.1)
    note = parse_notes((tmp_path / "notes.json").read_bytes()).notes[0]
    assert note.text == HTML and np.allclose(page.seen(view).target, note.position, atol=1e-5)
    # on the pixel's ray, in the scene frame
    row = json.loads((solid / "cameras.json").read_text())["cameras"][0]
    x, y, z = (np.array(row["viewmat"]).reshape(4, 4) @ [*note.position, 1])[:3]
    k = min(900 / row["width"], 500 / row["height"])
    assert k * row["fx"] * x / z == pytest.approx(330 - 450, abs=1) and abs(y / z) < 0.01 and 1 < z < 5


def test_notes_beside_the_bundle_are_shown_where_they_are(noted: Path) -> None:
    page = Steps()
    page.do(["until", f"{MARKERS}.some((e) => e.behind)"])
    found, views = page.ask(MARKERS), page.ask(VIEWS)
    row = json.loads((noted / "cameras.json").read_text())["cameras"][0]
    viewmat = np.array(row["viewmat"]).reshape(4, 4)
    forward, position = viewmat[2, :3], -viewmat[:3, :3].T @ viewmat[:3, 3]
    notes = [{"text": f"{z}", "position": (position + z * forward).tolist()} for z in (0.2, 50, -1)]
    (noted / "notes.json").write_bytes(text({**NOTES, "notes": notes}))
    page.run(noted, drawn=True)
    near, far, back = page[found]
    assert page[views] == "door|Tür <b>" and [near["text"], far["text"]] == ["0.2", "50"]
    assert not near["hidden"] and not near["behind"] and far["behind"] and not far["hidden"] and back["hidden"]
    assert (near["x"], near["y"]) == pytest.approx((50, 50), abs=1e-3)


def test_a_damaged_file_leaves_the_scene_without(noted: Path, tmp_path: Path) -> None:
    write_static(single_site(noted), tmp_path / "one")
    write_static(site_of(noted), tmp_path / "site")
    (tmp_path / "site/bundle/notes.json").write_bytes(text().replace(b"0.1", b'"0.1"'))
    notice = "document.getElementById('notice').textContent"
    with plain_server(tmp_path, True) as (address, _):
        found = drive(
            [
                *([["goto", f"{address}one/"], ["settle"], ["ask", VIEWS], ["ask", REMARKS]]),
                *([["goto", f"{address}site/"], ["until", f"{notice}.includes('notes.json')"], ["ask", notice]]),
                *([["settle"], ["ask", "document.documentElement.dataset.state"], ["ask", VIEWS]]),
            ],
            drawn=False,
        )
    assert found.results[2:4] == ["door|Tür <b>", "first line\nsecond"]
    assert "notes.0.position: must be three numbers" in found.results[6] and found.results[8:] == ["ready", ""]


@pytest.mark.parametrize("phone", [False, True])
def test_the_panels_fit_the_screen(noted: Path, phone: bool) -> None:
    """First the path's panel, then the notes'."""
    page, size = Steps(), "40" if phone else "30"
    page.do(*[["click", "#menu"]] * phone, ["click", "#tools"])
    for _ in range(3):
        page.do(["press", "#add-keyframe"])
    path = page.ask(FITS.replace("SIZE", size))
    canvas = page.ask("document.getElementById('aside').getBoundingClientRect().top > innerHeight * 0.3")
    page.do(*[["click", "#menu"]] * phone)
    hidden = page.ask("document.getElementById('aside').hidden")
    page.do(*[["click", "#tools"]] * phone, ["click", "#close"])
    closed = page.ask("document.getElementById('aside').hidden")
    page.do(*[["click", "#menu"]] * phone, ["click", "#notes"], ["press", "#note-rows [title=Edit]"])
    notes = page.ask(FITS.replace("aside", "notes-panel").replace("SIZE", size))
    page.do(*[["click", "#menu"]] * phone, ["press", "#tools"])
    panels = page.ask("['aside', 'notes-panel'].map((id) => document.getElementById(id).hidden).join()")
    page.run(noted, START, **({"viewport": PHONE, "touch": True} if phone else {}))

    assert page[path] and page[hidden] == phone and page[closed]
    assert page[canvas] or not phone
    assert page[notes] and page[panels] == "false,true"
