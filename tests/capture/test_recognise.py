"""Recognition of captures in folders and files."""

import json
import re
import struct
from pathlib import Path
from typing import Any

import pytest

from bitymi_ns.capture.folder_contents import photo_folder
from bitymi_ns.capture.recognise import image_count, models_in, recognise
from bitymi_ns.capture.sfm_photos import find_photos
from bitymi_ns.capture.types import CaptureError

POSE = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
FRAME = {"file_path": "images/a.jpg", "transform_matrix": POSE}
PINHOLE = {"fl_x": 9.0, "fl_y": 9.0, "cx": 4.0, "cy": 4.0, "w": 8, "h": 8}


def transforms(folder: Path, name: str = "transforms.json", **entries: Any) -> Path:
    path = folder / name
    path.write_text(json.dumps({"frames": [FRAME], **entries}))
    return path


def model(folder: Path, images: int = 3) -> Path:
    folder.mkdir(parents=True)
    (folder / "cameras.bin").write_bytes(struct.pack("<Q", 0))
    (folder / "images.bin").write_bytes(struct.pack("<Q", images))
    return folder


def photograph(folder: Path, name: str = "a.jpg") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / name).write_bytes(b"")
    return folder


@pytest.mark.parametrize(
    ("entries", "format"),
    [
        (PINHOLE, "nerfstudio"),
        ({**PINHOLE, "aabb_scale": 4}, "instant-ngp"),
        ({**PINHOLE, "aabb_scale": 4, "ply_file_path": "points.ply"}, "nerfstudio"),
        ({"camera_angle_x": 0.7}, "instant-ngp"),
        ({**PINHOLE, "camera_angle_x": 0.7}, "nerfstudio"),
        ({"frames": [{**FRAME, **PINHOLE}]}, "nerfstudio"),
        ({}, "nerfstudio"),  # whose reader says what is missing
        ({"frames": 3}, "nerfstudio"),
    ],
)
def test_a_transforms_json_is_told_from_instant_ngps(tmp_path: Path, entries: dict[str, Any], format: str) -> None:
    path = transforms(tmp_path, **entries)
    for given in (tmp_path, path):
        found = recognise(given)
        assert (found.format, found.path, found.folder) == (format, path, tmp_path)


@pytest.mark.parametrize("asked", ["nerfstudio", "instant-ngp"])
def test_which_reader_is_meant_can_be_said(tmp_path: Path, asked: Any) -> None:
    transforms(tmp_path, **PINHOLE, aabb_scale=4)
    assert recognise(tmp_path, asked).format == asked
    transforms(tmp_path, **PINHOLE)
    assert recognise(tmp_path, asked).format == asked
    (tmp_path / "transforms.json").write_text("{")
    assert recognise(tmp_path).format == "nerfstudio"  # whose reader says what is wrong


def test_a_blender_data_set(tmp_path: Path) -> None:
    path = transforms(tmp_path, "transforms_train.json", camera_angle_x=0.7)
    assert {(found.format, found.path) for found in map(recognise, (tmp_path, path))} == {("blender", tmp_path)}


@pytest.mark.parametrize("place", ["sparse/0", "colmap/sparse/0", "sparse", "dense/sparse", "."])
def test_a_colmap_model_is_found_and_photographs_beside_it_are_not_another_thing(tmp_path: Path, place: str) -> None:
    photograph(tmp_path / "images")
    (tmp_path / "model").mkdir()
    folder = tmp_path / "capture"
    model(folder / place)
    found = recognise(folder)
    assert (found.format, found.path, found.folder, found.beside) == ("colmap", folder / place, folder, ())
    assert recognise(folder / place / "cameras.bin").path == folder / place


def test_of_models_side_by_side_the_largest_is_read_and_the_others_are_named(tmp_path: Path) -> None:
    for number, images in ((0, 5), (1, 40), (2, 7)):
        model(tmp_path / f"sparse/{number}", images)
    assert [str(path) for path in models_in(tmp_path)] == ["sparse/1", "sparse/2", "sparse/0"]
    found = recognise(tmp_path)
    assert found.path == tmp_path / "sparse/1"
    assert "sparse/0 (`bitymi-data --colmap-path sparse/0`)" in found.how_to_choose()
    assert recognise(tmp_path, colmap_path=Path("sparse/2")).path == tmp_path / "sparse/2"
    model(tmp_path / "other/0", 90)
    model(tmp_path / "colmap/sparse/0", 50)
    assert [str(path) for path in models_in(tmp_path)][-2:] == ["colmap/sparse/0", "other/0"]  # the usual place first
    folder = tmp_path / "sparse/1"
    (folder / "images.bin").unlink()
    assert image_count(folder) == 0
    (folder / "images.txt").write_text("# two\n1 1 0 0 0 0 0 0 1 a.jpg\n1 1 -1\n2 1 0 0 0 0 0 0 1 b.jpg\n1 1 -1\n")
    assert image_count(folder) == 2


def test_two_things_in_one_folder(tmp_path: Path) -> None:
    path = transforms(tmp_path, **PINHOLE)
    model(tmp_path / "sparse/0")
    photograph(tmp_path / "images")
    found = recognise(tmp_path)
    assert found.path == path
    assert found.how_to_choose() == "Not read: sparse/0 (`bitymi-data --format colmap`)."
    other = recognise(tmp_path, "colmap")
    assert other.path == tmp_path / "sparse/0"
    assert other.how_to_choose() == "Not read: transforms.json (`bitymi-data --format nerfstudio`)."


@pytest.mark.parametrize(("below", "searched"), [("", ""), ("images", ""), ("input", "input"), ("holiday", "holiday")])
def test_photographs(tmp_path: Path, below: str, searched: str) -> None:
    photograph(tmp_path / below, "IMG 0001 \u00fc.JPG")
    model(tmp_path / ".kept/sparse/0")  # what hidden folders hold is no capture
    found = recognise(tmp_path)
    assert (found.format, found.path) == ("photographs", tmp_path / searched)


def test_a_video_alone_beside_photographs_or_in_a_folder(tmp_path: Path) -> None:
    video = photograph(tmp_path, "walk.MP4") / "walk.MP4"
    assert (recognise(video).format, recognise(tmp_path).path) == ("video", video)
    photograph(tmp_path)
    found = recognise(tmp_path)
    assert found.format == "photographs" and f"--data {video}" in found.how_to_choose()


@pytest.mark.parametrize(
    ("names", "message"),
    [
        ([], "is empty. Give a folder of photographs"),
        (["notes.odt"], "holds nothing to train on: no transforms.json"),
        (["photos.zip"], "photos.zip is an archive: unpack it"),
        (["meta_data.json"], "give `sdfstudio-data` after the options"),
        (["masks/a.png"], "holds nothing to train on"),
    ],
)
def test_folders_with_nothing_to_train_on(tmp_path: Path, names: list[str], message: str) -> None:
    for name in names:
        photograph((tmp_path / name).parent, Path(name).name)
    with pytest.raises(CaptureError, match=message):
        recognise(tmp_path)


def test_files_that_cannot_be_trained_on(tmp_path: Path) -> None:
    for name in ("a.jpg", "a.odt", "a.zip"):
        photograph(tmp_path, name)
    for name, message in (
        ("a.jpg", "is one photograph"), ("a.odt", "no file that can be"), ("b", "does not exist"),
        ("a.zip", "a.zip is an archive: unpack it"),
    ):  # fmt: skip
        with pytest.raises(CaptureError, match=message):
            recognise(tmp_path / name)


def test_a_format_that_is_not_there(tmp_path: Path) -> None:
    transforms(tmp_path, **PINHOLE)
    with pytest.raises(CaptureError, match=r"nothing of the format blender. It holds transforms.json \(nerfstudio\)"):
        recognise(tmp_path, "blender")
    with pytest.raises(CaptureError, match="--colmap-path is for COLMAP models"):
        recognise(tmp_path, "blender", Path("sparse/0"))
    with pytest.raises(CaptureError, match="sparse/0 does not exist. There is none"):
        recognise(tmp_path, colmap_path=Path("sparse/0"))
    model(tmp_path / "sparse/1")
    with pytest.raises(CaptureError, match="does not exist. Give `--colmap-path sparse/1`"):
        recognise(tmp_path, colmap_path=Path("sparse/0"))


@pytest.mark.parametrize(
    ("files", "searched"),
    [
        (["images/CLIP/a.jpg", "images/CLIP/b.jpg"], "."),
        (["images/left/a.jpg", "images/right/a.jpg"], "."),
        (["DCIM/100GOPRO/a.JPG", "DCIM/100GOPRO/b.JPG"], "DCIM/100GOPRO"),
        (["DCIM/100MEDIA/a.JPG", "DCIM/101MEDIA/a.JPG"], "DCIM"),
        (["a/b/c/d/1.png", ".bitymi/poses-1/result/cameras.png"], "a/b/c/d"),
        (["rgb/1.jpg", "Depth/1.png", "confidence/1.png", "normals/1.png", "thumbnail.jpg"], "rgb"),
    ],
)
def test_photographs_in_nested_folders(tmp_path: Path, files: list[str], searched: str) -> None:
    for path in map(Path, files):
        photograph(tmp_path / path.parent, path.name)
    found = recognise(tmp_path)
    assert (found.format, found.path) == ("photographs", tmp_path / searched)
    given = [name for name in files if not re.search("cameras|Depth|confidence|normals|thumb", name)]
    folder = photo_folder(found.path)
    assert sorted(str((folder / name).relative_to(tmp_path)) for name in find_photos(folder)) == given


def test_several_captures_in_one_folder(tmp_path: Path) -> None:
    for name in ("garden", "kitchen"):
        photograph(tmp_path / name / "images")
    with pytest.raises(CaptureError, match="It holds 2 captures: give one of them, as .*garden"):
        recognise(tmp_path)
    for name in ("garden", "kitchen"):
        transforms(tmp_path / name, **PINHOLE)
    with pytest.raises(CaptureError, match=f"It holds 2 captures: give one of them, as {tmp_path}/garden"):
        recognise(tmp_path)


@pytest.mark.parametrize("wrapped", ["room", "room/room"])
def test_a_capture_in_a_folder_of_its_own(tmp_path: Path, wrapped: str) -> None:
    """As after unpacking an archive into a new folder."""
    folder = tmp_path / wrapped
    photograph(folder / "images")
    photograph(tmp_path / "__MACOSX/images", "._a.jpg")
    path = transforms(folder, **PINHOLE)
    found = recognise(tmp_path)
    if wrapped == "room":
        assert (found.format, found.path, found.folder) == ("nerfstudio", path, folder)
        photograph(tmp_path)
        assert recognise(tmp_path).format == "photographs"  # they are what is meant
    else:
        assert found.format == "photographs"  # one folder, not a disk, is searched


def test_poses_in_a_file_of_another_name(tmp_path: Path) -> None:
    photograph(tmp_path / "images")
    path = transforms(tmp_path, "transforms_undistorted.json", **PINHOLE)
    (tmp_path / "notes.json").write_text("{}")
    for data in (tmp_path, path):
        found = recognise(data)
        assert (found.format, found.path) == ("nerfstudio", path)
    other = transforms(tmp_path, "views.json", **PINHOLE)
    assert f"views.json (`bitymi-data --data {other}`)" in recognise(tmp_path).how_to_choose()
    (tmp_path / "poses_bounds.npy").touch()
    other.unlink()
    path.unlink()
    assert recognise(tmp_path).unread[0].startswith("poses_bounds.npy (LLFF; write each as 4 x 4 numbers")
    usual = transforms(tmp_path, **PINHOLE)
    assert (recognise(tmp_path).path, recognise(tmp_path).beside, recognise(tmp_path).unread) == (usual, (), ())


def test_pictures_that_cannot_be_read_are_named(tmp_path: Path) -> None:
    for name in ("a.CR2", "b.CR2", "c.jxl"):
        photograph(tmp_path / "photos", name)
    with pytest.raises(CaptureError, match="taken for photographs: 2 .cr2 of .* .raw data .* save it as JPEG., 1 .jxl"):
        recognise(tmp_path)


def test_scans_are_told_by_files_and_folders(tmp_path: Path) -> None:
    photograph(tmp_path / "images")
    (tmp_path / "cameras").mkdir()
    assert recognise(tmp_path).format == "photographs"
    (tmp_path / "cameras/0.json").write_text("{}")
    assert recognise(tmp_path).format == "polycam"
    (tmp_path / "images").rename(tmp_path / "pictures")
    (tmp_path / "images").write_bytes(b"")
    assert recognise(tmp_path).format == "photographs"
