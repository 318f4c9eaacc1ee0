"""PLY files of every form: headers, rows, and headers that claim more than the file has."""

import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bitymi_ns.ply import PlyError, parse_header, parse_ply, read_header, read_rows, write_ply

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


COLUMNS = {"x": np.float32([1.5, -2.0, 3e30]), "y": np.zeros(3, np.float32), "tile_x": np.int32([0, 4, 2**31 - 1])}
MORE = {"term": {"a": np.arange(5, dtype=np.float32)}, "none": {"b": np.zeros(0, dtype=np.int32)}}


def of_a_bundle(path: Path, columns: Any = COLUMNS, **options: Any) -> bytes:
    write_ply(path, columns, **options)
    return path.read_bytes()


def test_the_file_is_plain_ply(tmp_path: Path) -> None:
    header, body = of_a_bundle(tmp_path / "a.ply", comments=["made by a test"]).split(b"end_header\n")
    assert header.decode() == (
        "ply\nformat binary_little_endian 1.0\ncomment made by a test\nelement vertex 3\n"
        "property float x\nproperty float y\nproperty int tile_x\n"
    )
    assert body[:12] == np.float32(1.5).tobytes() + np.float32(0).tobytes() + np.int32(0).tobytes()
    assert len(body) == 36


def test_what_is_written_is_read_also_by_another_reader(tmp_path: Path) -> None:
    plyfile, path = pytest.importorskip("plyfile"), tmp_path / "a.ply"
    assert parse_ply(of_a_bundle(path, {"x": np.zeros(0, np.float32)}))["vertex"]["x"].shape == (0,)
    found, want = parse_ply(of_a_bundle(path, comments=["by a test"], more=MORE)), {"vertex": COLUMNS, **MORE}
    other = plyfile.PlyData.read(path)
    assert list(found) == [element.name for element in other] == list(want) and other.comments == ["by a test"]
    for element, columns in want.items():
        assert list(found[element]) == list(columns)
        for name, column in columns.items():
            assert found[element][name].dtype == column.dtype
            np.testing.assert_array_equal(found[element][name], column)
            np.testing.assert_array_equal(other[element][name], column)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"little", b"big", "binary little-endian"),
        (b"end_header\n", b"end_header\n\0", "too long"),
        (b"end_header\n\0", b"end_header\n", "truncated"),
        (b"float y", b"float \xff", "ASCII"),
        (b"element none", b"element term", "not understood"),
        (b"property int b\n", b"", "without properties"),
        (b"element vertex", b"element face", "no vertices"),
    ],
)
def test_files_that_no_bundle_has(tmp_path: Path, old: bytes, new: bytes, message: str) -> None:
    data = of_a_bundle(tmp_path / "a.ply", {"x": np.zeros(2, np.float32), "y": np.zeros(2, np.float32)}, more=MORE)
    with pytest.raises(PlyError, match=message):
        parse_ply(data.replace(old, new))


def test_columns_that_no_bundle_has(tmp_path: Path) -> None:
    with pytest.raises(PlyError, match="no vertices"):
        parse_ply(b"ply\nformat binary_little_endian 1.0\nend_header\n")
    with pytest.raises(PlyError, match="one length"):
        write_ply(tmp_path / "a.ply", {"x": np.zeros(2), "y": np.zeros(3)})
    with pytest.raises(PlyError, match="x is not finite in row 1"):
        parse_ply(of_a_bundle(tmp_path / "a.ply", {"x": np.array([0, np.nan, np.inf])}))
