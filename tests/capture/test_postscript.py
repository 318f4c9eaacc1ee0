"""PostScript named as a photograph must not be opened, as that would run it."""

from collections.abc import Callable
from pathlib import Path

import pytest
from PIL import EpsImagePlugin, Image

from bitymi_ns.capture.image_files import file_has_transparency, read_image, set_up_pillow
from bitymi_ns.capture.masks import checked_mask, write_colmap_masks
from bitymi_ns.capture.sfm_photos import read_photo
from bitymi_ns.capture.types import CaptureError
from bitymi_ns.measure.report.pictures import open_image


@pytest.fixture
def ran(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The file that the stub for Ghostscript writes."""
    script = tmp_path / "bin/gs"
    script.parent.mkdir()
    script.write_text(f"#!/bin/sh\ntouch {tmp_path / 'ran'}\n")
    script.chmod(0o755)
    monkeypatch.setenv("PATH", str(script.parent), prepend=":")
    monkeypatch.setattr(EpsImagePlugin, "gs_binary", None)
    return tmp_path / "ran"


@pytest.fixture
def disguised(tmp_path: Path) -> Path:
    path = tmp_path / "a.jpg"
    Image.new("RGB", (64, 48)).save(path, "EPS")
    return path


READERS: dict[str, Callable[[Path], object]] = {
    "photograph": lambda path: read_photo(path.parent, path.name),
    "mask of a photograph": lambda path: write_colmap_masks(path.parent / "masks", {"a": (path, (64, 48))}),
    "image": read_image,
    "mask": checked_mask,
    "picture of a report": open_image,
}


@pytest.mark.parametrize("reader", READERS)
def test_it_is_not_run(reader: str, disguised: Path, ran: Path) -> None:
    with pytest.raises((CaptureError, CaptureError, OSError), match="cannot"):
        READERS[reader](disguised)
    assert not ran.exists()
    assert not file_has_transparency(disguised)


def test_nor_by_the_readers_of_nerfstudio(disguised: Path, ran: Path) -> None:
    set_up_pillow()
    with Image.open(disguised) as image, pytest.raises(OSError, match="Ghostscript"):
        image.load()
    assert not ran.exists()
