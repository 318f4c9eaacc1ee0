"""Cameras of the capture in a bundle."""

from pathlib import Path

import pytest
import torch

from bitymi_ns.bundle import check_files, read_bundle
from bitymi_ns.bundle.cameras import CapturedCamera, cameras_data
from bitymi_ns.scene.camera import Camera
from tests.bundle.made import make


@pytest.mark.parametrize("correction", [torch.tensor([0.5, 1.0, 2.0]), torch.arange(12.0).view(3, 4), None])
def test_the_correction_of_a_photograph_is_kept(surfels, tmp_path: Path, correction: torch.Tensor | None) -> None:
    camera = Camera(torch.eye(4), torch.tensor([[5.0, 0, 4], [0, 5, 3], [0, 0, 1]]), 8, 6)
    text = cameras_data([CapturedCamera.of("a", camera, True, correction=correction)])
    make(surfels, tmp_path / "b", extra_files={"cameras.json": text})
    (row,) = read_bundle(tmp_path / "b").cameras
    assert (b"correction" in text) == (correction is not None)
    assert row.exposure is None if correction is None else torch.equal(row.exposure, correction)
    assert all(check.ok for check in check_files(tmp_path / "b")[1])
