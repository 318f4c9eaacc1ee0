"""Point clouds that are cut off, whatever their format."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from bitymi_ns.host import point_cloud
from bitymi_ns.host.point_cloud import what_is_wrong_with
from bitymi_ns.host.scene_setup import new_scene
from bitymi_ns.scene.config import SceneConfig
from bitymi_ns.train.config import TrainConfig

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


def test_making_surfels_of_many_points_is_announced_and_timed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    points = (torch.rand(60, 3), torch.rand(60, 3))

    def printed() -> str:
        new_scene(points, None, SceneConfig(texture="none"), TrainConfig(), {})
        return " ".join(capsys.readouterr().out.split())

    assert printed() == ""
    monkeypatch.setattr(point_cloud, "MANY_POINTS", 60)
    message = printed()
    assert "Making surfels of 60 points. This may take minutes." in message
    assert "Making surfels of 60 points took" in message


def test_a_handful_of_points_is_doubted(capsys: pytest.CaptureFixture[str]) -> None:
    one_place = torch.zeros(80, 3)
    new_scene((one_place, one_place), None, SceneConfig(texture="none"), TrainConfig(), {})
    assert "has only 1 different points to start from" in " ".join(capsys.readouterr().out.split())
