"""Point clouds that are cut off, whatever their format."""

from __future__ import annotations

from pathlib import Path

import pytest

from bitymi_ns.host.point_cloud import what_is_wrong_with

HEADER = "ply\nformat {}\ncomment by hand\nelement vertex {}\nproperty double x\nproperty uchar red\n{}end_header\n"
BINARY = "binary_little_endian 1.0"


def write(path: Path, body: bytes, format: str = BINARY, count: object = 3, further: str = "") -> Path:
    path.write_bytes(HEADER.format(format, count, further).encode() + body)
    return path


def test_whole_clouds(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    assert what_is_wrong_with(write(path, bytes(27))) is None
    assert what_is_wrong_with(write(path, b"", count=0)) is None
    assert what_is_wrong_with(write(path, b"1 2\n3 4\n\n5 6", "ascii 1.0")) is None
    faces = "element face 1\nproperty list uchar int vertex_indices\n"
    assert what_is_wrong_with(write(path, bytes(27 + 13), further=faces)) is None


@pytest.mark.parametrize(("body", "format", "there"), [(bytes(26), BINARY, 2), (b"1 2\n3 4\n", "ascii 1.0", 2)])
def test_clouds_that_are_cut_off(tmp_path: Path, body: bytes, format: str, there: int) -> None:
    assert what_is_wrong_with(write(tmp_path / "a.ply", body, format)) == f"is cut off: it has {there} of 3 points"


def test_rows_of_unknown_length_are_left_to_the_reader(tmp_path: Path) -> None:
    assert what_is_wrong_with(write(tmp_path / "a.ply", b"", further="property list uchar int tags\n")) is None


def test_other_files(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    for data in (b"", b"ply", b"hello", b"ply\nend_header"):
        path.write_bytes(data)
        assert what_is_wrong_with(path) == "is not a PLY file"
    assert "no points" in str(what_is_wrong_with(write(path, b"", count="many")))
    assert "cannot be read" in str(what_is_wrong_with(tmp_path))
