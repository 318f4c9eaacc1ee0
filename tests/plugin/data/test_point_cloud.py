"""Truncated point clouds of every format."""

from pathlib import Path

import numpy as np
import pytest
import torch

from bitymi_ns.capture.points import ply_fault, read_points
from bitymi_ns.plugin.run.model import new_scene
from bitymi_ns.scene.config import SceneConfig
from bitymi_ns.train.config import TrainConfig
from tests.captures import load, printed

HEADER = (
    "ply\nformat {}\ncomment by hand\nelement vertex {}\n"
    "property float x\nproperty short y\nproperty char z\nproperty double w\n{}end_header\n"
)
BINARY = "binary_little_endian 1.0"


def write(path: Path, body: bytes, format: str = BINARY, count: object = 3, further: str = "") -> Path:
    path.write_bytes(HEADER.format(format, count, further).encode() + body)
    return path


def test_whole_clouds(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    assert ply_fault(write(path, bytes(45))) is None
    assert ply_fault(write(path, b"", count=0)) is None
    assert ply_fault(write(path, b"1.5 2 3 4\n3 4 5 nan\n\n5 6 7 8", "ascii 1.0")) is None
    faces = "element face 1\nproperty list uchar int vertex_indices\n"
    assert ply_fault(write(path, bytes(45 + 13), further=faces)) is None
    assert ply_fault(write(path, b"", further="property list uchar int tags\n")) is None  # left to the reader


@pytest.mark.parametrize(("body", "format", "there"), [(bytes(44), BINARY, 2), (b"1 2 3 4\n5 6 7 8\n", "ascii 1.0", 2)])
def test_clouds_that_are_cut_off(tmp_path: Path, body: bytes, format: str, there: int) -> None:
    assert ply_fault(write(tmp_path / "a.ply", body, format)) == f"is cut off: it has {there} of 3 points"


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("1 2 3", "is damaged: line 12 has 3 numbers, but its points have 4"),
        ("1 2 3 4 5", "is damaged: line 12 has 5 numbers, but its points have 4"),
        ("hello 2 3 4", "is damaged: line 12 has 'hello' for x, which is no number of that kind (float32)"),
        ("1e39 2 3 4", "is damaged: line 12 has '1e39' for x, which is no number of that kind (float32)"),
        ("1 2.5 3 4", "is damaged: line 12 has '2.5' for y, which is no number of that kind (int16)"),
        ("1 2 200 4", "is damaged: line 12 has '200' for z, which is no number of that kind (int8)"),
    ],
)
def test_a_line_in_the_middle_that_is_no_point(tmp_path: Path, line: str, message: str) -> None:
    body = f"1 2 3 4\n\n{line}\n1 2 3 4\n"
    assert ply_fault(write(tmp_path / "a.ply", body.encode(), "ascii 1.0")) == message


def test_points_behind_another_element(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    whole = HEADER.replace("element vertex", "element camera 2\nproperty float f\nelement vertex")
    for format, body in ((BINARY, bytes(8 + 45)), ("ascii 1.0", b"1\n2\n" + 3 * b"1 2 3 4\n")):
        path.write_bytes(whole.format(format, 3, "").encode() + body)
        assert ply_fault(path) is None
        path.write_bytes(path.read_bytes()[:-8])
        assert ply_fault(path) == "is cut off: it has 2 of 3 points"


def test_other_files(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    for data in (b"", b"ply", b"hello", b"ply\nend_header"):
        path.write_bytes(data)
        assert ply_fault(path) == "is not a PLY file"
    assert "no points" in str(ply_fault(write(path, b"", count="many")))
    assert "the count 'many' of the element vertex is not a number" in str(ply_fault(path))
    assert "cannot be read" in str(ply_fault(tmp_path))
    path.write_bytes(write(path, bytes(45)).read_bytes().replace(b" z\n", b" q\n"))
    assert ply_fault(path) == "gives no z of its points (property float z)"


def test_a_handful_of_points_is_doubted(capsys: pytest.CaptureFixture[str]) -> None:
    one_place = torch.zeros(80, 3)
    new_scene((one_place, one_place), None, SceneConfig(texture="none"), TrainConfig(), {})
    assert "has only 1 different points to start from" in " ".join(capsys.readouterr().out.split())


def colored(path: Path, kind: str, values: np.ndarray, format: str) -> Path:
    """Write a cloud in which only the colours [N, 3] matter."""
    order = {"binary_little_endian": "<", "binary_big_endian": ">"}.get(format)
    names = [f"property float {name}\n" for name in "xyz"] + [
        f"property {kind} {n}\n" for n in ("red", "green", "blue")
    ]
    head = f"ply\nformat {format} 1.0\nelement vertex {len(values)}\n{''.join(names)}end_header\n"
    if order is None:
        body = "".join(f"1 2 3 {' '.join(map(str, row))}\n" for row in values.tolist()).encode()
    else:
        number = {"float": "f4", "double": "f8", "ushort": "u2", "uchar": "u1"}[kind]
        body = b"".join(bytes(12) + row.astype(order + number).tobytes() for row in values)
    path.write_bytes(head.encode() + body)
    return path


@pytest.mark.parametrize(
    ("format", "kind", "white"),
    [
        ("ascii", "float", 1),
        ("binary_little_endian", "double", 1),
        ("binary_big_endian", "float", 255),
        ("ascii", "ushort", 65535),
    ],
)
def test_colors_that_are_no_bytes(tmp_path: Path, format: str, kind: str, white: int) -> None:
    bytes_of = np.uint8([[0, 128, 255], [7, 66, 200]])
    values = bytes_of * (white / 255) if kind != "ushort" else bytes_of.astype(int) * 257
    points, without = read_points(colored(tmp_path / "a.ply", kind, values, format))
    assert np.array_equal(points.rgb, bytes_of) and not without


def test_colors_of_unknown_scale(tmp_path: Path, capture: Path, capsys: pytest.CaptureFixture[str]) -> None:
    points, without = read_points(write(tmp_path / "a.ply", bytes(45)))
    assert len(points.rgb) == 0 and without == "its points have none"
    colored(capture / "sparse_pc.ply", "float", np.float32([[-1, 0, 2000]] * 9), "ascii")
    load(capture)
    assert "get the colors of the photographs that see them: its colors lie between -1 and 2000" in printed(capsys)
