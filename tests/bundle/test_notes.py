"""notes.json of a bundle: reading, and its fate when the bundle is written, packed or checked."""

import copy
import json
import os
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from bitymi_ns.bundle import BundleError, check_files, read_bundle
from bitymi_ns.bundle.notes import NotesError, notes_of, parse_notes
from bitymi_ns.bundle.parts import NOTES_LIMIT, check_target
from bitymi_ns.bundle.single import write_single
from bitymi_ns.bundle.world import World
from bitymi_ns.cli import main
from tests.bundle.compact_scene import make_codes, write_compact

CAMERA = {"position": [0, -3, 0.5], "right": [1, 0, 0], "forward": [0, 1, 0], "target": [0, 0, 0]}
LENS = [500, 500, 250.0, 240, 500, 480]
NOTES: dict[str, Any] = {
    **{"format": "bitymi-notes", "version": 1},
    "views": [{"name": "door", **CAMERA, "lens": LENS}, {"name": "Tür <b>", **CAMERA, "lens": LENS}],
    "notes": [{"text": "first line\nsecond", "position": [0.1, -2, 3]}],
}


CASES: dict[str, Any] = json.loads((Path(__file__).parents[2] / "web" / "test" / "notes.json").read_text("utf8"))
"""A file of version 2, changes that are refused, and points with what a crop keeps; read by the page's tests, too."""


def text(notes: Any = NOTES) -> bytes:
    return json.dumps(notes).encode()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    folder = write_compact(tmp_path / "b", make_codes(count=40))
    (folder / "notes.json").write_bytes(text())
    return folder


def test_views_and_notes_are_read() -> None:
    found = parse_notes(text())
    assert [view.name for view in found.views] == ["door", "Tür <b>"] and found.views[0].lens == LENS
    assert found.notes[0].text == "first line\nsecond" and found.notes[0].position == [0.1, -2, 3]
    assert parse_notes(text({**NOTES, "views": [], "notes": []})).views == []


def change(path: str, value: Any, file: Any = NOTES) -> bytes:
    notes = copy.deepcopy(file)
    *keys, last = (int(key) if key.isdigit() else key for key in path.split("."))
    at: Any = notes
    for key in keys:
        at = at[key]
    at[last] = value
    return text(notes)


REFUSED = {
    "views.0.position.1": [True, "1", None, 1e10],
    "views.1.forward": [[0, 2, 0], [1, 0, 0], [0, 1], [0, 1, 0, 0], "0,1,0"],
    "views.0.lens": [[0, 500, 0, 0, 500, 500], [500, 500, 0, 0, 500, -1], [500]],
    "views.1.name": ["", "x" * 81, "door", "a\x1b[2J", 5],
    "notes.0.text": ["", "x" * 1001, "\ud800", "a\x00", ["a"]],
    "notes.0.position": [[1, 2], None],
    "notes.0.html": ["<b>"],
    "views": [None, {}, [NOTES["views"][0]] * 201],
    "notes": [[NOTES["notes"][0]] * 501, [5]],
    "version": [3, "1", True],
    "format": ["bitymi-bundle"],
    "unit": [CASES["file"]["unit"]],
}


@pytest.mark.parametrize(
    ("file", "path", "values"),
    [(NOTES, *each) for each in REFUSED.items()] + [(CASES["file"], *each) for each in CASES["refused"].items()],
)
def test_an_entry_that_is_none_is_named_in_one_line(file: Any, path: str, values: list[Any]) -> None:
    for value in values:
        with pytest.raises(BundleError) as error:
            parse_notes(change(path, value, file), "b/notes.json")
        said = str(error.value)
        assert said.startswith(f"b/notes.json: {'.'.join(path.split('.')[:2])}") and "\n" not in said, said


def test_version_2_has_measures_a_unit_and_a_crop() -> None:
    found = parse_notes(text(CASES["file"]))
    assert [measure.text for measure in found.measures] == ["Tür <b>", ""] and found.unit is not None
    assert (found.unit.name, found.unit.per_world) == ("m", 2.5)
    assert found.contents == "1 views, 1 notes, 2 measures, a crop, 1 hidden boxes"
    for name, most in (("measures", 500), ("hidden", 200)):
        entries = CASES["file"][name][:1]
        parse_notes(change(name, entries * most, CASES["file"]))
        with pytest.raises(BundleError, match=f"^notes.json: {name}"):
            parse_notes(change(name, entries * (most + 1), CASES["file"]))
    for name in ("measures", "unit", "crop", "hidden"):
        parse_notes(text({key: value for key, value in CASES["file"].items() if key != name}))


def test_surfels_are_hidden_by_their_centres() -> None:
    found = parse_notes(text({**CASES["file"], **CASES["crop"]}))
    points = torch.tensor(CASES["points"])
    assert found.cropping.keeps(points).tolist() == [bool(kept) for kept in CASES["kept"]]
    assert parse_notes(text()).cropping.keeps(points).all()


@pytest.mark.parametrize("data", [b"", b"[]", b"{", b'{"format":1,"format":2}', text().replace(b"-3", b"NaN"), b"\xff"])
def test_what_is_no_such_file_is_refused(data: bytes) -> None:
    with pytest.raises(BundleError, match="^notes.json: "):
        parse_notes(data)


def test_a_bundle_is_read_without_the_surfels_that_it_hides(folder: Path) -> None:
    whole = read_bundle(folder)
    with pytest.raises(NotesError, match=r"notes\.json hides no surfels: save a crop"):
        read_bundle(folder, crop=True)
    means = whole.scene.surfels["means"]
    offset = float(means[:, 2].median())
    half = {"format": "bitymi-notes", "version": 2, "views": [], "notes": []}
    half["crop"] = {"floor": {"normal": [0, 0, 1], "offset": offset}}
    (folder / "notes.json").write_bytes(text(half))
    some = read_bundle(folder, crop=True)
    assert torch.equal(some.scene.surfels["means"], means[means[:, 2] >= offset]) and 0 < len(some) < len(whole) == 40
    assert some.hidden == f"{40 - len(some)} of 40 surfels are hidden by notes.json" and whole.hidden == ""
    write_single(folder, folder.with_suffix(".bitymi"))
    assert len(read_bundle(folder.with_suffix(".bitymi"), crop=True)) == len(some)
    half["crop"]["floor"]["offset"] = 1e6
    (folder / "notes.json").write_bytes(text(half))
    with pytest.raises(NotesError, match="hides all surfels"):
        read_bundle(folder, crop=True)


def test_verify_checks_it(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    checks = {check.name: check for check in check_files(folder)[1]}
    assert checks["notes.json"].ok and checks["notes.json"].detail == "2 views, 1 notes"
    (folder / "notes.json").write_bytes(change("notes.0.position.2", "x"))
    bundle, checks_now = check_files(folder)
    assert bundle is not None and [check.name for check in checks_now if not check.ok] == ["notes.json"]
    for command in (["verify"], ["pack"], ["view", "--export", str(folder.parent / "site")]):
        assert main([command[0], str(folder), *command[1:]]) == 1
        said = "".join(capsys.readouterr())
        assert "notes.0.position.2" in said and "or remove it" in said and "export the scene again" not in said
    assert sorted(path.name for path in folder.parent.iterdir()) == ["b"]


def test_a_bundle_in_one_file_has_it(folder: Path) -> None:
    path = folder.with_suffix(".bitymi")
    write_single(folder, path)
    assert notes_of(path) == text()
    again = path.with_name("again.bitymi")
    write_single(path, again)
    assert again.read_bytes() == path.read_bytes() and check_files(path)[1][-1].name == "notes.json"
    (folder / "notes.json").unlink()
    write_single(folder, again)
    assert notes_of(folder) is None and notes_of(again) is None


def test_a_bundle_that_replaces_another_keeps_its_notes(folder: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        write_compact(folder, make_codes(count=50), overwrite=True)
    assert (folder / "notes.json").read_bytes() == text()
    with pytest.warns(UserWarning, match=r"notes\.json is kept, in the frame of the earlier"):
        write_compact(folder, make_codes(count=50), world=World(scale=2.0), overwrite=True)
    assert (folder / "notes.json").read_bytes() == text()
    (folder / "notes.json").unlink()
    write_compact(folder, make_codes(count=50), overwrite=True)
    assert not (folder / "notes.json").exists()


def large(path: Path) -> None:
    path.write_bytes(b" " * (NOTES_LIMIT + 1))


def link(path: Path) -> None:
    (path.parent.parent / "else.json").write_bytes(text())
    path.symlink_to(path.parent.parent / "else.json")


@pytest.mark.parametrize("place", [os.mkfifo, Path.mkdir, large, link])
def test_nothing_else_is_taken_for_it(place: Callable[[Path], None], folder: Path) -> None:
    (folder / "notes.json").unlink()
    place(folder / "notes.json")
    with pytest.raises(BundleError, match=r"notes\.json"):
        notes_of(folder)
    with pytest.raises(BundleError, match=r"notes\.json"):
        check_target(folder, overwrite=True)
    assert check_files(folder)[1][-1].name == "notes.json"
