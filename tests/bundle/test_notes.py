"""notes.json of a bundle: reading, and its fate when the bundle is written, packed or checked."""

import copy
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from bitymi_ns.bundle import BundleError, check_files, check_target
from bitymi_ns.bundle.notes import notes_of, parse_notes
from bitymi_ns.bundle.parts import NOTES_LIMIT
from bitymi_ns.bundle.single import write_single
from bitymi_ns.cli import main
from tests.bundle.compact_scene import make_codes, write_compact

CAMERA = {"position": [0, -3, 0.5], "right": [1, 0, 0], "forward": [0, 1, 0], "target": [0, 0, 0]}
LENS = [500, 500, 250.0, 240, 500, 480]
NOTES: dict[str, Any] = {
    **{"format": "bitymi-notes", "version": 1},
    "views": [{"name": "door", **CAMERA, "lens": LENS}, {"name": "Tür <b>", **CAMERA, "lens": LENS}],
    "notes": [{"text": "first line\nsecond", "position": [0.1, -2, 3]}],
}


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


def change(path: str, value: Any) -> bytes:
    """Return the file with another value at a path."""
    notes = copy.deepcopy(NOTES)
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
    "version": [2, "1"],
    "format": ["bitymi-bundle"],
}


@pytest.mark.parametrize("path", REFUSED)
def test_an_entry_that_is_none_is_named_in_one_line(path: str) -> None:
    for value in REFUSED[path]:
        with pytest.raises(BundleError) as error:
            parse_notes(change(path, value), "b/notes.json")
        said = str(error.value)
        assert said.startswith(f"b/notes.json: {'.'.join(path.split('.')[:2])}") and "\n" not in said, said


@pytest.mark.parametrize("data", [b"", b"[]", b"{", b'{"format":1,"format":2}', text().replace(b"-3", b"NaN"), b"\xff"])
def test_what_is_no_such_file_is_refused(data: bytes) -> None:
    with pytest.raises(BundleError, match="^notes.json: "):
        parse_notes(data)


def test_verify_checks_it(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    checks = {check.name: check for check in check_files(folder)[1]}
    assert checks["notes.json"].ok and checks["notes.json"].detail == "2 views, 1 notes"
    (folder / "notes.json").write_bytes(change("notes.0.position.2", "x"))
    bundle, checks_now = check_files(folder)
    assert bundle is not None and [check.name for check in checks_now if not check.ok] == ["notes.json"]
    for command in (["verify"], ["pack"], ["view", "--export", str(folder.parent / "site")]):
        assert main([command[0], str(folder), *command[1:]]) == 1
        assert "notes.0.position.2" in "".join(capsys.readouterr())
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
    write_compact(folder, make_codes(count=50), overwrite=True)
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
