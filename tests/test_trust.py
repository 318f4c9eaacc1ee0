"""Files that others may have planted where this package writes, and names that lead elsewhere."""

import os
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bitymi_ns import files, locks
from bitymi_ns.capture.cache import content_key, home, keep_work_folder, user_cache, work_folder
from bitymi_ns.capture.nerfstudio import write_capture
from bitymi_ns.capture.sfm import process
from bitymi_ns.capture.sfm.job import Job
from bitymi_ns.capture.types import CaptureError, FoundPoses
from bitymi_ns.files import reason
from bitymi_ns.measure.bench.cells import Cells
from bitymi_ns.measure.bench.process import BenchError, run_measured
from bitymi_ns.plugin.run.callbacks import TrainingCurve
from bitymi_ns.plugin.run.folder_lock import keep_poses_report
from bitymi_ns.trust import (
    Refused,
    check_replaceable,
    inside,
    is_own,
    json_of,
    no_links,
    own_folder,
    printable,
    told_apart,
)


@pytest.fixture
def victim(tmp_path: Path) -> Path:
    path = tmp_path / "victim"
    path.write_text("precious")
    return path


def curve(where: Path) -> None:
    made = TrainingCurve(where / "curve")
    (where / "curve").unlink()
    (where / "planted").rename(where / "curve")
    made.add({"step": 1})
    raise Refused("told as a warning", where)


PLANTS: dict[str, Callable[[Path, Path], object]] = {
    "link": Path.symlink_to,
    "hard link": Path.hardlink_to,
    "link to nothing": lambda path, victim: path.symlink_to(victim.with_name("elsewhere")),
    "pipe": lambda path, _: os.mkfifo(path),
}
PLACES: dict[Callable[[Path], object], str] = {
    lambda where: locks.Lock(where / "planted").__enter__(): "planted",
    lambda where: files.reserved(where / "x").__enter__(): ".x.lock",
    lambda where: files.write_file(where / "x", b"new"): ".x.unfinished",
    lambda where: Cells(where / "planted").add({}, {}, {}): "planted",
    lambda where: run_measured(["true"], where / "planted"): "planted",
    lambda where: process.run(Job(str(where), str(where), None, [], [], {}, False, {}), where, print): process.LOG,
    curve: "planted",
}
"""Calls that write under a predictable name, and that name."""


@pytest.mark.parametrize("plant", PLANTS)
@pytest.mark.parametrize("action", PLACES)
def test_links_are_not_written(action: Callable[[Path], object], plant: str, victim: Path, tmp_path: Path) -> None:
    where = tmp_path / "where"
    where.mkdir()
    PLANTS[plant](where / PLACES[action], victim)
    with pytest.raises((OSError, BenchError)):
        action(where)
    assert victim.read_text() == "precious" and not victim.with_name("elsewhere").exists()


@pytest.mark.parametrize("plant", list(PLANTS)[:3])
@pytest.mark.parametrize("name", [".x.new", ".x.old"])
def test_unfinished_folders_are_not_made_of_links(name: str, plant: str, victim: Path, tmp_path: Path) -> None:
    PLANTS[plant](tmp_path / name, victim)
    with pytest.raises(Refused) as refused, files.complete_folder(tmp_path / "x"):
        pass
    assert "remove it" in reason(refused.value, tmp_path) and os.path.lexists(tmp_path / name)
    assert victim.read_text() == "precious" and not (tmp_path / "x").exists()


def test_files_of_ones_own_are_opened_again(tmp_path: Path) -> None:
    for mode, text in (("w", "a"), ("a", "b"), ("w", "c"), ("a", "d")):
        with open(tmp_path / "f", mode, opener=no_links) as file:
            file.write(text)
    assert (tmp_path / "f").read_text() == "cd"


def test_files_and_folders_of_others(victim: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "own").mkdir()
    monkeypatch.setattr(os, "geteuid", lambda: os.getuid() + 1)
    with open(victim, "a", opener=no_links):
        pass  # owned by the folder's owner
    stat = os.stat
    elsewhere = os.stat_result([*stat(tmp_path)[:4], os.getuid() + 2, *stat(tmp_path)[5:]])
    monkeypatch.setattr(os, "stat", lambda path, **how: elsewhere if Path(path) == tmp_path else stat(path, **how))
    with pytest.raises(Refused, match="belongs to another user"), open(victim, "a", opener=no_links):
        pass
    assert not is_own(tmp_path / "own")
    with pytest.raises(Refused, match="belongs to another user"):
        own_folder(tmp_path / "own", close=True)


@pytest.fixture
def photographs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    (tmp_path / "capture").mkdir()
    return tmp_path / "capture"


def used(photographs: Path) -> tuple[str, list[str]]:
    """Return where the work on a capture is kept (cache or capture), and the messages."""
    said: list[str] = []
    with work_folder(photographs, "0", said.append) as work:
        return work.parent.parent.name, said


def test_a_folder_of_others_beside_the_photographs_is_not_used(photographs: Path, tmp_path: Path) -> None:
    assert used(photographs) == ("capture", [])
    work = photographs / ".bitymi/poses-0"
    work.chmod(0o777)
    where, said = used(photographs)
    assert where == "cache" and len(said) == 1 and "others can write to it" in said[0] and "cache" in said[0]
    work.rmdir()
    work.symlink_to(tmp_path)
    assert used(photographs)[0] == "cache"
    work.unlink()
    work.parent.rmdir()
    work.parent.symlink_to(tmp_path)
    assert used(photographs)[0] == "cache"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["cache", "capture"]


@pytest.mark.parametrize("name", ["result", "model", "masks", "images", "links", "database.db", "poses.txt"])
@pytest.mark.parametrize("plant", list(PLANTS)[:3])
def test_a_work_folder_that_holds_links_is_not_used(name: str, plant: str, photographs: Path, victim: Path) -> None:
    used(photographs)
    PLANTS[plant](photographs / ".bitymi/poses-0" / name, victim)
    where, said = used(photographs)
    assert where == "cache" and f"{name} is a link, which is not followed" in said[0]


def test_the_poses_of_a_run_are_not_kept_through_a_link(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("run", "report", "documents"):
        (tmp_path / name).mkdir()
    (tmp_path / "report/report.json").write_text("{}")
    (tmp_path / "documents/thesis.tex").write_text("years of work")
    (tmp_path / "run/poses").symlink_to(tmp_path / "documents")
    keep_poses_report(tmp_path / "run", tmp_path / "report")
    assert "poses is a link, which is not followed" in " ".join(capsys.readouterr().out.split())
    assert (tmp_path / "documents/thesis.tex").read_text() == "years of work"


def test_a_folder_of_images_has_that_of_its_capture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "images").mkdir()
    assert home(tmp_path / "images") == home(tmp_path) == tmp_path / ".bitymi"
    monkeypatch.chdir(tmp_path / "images")
    assert home(Path(".")) == tmp_path / ".bitymi"
    monkeypatch.setattr(os.path, "ismount", lambda path: path == tmp_path / "images")
    assert home(tmp_path / "images") == tmp_path / "images/.bitymi"


def test_others_may_not_write_into_what_is_made(photographs: Path) -> None:
    before = os.umask(0)
    try:
        (photographs / ".bitymi").mkdir()
        with work_folder(photographs, "0", print) as work:
            keep_work_folder(work)
            assert [path.stat().st_mode & 0o022 for path in (work.parent, work)] == [0, 0]
    finally:
        os.umask(before)


def test_neither_place_can_be_used(photographs: Path, tmp_path: Path) -> None:
    for parent in (photographs / ".bitymi", tmp_path / "cache"):
        parent.symlink_to(tmp_path / "nothing")
    with pytest.raises(CaptureError, match="XDG_CACHE_HOME"):
        used(photographs)


def test_no_home_is_no_hindrance_beside_the_capture(photographs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_home() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(Path, "home", no_home)
    assert used(photographs) == ("capture", [])
    (photographs / ".bitymi").rename(photographs / "x")
    (photographs / ".bitymi").symlink_to(photographs / "x")
    with pytest.raises(CaptureError, match="neither .*/.bitymi nor a cache folder can be .*set XDG_CACHE_HOME"):
        used(photographs)


@pytest.mark.parametrize("cache", ["", "relative/folder"])
def test_a_cache_that_is_no_absolute_path_is_not_used(cache: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", cache)
    assert user_cache() == Path.home() / ".cache/bitymi-ns"


@pytest.mark.parametrize("name", ["../a.jpg", "a/../../b.jpg", "/etc/passwd", "", ".", "a\0b", ".."])
def test_names_that_lead_elsewhere(name: str) -> None:
    with pytest.raises(ValueError, match="leads elsewhere"):
        inside(Path("/x"), name)


@given(st.text(alphabet="ab./\\ ~", max_size=12))
def test_names_stay_inside(name: str) -> None:
    try:
        found = inside(Path("/x/y"), name)
    except ValueError:
        return
    assert os.path.normpath(found).startswith("/x/y/")


def test_a_model_whose_names_lead_elsewhere_is_not_written(victim: Path, tmp_path: Path) -> None:
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera.create_from_model_name(1, "PINHOLE", 50.0, 40, 30)
    model.add_camera_with_trivial_rig(camera)
    image = pycolmap.Image("../../victim", np.zeros((0, 2)), 1, 1)
    model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    (tmp_path / "model").mkdir()
    model.write_binary(tmp_path / "model")
    poses = FoundPoses(tmp_path / "model", tmp_path / "a/b", tmp_path, {}, 1, 1, 0.1, 3.0, {})
    with pytest.raises(ValueError, match="leads elsewhere"):
        write_capture(poses, tmp_path / "out", lambda *told: None)
    assert victim.read_text() == "precious" and not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["notes.txt", "more/notes.txt", "images/notes.txt", "a.png/x", "empty/", ".hidden"])
def test_what_was_not_made_is_named_and_stays(tmp_path: Path, name: str) -> None:
    made = ["a.png", "images/b.png", "deep/er/c.png"]
    for each in made:
        (tmp_path / each).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / each).touch()
    (tmp_path / "images/.b.png.unfinished").touch()  # as after a kill
    check_replaceable(tmp_path, "a result", made, True, ValueError)
    if name.startswith("a.png"):
        (tmp_path / "a.png").unlink()
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).mkdir() if name.endswith("/") else (tmp_path / name).touch()
    named = {"more/notes.txt": "more", "a.png/x": "a.png"}.get(name, name.strip("/"))
    with pytest.raises(ValueError, match=re.escape(f"also holds {named}")):
        check_replaceable(tmp_path, "a result", made, True, ValueError)
    (tmp_path / "new").mkdir()  # links with generated names
    (tmp_path / "new/a.png").symlink_to(tmp_path)
    (tmp_path / "new/images").symlink_to(tmp_path)
    with pytest.raises(ValueError, match="holds a.png, images, which"):
        check_replaceable(tmp_path / "new", "a result", ["a.png", "images/b.png"], True, ValueError)


@pytest.mark.parametrize("text", ["[" * 100_000, "[" * 400 + "]" * 400, '{"a":' * 101 + "1" + "}" * 101])
def test_json_that_is_nested_too_deeply(text: str) -> None:
    with pytest.raises(ValueError, match="nested too deeply"):
        json_of(text)
    assert json_of(b'{"a": [{"b": [1, [2, []]]}, "x", null]}') == {"a": [{"b": [1, [2, []]]}, "x", None]}


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("a\x1b[31mb", "a\\x1b[31mb"),
        ("\x07\r\x9b2J", "\\x07\\r\\x9b2J"),
        ("a\u202egpj.exe", "a\\u202egpj.exe"),
        ("\udcff", "\\udcff"),
        ("Ä für\tspäter\n日本 👩\u200d🚀\u00a0x", "Ä für\tspäter\n日本 👩\u200d🚀\u00a0x"),
    ],
)
def test_what_controls_a_terminal_is_shown_as_an_escape(text: str, shown: str) -> None:
    assert printable(text) == shown


def test_a_key_is_not_of_how_a_path_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a").write_text("x")
    monkeypatch.chdir(tmp_path)
    assert content_key([("a", Path("a"))], {}) == content_key([("a", tmp_path / ".." / tmp_path.name / "a")], {})


def test_names_have_as_many_folders_as_tell_them_apart() -> None:
    alike = [Path(f"/a/cam{i}/images/{name}.jpg") for i in range(2) for name in "ab"]
    assert told_apart(alike[:2]) == ["a.jpg", "b.jpg"]
    assert told_apart(alike)[::2] == ["cam0/images/a.jpg", "cam1/images/a.jpg"]
    assert told_apart([alike[0], alike[0]]) == ["a.jpg", "a.jpg"] and told_apart([]) == []
