"""The preview file has the layout of 3DGS, and its Gaussians have the kernels' moments."""

from pathlib import Path

import numpy as np
import pytest
import torch

from bitymi_ns import ply
from bitymi_ns.interchange.gaussians import gaussians_of, write_gaussians
from bitymi_ns.ops.constants import BETA_MAX
from tests.interchange.test_surfel_colors import baked


def test_the_columns_are_those_of_3dgs_in_its_order(surfels, tmp_path: Path) -> None:
    coefficients = torch.zeros(1, 16, 3)
    coefficients[0, 1:] = torch.arange(15.0)[:, None] + torch.tensor([100.0, 200.0, 300.0])
    g = gaussians_of(baked(surfels(1), "sv"), coefficients)
    write_gaussians(tmp_path / "a.ply", g)
    columns = ply.parse_ply((tmp_path / "a.ply").read_bytes())["vertex"]
    expected = ["x", "y", "z", "nx", "ny", "nz", *(f"f_dc_{i}" for i in range(3)), *(f"f_rest_{i}" for i in range(45))]
    assert list(columns) == [*expected, "opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    assert all(column.dtype == np.float32 for column in columns.values())
    assert [columns[f"f_rest_{i}"][0] for i in (0, 14, 15, 44)] == [100.0, 114.0, 200.0, 314.0]
    for name, value in (("x", g.means[0, 0]), ("rot_3", g.quats[0, 3]), ("scale_1", g.log_scales[0, 1])):
        assert columns[name][0] == value
    assert columns["opacity"][0] == g.opacity_logits[0]


@pytest.mark.parametrize("raw", [-3.0, 0.0, 2.0, 6.0])
def test_a_gaussian_has_the_second_moments_of_its_kernel(surfels, raw: float) -> None:
    params = surfels(1)
    params["beta_raw"], params["opacity_logits"] = torch.tensor([raw]), torch.tensor([9.0])
    g = gaussians_of(baked(params, "sv"), torch.zeros(1, 16, 3))
    beta = float(BETA_MAX * torch.sigmoid(torch.tensor(raw, dtype=torch.float64)))
    r = (torch.arange(200_000, dtype=torch.float64) + 0.5) * 3 / 200_000
    kernel = (1 - r**2 / 9) ** beta
    moment = float((kernel * r**3).sum() / (kernel * r).sum()) / 2
    found = (g.log_scales[0, :2] - params["log_scales"][0]).exp().square()
    assert torch.allclose(found, torch.full((2,), moment), rtol=1e-4)
    assert float(g.log_scales[0, 2]) < -12 and float(torch.sigmoid(g.opacity_logits)) == pytest.approx(0.99)
