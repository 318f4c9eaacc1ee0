import numpy as np
import pytest

from bitymi_ns.ply import PlyError, parse_ply, write_ply

COLUMNS = {
    "x": np.array([1.5, -2.0, 3e30], dtype=np.float32),
    "y": np.zeros(3, dtype=np.float32),
    "tile_x": np.array([0, 4, 2**31 - 1], dtype=np.int32),
}


def written(folder, columns=COLUMNS, **kwargs):
    write_ply(folder / "a.ply", columns, **kwargs)
    return (folder / "a.ply").read_bytes()


def test_the_file_is_plain_ply(tmp_path):
    data = written(tmp_path, comments=["made by a test"])
    header, body = data.split(b"end_header\n")
    assert header.decode() == (
        "ply\nformat binary_little_endian 1.0\ncomment made by a test\nelement vertex 3\n"
        "property float x\nproperty float y\nproperty int tile_x\n"
    )
    assert body[:12] == np.float32(1.5).tobytes() + np.float32(0).tobytes() + np.int32(0).tobytes()
    assert len(body) == 36


def test_what_is_written_is_read(tmp_path):
    assert parse_ply(written(tmp_path, {"x": np.zeros(0, dtype=np.float32)}))["vertex"]["x"].shape == (0,)
    columns = parse_ply(written(tmp_path))["vertex"]
    assert list(columns) == list(COLUMNS)
    for name, column in COLUMNS.items():
        assert columns[name].dtype == column.dtype
        np.testing.assert_array_equal(columns[name], column)


def test_further_elements_follow(tmp_path):
    more = {"term": {"a": np.arange(5, dtype=np.float32)}, "none": {"b": np.zeros(0, dtype=np.int32)}}
    found = parse_ply(written(tmp_path, more=more))
    assert list(found) == ["vertex", "term", "none"] and found["term"]["a"].tolist() == [0, 1, 2, 3, 4]
    assert len(found["none"]["b"]) == 0 and len(found["vertex"]["x"]) == 3
    data = written(tmp_path, more=more)
    with pytest.raises(PlyError, match="not understood"):
        parse_ply(data.replace(b"element none", b"element term"))
    with pytest.raises(PlyError, match="without properties"):
        parse_ply(data.replace(b"property int b\n", b""))
    with pytest.raises(PlyError, match="no vertices"):
        parse_ply(data.replace(b"element vertex", b"element face"))


def test_other_files_are_refused_with_a_reason(tmp_path):
    data = written(tmp_path)
    cases = {
        "not a PLY": b"plx" + data[3:],
        "binary little-endian": data.replace(b"little", b"big"),
        "truncated": data[:-1],
        "too long": data + b"\0",
        "not a number": data.replace(b"vertex 3", b"vertex -3"),
        "not understood": data.replace(b"property int", b"property list"),
        "twice": data.replace(b"float y", b"float x"),
        "no vertices": data.replace(b"element vertex 3\n", b""),
        "ASCII": data.replace(b"float y", b"float \xff"),
    }
    cases["no vertices"] = b"ply\nformat binary_little_endian 1.0\nend_header\n"
    for reason, bad in cases.items():
        with pytest.raises(PlyError, match=reason):
            parse_ply(bad)
    with pytest.raises(PlyError, match="one length"):
        write_ply(tmp_path / "a.ply", {"x": np.zeros(2), "y": np.zeros(3)})
    with pytest.raises(PlyError, match="x is not finite in row 1"):
        parse_ply(written(tmp_path, {"x": np.array([0, np.nan, np.inf])}))
