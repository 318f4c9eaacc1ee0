"""Files of a capture that are of another type or malformed give one line with file and entry, and never hang: a table
of readers by replacements."""

import json
import os
import shutil
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from bitymi_ns.capture.exif import Exif, exposure_exif, exposure_settings, read_exif
from bitymi_ns.capture.images import exposure_stops
from bitymi_ns.measure.report.page import build
from bitymi_ns.measure.report.records import ReportError
from bitymi_ns.plugin.console import InputError
from bitymi_ns.reading import open_regular
from tests.captures import edit, edit_frames, expect, load_any
from tests.measure.report.conftest import cell, figures, write_lines
from tests.plugin.data.test_scanner_views import polycam, record3d, scannet


@pytest.fixture(autouse=True)
def no_hang() -> Iterator[None]:
    def stop(*_: Any) -> None:
        pytest.fail("it waits for ever")  # not an Exception, which readers turn into a message

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(60)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


def pipe(path: Path) -> None:
    os.mkfifo(path)


def folder(path: Path) -> None:
    path.mkdir()


def dangling(path: Path) -> None:
    path.symlink_to(path.with_name("nothing"))


def binary(path: Path) -> None:
    path.write_bytes(b"\xff\xfe\x00\x80" * 9)


def deep(path: Path) -> None:
    path.write_bytes(b"[" * 100_000)


KINDS = [pipe, folder, dangling, binary, deep]


def nerfstudio(capture: Path, place: Path) -> Path:
    return Path(shutil.copytree(capture, place))


def colmap(capture: Path, place: Path) -> Path:
    from tests.captures import colmap_model

    place = nerfstudio(capture, place)
    colmap_model(place, place / "sparse/0")
    for name in ("transforms.json", "sparse_pc.ply"):
        (place / name).unlink()
    return place


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("make", "name"),
    [
        (nerfstudio, "transforms.json"),
        (nerfstudio, "sparse_pc.ply"),
        (polycam, "keyframes/corrected_cameras/3.json"),
        (scannet, "pose/3.txt"),
        (scannet, "intrinsic/intrinsic_color.txt"),
        (colmap, "sparse/0/images.txt"),
    ],
)
def test_what_is_no_file_of_its_kind_is_one_line(
    capture: Path, tmp_path: Path, make: Callable[[Path, Path], Path], name: str, kind: Callable[[Path], None]
) -> None:
    place = make(capture, tmp_path / "other")
    (place / name).unlink()
    kind(place / name)
    with pytest.raises(InputError) as stop:
        load_any(place)
    message = str(stop.value)
    assert "Errno" not in message and "\n" not in message
    # unreadable files may count as missing, with a message about something else
    assert (
        Path(name).stem in message
        or "has poses, but no file with the camera" in message
        or "nothing to train" in message
    )


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", ["a.json", "metadata.json", "agisoft.xml", "train_list.txt"])
def test_what_may_lie_beside_a_capture_is_no_hindrance(
    capture: Path, tmp_path: Path, name: str, kind: Callable[[Path], None]
) -> None:
    place = colmap(capture, tmp_path / "other")
    kind(place / name)
    try:
        assert len(load_any(place).train_dataset) > 5
    except InputError as stop:  # its lines are not photograph names
        assert (
            name == "train_list.txt" and kind in (binary, deep) and "own lists" in str(stop) and len(str(stop)) < 2000
        )


@pytest.mark.parametrize("kind", [pipe, folder, binary])
def test_masks_that_are_no_pictures(capture: Path, kind: Callable[[Path], None]) -> None:
    kind(capture / "m.png")
    edit_frames(capture, lambda frame: frame.update(mask_path="m.png"))
    with expect("m.png cannot be read|m.png is missing"):
        load_any(capture).train_views[0]


@pytest.mark.parametrize("kind", KINDS)
def test_reports_of_what_is_no_file(tmp_path: Path, kind: Callable[[Path], None]) -> None:
    (tmp_path / "in").mkdir()
    kind(tmp_path / "in/eval.json")
    kind(tmp_path / "in/eval_img_0001.png")
    for given in (tmp_path / "in", tmp_path / "in/eval.json"):
        with pytest.raises(ReportError, match="eval.json|nothing to report"):
            build([given], tmp_path / "report")


HUGE, NAMED = 10**400, "images/frame_00004.png"
ENTRIES: dict[str, Callable[[dict[str, Any]], Any]] = {
    "camera of images/frame_00004.png in .* cannot be read: setting an array": lambda meta: meta["frames"][3].update(
        distortion_params=[[1, 2], [3]]
    ),
    "transform_matrix of images/frame_00004.png is not a matrix": lambda meta: meta["frames"][3].update(
        transform_matrix=[[HUGE] * 4] * 4
    ),
    "camera_model .'PINHOLE'. of images/frame_00004.png is unknown": lambda meta: meta["frames"][3].update(
        camera_model=["PINHOLE"]
    ),
    "pose of images/frame_00004.png is no rotation, it is sheared": lambda meta: meta["frames"][3].update(
        transform_matrix=[[1e200, 0, 0, 0], [0, 1e-200, 0, 0], [0, 0, 1e200, 0]]
    ),
    "orientation_override is .'up'., none of pca, up": lambda meta: meta.update(orientation_override=["up"]),
    "applied_transform is not a matrix": lambda meta: meta.update(applied_transform=[[HUGE] * 4] * 3),
}


@pytest.mark.parametrize("message", ENTRIES)
def test_entries_of_transforms_json_are_named(capture: Path, message: str) -> None:
    def change(meta: dict[str, Any]) -> None:
        meta["frames"].sort(key=lambda frame: frame["file_path"])
        assert meta["frames"][3]["file_path"] == NAMED
        ENTRIES[message](meta)

    edit(capture, change)
    with expect(message):
        load_any(capture)


@pytest.mark.parametrize("value", [0, -1, float("inf"), HUGE, "wide", []])
def test_the_box_of_instant_ngp_has_a_size(capture: Path, value: Any) -> None:
    def change(meta: dict[str, Any]) -> None:
        for key in ("ply_file_path", "camera_model", "applied_transform"):
            meta.pop(key, None)
        meta["aabb_scale"] = value

    edit(capture, change)
    with expect("transforms.json: aabb_scale"):
        load_any(capture, format="instant-ngp")


@pytest.mark.parametrize(
    ("name", "old", "new", "message"),
    [
        ("cameras.txt", "48 36", f"{2**62} 36", "camera 1 .* its size has to be from 1 to 1,048,576 pixels"),
        ("cameras.txt", "48 36", f"{HUGE} 36", "camera 1 .* its size has to be from 1 to"),
        ("images.txt", "1 frame_00001.png", f"{HUGE} frame_00001.png", "frame_00001.png. was taken by camera"),
    ],
)
def test_entries_of_a_model_are_named(project: Path, name: str, old: str, new: str, message: str) -> None:
    path = project / "sparse/0" / name
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with expect(message):
        load_any(project)


def test_quaternions_that_cannot_be_normalised_are_named(project: Path) -> None:
    path = project / "sparse/0/images.txt"
    lines = path.read_text().splitlines()
    number, *quaternion = lines[0].split()[:5]
    lines[0] = " ".join([number, *(repr(float(each) * 1e-300) for each in quaternion), *lines[0].split()[5:]])
    path.write_text("\n".join(lines) + "\n")
    with expect(f"line 1: the pose of image {number} .* is not finite, or its rotation is zero"):
        load_any(project)


def test_a_pose_of_five_numbers_is_not_repeated(capture: Path, tmp_path: Path) -> None:
    place = record3d(capture, tmp_path / "scan")
    for change, message in (
        (lambda meta: meta["poses"].__setitem__(3, [0, 0, 0, 1, 0.1]), "pose 3 .* it has 5 numbers, not 7"),
        (lambda meta: meta["poses"].__setitem__(3, [HUGE] * 7), "pose 3 .*: a number in it is too large"),
        (lambda meta: meta["poses"].__setitem__(3, [0] * 7), "metadata: pose 3 .counted from 0. cannot be read"),
        (lambda meta: meta.update(perFrameIntrinsicCoeffs=[[1.0, 2.0]] * 20), "pose 0 .* it has 2 numbers, not 4"),
        (lambda meta: meta.update(K=[1.0]), "metadata cannot be read: list index out of range"),
    ):
        values = json.loads((place / "metadata").read_text())
        change(values)
        kept = (place / "metadata").read_text()
        (place / "metadata").write_text(json.dumps(values))
        with expect(message):
            load_any(place)
        (place / "metadata").write_text(kept)


def test_exif_that_breaks_pillow_counts_as_none(tmp_path: Path) -> None:
    """Its exposure pointer is a 64-bit number."""
    entry = (0x8769).to_bytes(2, "little") + (16).to_bytes(2, "little") + (1).to_bytes(4, "little")
    exif = b"Exif\0\0II*\0\x08\0\0\0\x01\0" + entry + (26).to_bytes(4, "little") + bytes(4) + b"\xff" * 8
    paths = [tmp_path / f"{i}.jpg" for i in range(2)]
    for path in paths:
        Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(path, exif=exif)
    assert np.isnan(exposure_stops(paths)).all()
    with Image.open(paths[0]) as image:
        assert read_exif(image) == Exif() and exposure_settings(image) is None and not dict(exposure_exif(image))


@pytest.mark.parametrize("ending", ["png", "jpg", "webp", "tif"])
def test_photographs_that_break_their_decoder_are_named(capture: Path, ending: str) -> None:
    image = capture / "images/frame_00004.png"
    whole = Image.open(image).convert("RGB")
    path = image.with_suffix(f".{ending}")
    image.unlink()
    whole.save(path)
    data = bytearray(path.read_bytes())
    data[40:] = b"\xff" * (len(data) - 40)
    path.write_bytes(data)
    with expect(f"frame_00004.{ending}"):
        manager = load_any(capture)
        list(manager.train_views), list(manager.eval_views)


def test_names_in_a_report_that_no_file_can_have(tmp_path: Path) -> None:
    """Found by scripts/fuzz.py."""
    view = {"view": 0, "rank": 1, "of": 1, "metrics": {"psnr": 1.0}, "files": {"final": "a\0.png"}}
    value = {"bitymi_pictures": 1, "scene": "a", "method": "b", "captions": {"final": "x"}, "views": [view]}
    (tmp_path / "pictures.json").write_text(json.dumps(value))
    assert build([tmp_path / "pictures.json"], tmp_path / "report").is_file()  # like without a picture
    named = [cell("train", {"curve": "a" * 300}), cell("pictures", {"folder": "a" * 300})]
    cells = write_lines(tmp_path / "cells.jsonl", [*named, cell("eval", figures(25.0, 30.0))])
    assert build([cells], tmp_path / "cells").is_file()
    with pytest.raises(OSError, match="no file can have this name"):
        open_regular(tmp_path / "a\0")
