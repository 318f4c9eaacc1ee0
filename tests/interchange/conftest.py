"""Small scenes of the bake's tests, and a bundle with texels."""

from pathlib import Path

import numpy as np
import pytest
import torch

from bitymi_ns.bundle import Bundle, read_bundle
from bitymi_ns.bundle.world import World
from tests.bake.conftest import camera, scene, surfels
from tests.bundle.made import make

__all__ = ["camera", "scene", "surfels"]

TURN = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64))[0]


@pytest.fixture
def bundle(surfels, tmp_path: Path) -> Bundle:
    """A bundle of twelve surfels with texels, rotated, shifted and scaled in the capture's frame."""
    turn = TURN * torch.linalg.det(TURN)
    transform = np.concatenate([turn.numpy(), [[0.3], [-1.0], [2.0]]], axis=1)
    make(surfels, tmp_path / "bundle", count=12, mean_residual=torch.full((12, 3), 0.1), world=World(transform, 0.4))
    return read_bundle(tmp_path / "bundle")
