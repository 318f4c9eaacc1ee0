"""The table of what files are: every row takes effect in a capture, and docs/capture.md prints it."""

import textwrap
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from bitymi_ns.capture import kinds
from bitymi_ns.capture.folder_contents import images_of, passed_over, poses_in
from bitymi_ns.capture.kinds import Kind
from bitymi_ns.capture.points import Points, cloud_beside
from bitymi_ns.capture.recognise import _scanned
from bitymi_ns.capture.sfm_photos import find_photos
from bitymi_ns.capture.splits import lists_by_name, read_split_lists
from bitymi_ns.capture.types import ColmapCamera, Photograph
from tests.captures import write_cloud

PAGE = Path(__file__).resolve().parents[2] / "docs/capture.md"
TABLES = {
    "Pictures": kinds.PICTURES,
    "Folders": kinds.FOLDERS,
    "Folders with": kinds.RESULTS,
    "Not read": kinds.UNREAD,
    "Poses, not read": kinds.POSES,
    "Pictures of models": kinds.IMAGES_OF,
    "Clouds": kinds.CLOUDS,
    "Splits": (*kinds.LISTS, *kinds.NSVF, *kinds.PROCESSED),
}


def of(table: tuple[Kind, ...]) -> Iterator[tuple[Kind, str, str]]:
    """Yield each name of a row, and one that lies beside it, as they may be in a capture."""
    for row in table:
        for name in row.names.split():
            for whose in row.of.split() or [""]:
                yield row, *(each.replace("[0-9]*", "12").replace("[._-]", "_").replace("[1-5]", "3")
                             .replace("NAME", "img").replace("*", "12") for each in (name, whose))  # fmt: skip


def save(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", (8, 8)).save(path, {".tif": "TIFF"}.get(path.suffix, "PNG"))


def test_the_page_prints_the_table() -> None:
    page = " ".join(PAGE.read_text("utf8").split())
    for title, table in TABLES.items():
        rows = (f"{row.what} (`{row.names}`{f' beside `{row.of}`' if row.of else ''})" for row in table)
        line = f"- {title}: {', '.join(rows)}"
        assert line in page, textwrap.fill(line, 120, subsequent_indent="  ", break_on_hyphens=False)


@pytest.mark.parametrize(("row", "name", "whose"), list(of(kinds.PICTURES)))
def test_pictures_that_are_no_photographs(tmp_path: Path, row: Kind, name: str, whose: str) -> None:
    photograph, other = (each if "." in each[-4:] else f"{each}.png" for each in (whose or "photograph", name))
    save(tmp_path / other.upper())
    assert find_photos(tmp_path) == ([other.upper()] if row.of else [])  # the only picture of its photograph is one
    save(tmp_path / photograph)
    assert find_photos(tmp_path) == [photograph]
    assert passed_over(tmp_path)[0].startswith(f"{other.upper()} ({row.what}")


@pytest.mark.parametrize(("row", "name", "whose"), list(of(kinds.FOLDERS)))
def test_folders_without_photographs(tmp_path: Path, row: Kind, name: str, whose: str) -> None:
    save(tmp_path / name / "a.png")
    assert bool(find_photos(tmp_path)) == bool(row.of)
    save(tmp_path / (whose or "images") / "a.png")
    assert find_photos(tmp_path) == [f"{whose or 'images'}/a.png"]
    assert passed_over(tmp_path)[0].startswith(f"{name} ({row.what}: 1")


@pytest.mark.parametrize(("row", "name", "whose"), list(of(kinds.RESULTS)))
def test_results(tmp_path: Path, row: Kind, name: str, whose: str) -> None:
    folder = tmp_path / "test"
    save(folder / "rgb/a.png")
    if row is kinds.RENDERS:
        (folder / name).mkdir()
    else:
        assert find_photos(tmp_path)
        (folder / name).write_bytes(row.mark.encode())
    assert not find_photos(tmp_path) and passed_over(tmp_path)[0].startswith(f"test ({row.what}: 1")


@pytest.mark.parametrize(("row", "name", "whose"), list(of(kinds.UNREAD)))
def test_formats_that_are_not_read(tmp_path: Path, row: Kind, name: str, whose: str) -> None:
    (tmp_path / name.upper()).touch()
    assert not find_photos(tmp_path)
    assert passed_over(tmp_path) == [f"1 {Path(name).suffix} of {tmp_path} ({row.what}, which is not read; {row.use})"]


@pytest.mark.parametrize("below", ["", "deeper/"])
@pytest.mark.parametrize(("row", "name", "whose"), list(of(kinds.POSES)))
def test_poses_of_other_programs(tmp_path: Path, row: Kind, name: str, whose: str, below: str) -> None:
    for each in ("a", "b"):
        save(tmp_path / f"images/{each}.png")
    place = tmp_path / below / name.upper()
    place.parent.mkdir(exist_ok=True)
    if row.mark:
        place.touch()
        assert not poses_in(tmp_path)
    place.write_bytes(b"..." + row.mark.encode())
    (found,) = poses_in(tmp_path)
    assert found.startswith(f"{below}{name.upper()} ({row.what}")
    assert not {"FILE", "IMAGES", "FOLDER"} & {*found.replace("'", " ").split()}


@pytest.mark.parametrize(("row", "name", "whose"), list(of(kinds.IMAGES_OF)))
def test_pictures_of_a_model(row: Kind, name: str, whose: str, tmp_path: Path) -> None:
    assert images_of(tmp_path / name)[0] == tmp_path / row.what.replace("NAME", "img")


@pytest.mark.parametrize(("row", "name", "whose"), list(of(kinds.CLOUDS)))
def test_clouds_that_nothing_names(row: Kind, name: str, whose: str, tmp_path: Path) -> None:
    view = Photograph(Path(), ColmapCamera("PINHOLE", 8, 8, (8.0, 8.0, 4.0, 4.0)), np.eye(4), "")
    cloud = Points(np.random.default_rng(0).normal(size=(99, 3)), np.zeros((99, 3), np.uint8))
    for place, used in ((tmp_path / "cloud.txt", False), (tmp_path / name.upper(), True)):
        write_cloud(place, cloud.xyz)
        found = cloud_beside(tmp_path, cloud, [view], lambda points: points)
        assert (found is not None) is used


@pytest.mark.parametrize(("row", "name", "whose"), list(of(kinds.LISTS)))
def test_lists_of_splits(row: Kind, name: str, whose: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text("a.png\n")
    assert read_split_lists(tmp_path, tmp_path, []).names == {row.what: ["a.png"]}


@pytest.mark.parametrize("row", kinds.SCANS)
def test_scans(row: Kind, tmp_path: Path) -> None:
    for name in row.names.split():
        assert row.what not in [format for format, _ in _scanned(tmp_path)]
        path = tmp_path / name.replace("*", "0")
        path.parent.mkdir(exist_ok=True)
        path.write_text(row.mark) if row.mark or path.suffix else path.mkdir()
    assert [format for format, _ in _scanned(tmp_path)] == [row.what]


@pytest.mark.parametrize("rows", [kinds.NSVF, kinds.PROCESSED])
def test_names_of_splits(rows: tuple[Kind, ...]) -> None:
    files = {row.what: [name] for row, name, _ in of(rows)}
    assert lists_by_name([Path(*names) for names in files.values()], rows, "").names == files
