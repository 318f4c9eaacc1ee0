"""Captures that the benchmarks read without nerfstudio."""

import importlib.util
import json
import math
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
from PIL import Image

FOLDER = Path(__file__).resolve().parents[2] / "benchmarks"


@pytest.fixture
def captures(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    spec = importlib.util.spec_from_file_location("plain_capture", FOLDER / "plain_capture.py")
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "plain_capture", module)
    spec.loader.exec_module(module)
    return module


def write_points(path: Path) -> None:
    names = [*(f"property float {n}" for n in "xyz"), *(f"property uchar {n}" for n in ("red", "green", "blue"))]
    head = ["ply", "format binary_little_endian 1.0", "element vertex 1", *names, "end_header", ""]
    path.write_bytes("\n".join(head).encode() + np.array([1, 2, 3], "<f4").tobytes() + bytes([255, 0, 51]))


def test_both_splits_are_read_with_their_alpha(captures: ModuleType, tmp_path: Path) -> None:
    pose = np.eye(4)
    pose[:3, 3] = (0.0, 0.0, 4.0)  # looks down the z axis, from above
    for split, count in (("train", 2), ("test", 1)):
        names = [f"{split}/r_{i}" for i in range(count)]
        (tmp_path / split).mkdir()
        for name in names:
            Image.new("RGBA", (8, 6), (10, 20, 30, 128)).save(tmp_path / f"{name}.png")
        frames = [{"file_path": f"./{name}", "transform_matrix": pose.tolist()} for name in names]
        meta = {"camera_angle_x": 2 * math.atan(0.5), "frames": frames}
        (tmp_path / f"transforms_{split}.json").write_text(json.dumps(meta))
    write_points(tmp_path / "points.ply")
    found = captures.load_split_capture(tmp_path, "points.ply", downscale=2)
    assert [len(found.train), len(found.held_out)] == [2, 1]
    picture = found.train[0].image
    assert picture.shape == (3, 4, 4) and (picture.int() - torch.tensor([10, 20, 30, 128])).abs().max() <= 1
    camera = found.held_out[0].camera
    assert (camera.width, camera.height) == (4, 3)
    x, y, w = (camera.K @ (camera.viewmat[:3] @ torch.tensor([1.0, 1.0, 0.0, 1.0]))).tolist()
    assert [x / w, y / w, w] == pytest.approx([3.0, 0.5, 4.0])
    assert found.points.tolist() == [[1, 2, 3]] and torch.allclose(found.colours, torch.tensor([[1.0, 0.0, 0.2]]))
