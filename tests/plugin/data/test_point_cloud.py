"""Point clouds: whole and damaged ones of every form, and their colors."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from bitymi_ns.capture.points import read_cloud
from bitymi_ns.plugin.data.facts import CaptureFacts
from bitymi_ns.plugin.run.model import new_scene
from bitymi_ns.scene.config import SceneConfig
from bitymi_ns.train.config import TrainConfig
from tests.captures import refused

HEADER = (
    "ply\nformat {}\ncomment by hand\nelement vertex {}\n"
    "property float x\nproperty short y\nproperty char z\nproperty double w\n{}end_header\n"
)
BINARY, TEXT = "binary_little_endian 1.0", "ascii 1.0"


def write(path: Path, body: bytes, format: str = BINARY, count: object = 3, further: str = "", ahead: str = "") -> Path:
    header = HEADER.replace("element vertex", f"{ahead}element vertex").format(format, count, further)
    path.write_bytes(header.encode() + body)
    return path


def test_whole_clouds(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    faces = "element face 1\nproperty list uchar int vertex_indices\n"
    ahead = "element camera 2\nproperty float f\n"
    for count, *written in (
        (3, bytes(45)), (0, b"", BINARY, 0), (3, b"1.5 2 3 4\n3 4 5 nan\n\n5 6 7 8", TEXT),
        (3, b"1e39 2 3 4\n" * 3, TEXT), (3, bytes(45 + 13), BINARY, 3, faces),
        (3, bytes(8 + 45), BINARY, 3, "", ahead), (3, b"1\n2\n" + 3 * b"1 2 3 4\n", TEXT, 3, "", ahead),
    ):  # fmt: skip
        points, without = read_cloud(write(path, *written), "")
        assert points.xyz.shape == (count, 3) and without == "its points have none"


@pytest.mark.parametrize(
    ("written", "message"),
    [
        ((bytes(44),), "it is cut off: it has 2 of 3 rows of the element vertex"),
        ((bytes(8 + 44), BINARY, 3, "", "element camera 2\nproperty float f\n"), "it is cut off: it has 2 of 3 rows"),
        ((b"1 2 3 4\n5 6 7 8\n", TEXT), "it is cut off: it has 2 of 3 rows"),
        *(((f"1 2 3 4\n\n{line}\n1 2 3 4\n".encode(), TEXT), rf"line 12 is not x .float32., y .*, but '{line}'")
          for line in ("1 2 3", "1 2 3 4 5", "hello 2 3 4", "1 2.5 3 4", "1 2 200 4")),
        ((b"", BINARY, 3, "property list uchar int tags\n"), "the element vertex have lists, or stand behind some"),
    ],
)  # fmt: skip
def test_damaged_clouds(tmp_path: Path, written: tuple[Any, ...], message: str) -> None:
    with refused(f"the point cloud .*a.ply cannot be read: .*{message}.*Do this."):
        read_cloud(write(tmp_path / "a.ply", *written), "Do this.")


def test_other_files(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    for data in (b"", b"ply", b"hello", b"ply\nend_header"):
        path.write_bytes(data)
        with refused("a.ply cannot be read: not a PLY file"):
            read_cloud(path, "")
    path.write_bytes(write(path, bytes(45)).read_bytes().replace(b" z\n", b" q\n"))
    for file, message in (
        (tmp_path, "it is not a regular file"),
        (tmp_path / "gone.ply", "it does not exist"),
        (path, r"it gives no z of its points \(property float z\)"),
    ):
        with refused(f"cannot be read: {message}"):
            read_cloud(file, "")


def test_a_handful_of_points_is_doubted(capsys: pytest.CaptureFixture[str]) -> None:
    one_place = torch.zeros(80, 3)
    new_scene((one_place, one_place), None, SceneConfig(texture="none"), TrainConfig(), CaptureFacts())
    assert "has only 1 different points" in " ".join(capsys.readouterr().out.split())


def colored(path: Path, kind: str, values: np.ndarray, format: str) -> Path:
    """Write a cloud in which only the colors [N, 3] matter."""
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
    points, without = read_cloud(colored(tmp_path / "a.ply", kind, values, format), "")
    assert np.array_equal(points.rgb, bytes_of) and not without
