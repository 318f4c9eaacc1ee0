"""PLY files of every form: headers, rows, and headers that claim more than the file has."""

import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bitymi_ns.ply import PlyError, parse_header, read_header, read_rows, write_ply

HEADER = (
    "ply\nformat {} 1.0\ncomment Création\nobj_info by a test\nelement camera 2\nproperty double f\n"
    "element vertex {}\nproperty float x\nproperty uint8 red\nproperty short y\n{}end_header\n"
)
ROWS = [(1.5, 7, -3), (2.5, 255, 4)]
FORMS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}


def written(path: Path, form: str, count: int = 2, more: str = "", newline: str = "\n") -> Path:
    header = HEADER.format(form, count, more).replace("\n", newline).encode("latin-1")
    order = FORMS[form]
    if order:
        body = np.zeros(2, f"{order}f8").tobytes()
        body += np.array(ROWS, [("x", f"{order}f4"), ("r", "u1"), ("y", f"{order}i2")]).tobytes()
    else:
        body = newline.join(["0", "0", "", *(" ".join(map(str, row)) for row in ROWS), ""]).encode()
    path.write_bytes(header + body)
    return path


@pytest.mark.parametrize("newline", ["\n", "\r\n"])
@pytest.mark.parametrize("form", FORMS)
def test_rows_of_every_form(tmp_path: Path, form: str, newline: str) -> None:
    path = written(tmp_path / "a.ply", form, newline=newline)
    header = read_header(path)
    assert header.elements["vertex"].names == ("x", "red", "y") and header.order == FORMS[form]
    assert read_rows(path, header, "vertex").tolist() == ROWS


@pytest.mark.parametrize("form", FORMS)
def test_rows_that_a_header_only_claims_take_no_memory(tmp_path: Path, form: str) -> None:
    path = written(tmp_path / "a.ply", form, count=9_999_999_999)
    header = read_header(path)
    tracemalloc.start()
    try:
        with pytest.raises(PlyError, match="has 2 of 9999999999 rows"):
            read_rows(path, header, "vertex")
        assert tracemalloc.get_traced_memory()[1] < 1 << 20
    finally:
        tracemalloc.stop()


def test_rows_with_lists_and_those_behind_them_are_refused(tmp_path: Path) -> None:
    header = read_header(written(tmp_path / "a.ply", "binary_big_endian", more="property list uchar int tags\n"))
    assert header.elements["vertex"].row is None and header.elements["vertex"].names[-1] == "tags"
    with pytest.raises(PlyError, match="have lists"):
        read_rows(tmp_path / "a.ply", header, "vertex")


def test_a_line_that_is_no_row(tmp_path: Path) -> None:
    path = written(tmp_path / "a.ply", "ascii")
    path.write_bytes(path.read_bytes().replace(b"255", b"2.5"))
    with pytest.raises(PlyError, match="line 16 is not x .float32., red .uint8., y .int16., but '2.5 2.5 4'"):
        read_rows(path, read_header(path), "vertex")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("ply\n", "plx\n", "not a PLY file"),
        ("\nend_header", "\nend", "not a PLY file"),
        ("ascii 1.0", "ascii 2.0", "no known format: 'format ascii 2.0'"),
        ("format ascii 1.0\n", "", "no known format: 'element camera 2'"),
        ("uint8", "quad", "not understood: 'property quad red'"),
        ("float x", "list uchar x", "not understood"),
        ("short y", "short x", "the property x twice"),
        ("vertex 2", "vertex 2.0", "the count '2.0' of the element vertex is not a number"),
    ],
)
def test_headers_that_are_refused(old: str, new: str, message: str) -> None:
    header = HEADER.format("ascii", 2, "")
    with pytest.raises(PlyError, match=message):
        parse_header(header.replace(old, new).encode())


@settings(deadline=None, max_examples=200)
@given(st.binary(max_size=60), st.integers(0, 200))
def test_no_header_raises_anything_else(noise: bytes, at: int) -> None:
    good = HEADER.format("ascii", 2, "").encode()
    try:
        parse_header(good[:at] + noise + good[at:])
    except PlyError:
        pass


def test_another_reader_finds_what_a_bundle_holds(tmp_path: Path) -> None:
    plyfile = pytest.importorskip("plyfile")
    columns = {"x": np.float32([1.5, -2.0]), "tile_x": np.int32([4, 2**31 - 1])}
    write_ply(tmp_path / "a.ply", columns, ["made by a test"], {"term": {"a": np.arange(3, dtype=np.float32)}})
    found = plyfile.PlyData.read(tmp_path / "a.ply")
    assert [element.name for element in found] == ["vertex", "term"] and found.comments == ["made by a test"]
    for name, column in columns.items():
        np.testing.assert_array_equal(found["vertex"][name], column)
    np.testing.assert_array_equal(found["term"]["a"], [0, 1, 2])
