"""COLMAP models that lie elsewhere, or are not whole."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import pytest
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.data.utils import colmap_parsing_utils as reader

from bitymi_ns.plugin.data.datamanager import BitymiDataManager
from tests.plugin.data.captures import colmap_model, expect, load, load_with, said


@pytest.fixture
def model(capture: Path) -> Path:
    """A model in text, in the capture's folder sparse/0."""
    colmap_model(capture, capture / "sparse/0")
    return capture / "sparse/0"


def load_model(model: Path, **options: Any) -> BitymiDataManager:
    return load_with(model.parents[1], ColmapDataParserConfig(colmap_path=Path("sparse/0"), **options))


def as_binary(model: Path) -> None:
    """Write the model anew as COLMAP does without being asked for text."""
    for what in ("cameras", "images", "points3D"):
        read, write = getattr(reader, f"read_{what}_text"), getattr(reader, f"write_{what}_binary")
        write(read(model / f"{what}.txt"), model / f"{what}.bin")
        (model / f"{what}.txt").unlink()


def test_where_a_colmap_model_lies_is_told(capture: Path) -> None:
    with expect("COLMAP model .*colmap/sparse/0 does not exist, and there is none in other folders"):
        load_with(capture, ColmapDataParserConfig())
    colmap_model(capture, capture / "sparse/0")
    with expect("does not exist. Give `colmap --data .* --colmap-path sparse/0`"):
        load_with(capture, ColmapDataParserConfig())
    with expect("folder of photographs .*photos does not exist.*--images-path"):
        load_with(capture, ColmapDataParserConfig(colmap_path=Path("sparse/0"), images_path=Path("photos")))
    (capture / "transforms.json").unlink()
    with expect("holds no transforms.json. It has a COLMAP model: give `colmap --data .* --colmap-path sparse/0`"):
        load(capture)


def test_reduced_photographs_that_nobody_can_be_asked_for(capture: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    colmap_model(capture, capture / "sparse/0")
    monkeypatch.setattr("sys.stdin", io.StringIO())  # a batch job: the host's question meets the end of its input
    with expect("has no reduced photographs.*Give `--downscale-factor 1` after the parser's name"):
        load_with(capture, ColmapDataParserConfig(colmap_path=Path("sparse/0"), downscale_factor=2))


def replace(old: str, new: str) -> Any:
    return lambda text: text.replace(old, new, 1)


@pytest.mark.parametrize(
    ("file", "change", "message"),
    [
        ("cameras.txt", replace(" 40 40 24 18", " 40"), "cameras.txt: camera 1 has 1 parameters, but a PINHOLE has 4"),
        (
            "cameras.txt",
            replace("1 PIN", "7 PIN"),
            r"image 1 \(frame_00001.png\) was taken by camera 1, .* only 7",
        ),
        ("cameras.txt", replace("48", "wide"), "cameras.txt has a line that cannot be read .*wide"),
        ("images.txt", lambda text: text.replace("\n\n", "\n"), "images.txt has a line .*Each image has two lines"),
        (
            "images.txt",
            lambda text: text.replace("frame_00004.png", "../frame_00004.png"),
            "images.txt, image 4: the name '../frame_00004.png' leads elsewhere",
        ),
        ("images.txt", lambda text: "# nothing\n", "images.txt lists no images: COLMAP found no poses"),
        ("points3D.txt", replace("200", "red"), "points3D.txt has a line that cannot be read .*red"),
    ],
)
def test_files_of_a_model_that_cannot_be_used_are_named(model: Path, file: str, change: Any, message: str) -> None:
    path = model / file
    path.write_text(change(path.read_text()))
    with expect(message):
        load_model(model)


@pytest.mark.parametrize("pose", ["nan 0 0 0 0 0 0", "0 0 0 0 1 2 3", "1 0 0 0 0 inf 0"])
def test_a_pose_that_is_none_is_named_itself(model: Path, pose: str) -> None:
    path = model / "images.txt"
    lines = path.read_text().split("\n")
    lines[6] = f"4 {pose} 1 frame_00004.png"
    path.write_text("\n".join(lines))
    with expect(r"images.txt, line 7: the pose of image 4 \(frame_00004.png\) is not finite, or its rotation is zero"):
        load_model(model)


def test_a_file_that_is_missing(model: Path) -> None:
    (model / "images.txt").unlink()
    with expect("the COLMAP model lacks .*images.txt. Copy the whole model"):
        load_model(model)


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
@pytest.mark.parametrize("left", [3, -5])
def test_a_file_that_is_cut_off(model: Path, name: str, left: int) -> None:
    as_binary(model)
    path = model / name
    path.write_bytes(path.read_bytes()[:left])
    with expect(f"{name} is cut off or damaged. Copy the model again"):
        load_model(model)


@pytest.mark.parametrize("binary", [False, True])
@pytest.mark.parametrize("missing", [False, True])
def test_a_model_without_points(model: Path, capsys: pytest.CaptureFixture[str], binary: bool, missing: bool) -> None:
    (model / "points3D.txt").write_text("# no points\n")
    if binary:
        as_binary(model)
    if missing:
        next(model.glob("points3D.*")).unlink()
    manager = load_model(model)
    assert "points3D_xyz" not in manager.train_dataparser_outputs.metadata
    message = said(capsys)
    assert message.count("Training starts from random points.") == 1
    assert ("has no points3D.bin or points3D.txt" if missing else "has no points: points3D.") in message


def test_nerfstudios_reader_is_left_as_it_was(model: Path) -> None:
    before = reader.read_images_text
    load_model(model)
    assert reader.read_images_text is before
