"""Files of a capture that are of another type or malformed give one line with file and entry, and never hang: a table
of readers by replacements."""

import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from bitymi_ns.capture.exif import Exif, exposure_exif, read_exif
from bitymi_ns.capture.image_files import exposure_stops
from bitymi_ns.measure.report.page import build
from bitymi_ns.measure.report.records import ReportError
from bitymi_ns.plugin.console import InputError
from bitymi_ns.safe_reading import open_regular
from tests.captures import edit_frames, expect, load_any
from tests.formats import colmap, nerfstudio, polycam, scannet
from tests.measure.report.conftest import cell, figures, write_lines


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


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("form", "name"),
    [
        (nerfstudio, "room/transforms.json"),
        (nerfstudio, "room/sparse_pc.ply"),
        (colmap, "room/sparse/0/images.txt"),
        (polycam, "scan/keyframes/corrected_cameras/3.json"),
        (scannet, "scan/pose/3.txt"),
        (scannet, "scan/intrinsic/intrinsic_color.txt"),
    ],
)
def test_what_is_no_file_of_its_kind_is_one_line(
    capture: Path, form: Callable[[Path], Path], name: str, kind: Callable[[Path], None]
) -> None:
    form(capture)
    path = capture.parent / name
    path.unlink()
    kind(path)
    with pytest.raises(InputError) as stop:
        load_any(capture.parent / Path(name).parts[0])
    message = str(stop.value)
    assert "Errno" not in message and "\n" not in message
    # unreadable files may count as missing, with a message about something else
    assert path.stem in message or "has poses, but no file with the camera" in message or "nothing to train" in message


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", ["a.json", "metadata.json", "agisoft.xml", "train_list.txt"])
def test_what_may_lie_beside_a_capture_is_no_hindrance(project: Path, name: str, kind: Callable[[Path], None]) -> None:
    kind(project / name)
    try:
        assert len(load_any(project).train_dataset) > 5
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


def test_exif_that_breaks_pillow_counts_as_none(tmp_path: Path) -> None:
    """Its exposure pointer is a 64-bit number."""
    entry = (0x8769).to_bytes(2, "little") + (16).to_bytes(2, "little") + (1).to_bytes(4, "little")
    exif = b"Exif\0\0II*\0\x08\0\0\0\x01\0" + entry + (26).to_bytes(4, "little") + bytes(4) + b"\xff" * 8
    paths = [tmp_path / f"{i}.jpg" for i in range(2)]
    for path in paths:
        Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(path, exif=exif)
    assert np.isnan(exposure_stops(paths)).all()
    with Image.open(paths[0]) as image:
        assert read_exif(image) == Exif() and not dict(exposure_exif(image))


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
    named = [cell("train", {"curve": "a" * 300}), cell("eval", figures(25.0, 30.0) | {"pictures": "a" * 300})]
    cells = write_lines(tmp_path / "cells.jsonl", named)
    assert build([cells], tmp_path / "cells").is_file()
    with pytest.raises(OSError, match="no file can have this name"):
        open_regular(tmp_path / "a\0")
