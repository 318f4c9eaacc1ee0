"""The preview's file: the layout of 3DGS, and what is read back is what was written."""

from pathlib import Path

import numpy as np
import pytest
import torch

from bitymi_ns.bundle import ply
from bitymi_ns.interchange.gaussians import gaussians_of, read_gaussians, write_gaussians
from bitymi_ns.ops.constants import BETA_MAX
from tests.interchange.test_looks import baked


def test_a_file_is_read_as_it_was_written(surfels, tmp_path: Path) -> None:
    g = gaussians_of(baked(surfels(20), "sv"), torch.randn(20, 16, 3))
    write_gaussians(tmp_path / "a.ply", g)
    found = read_gaussians(tmp_path / "a.ply")
    for name in ("means", "quats", "log_scales", "opacity_logits", "harmonics"):
        assert torch.equal(getattr(found, name), getattr(g, name)), name


def test_the_columns_are_those_of_3dgs_in_its_order(surfels, tmp_path: Path) -> None:
    coefficients = torch.zeros(1, 16, 3)
    coefficients[0, 1:] = torch.arange(15.0)[:, None] + torch.tensor([100.0, 200.0, 300.0])
    write_gaussians(tmp_path / "a.ply", gaussians_of(baked(surfels(1), "sv"), coefficients))
    columns = ply.parse_ply((tmp_path / "a.ply").read_bytes())["vertex"]
    expected = ["x", "y", "z", "nx", "ny", "nz", *(f"f_dc_{i}" for i in range(3)), *(f"f_rest_{i}" for i in range(45))]
    assert list(columns) == [*expected, "opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    assert all(column.dtype == np.float32 for column in columns.values())
    assert [columns[f"f_rest_{i}"][0] for i in (0, 14, 15, 44)] == [100.0, 114.0, 200.0, 314.0]


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_files_of_other_programs_are_read(surfels, tmp_path: Path, degree: int) -> None:
    coefficients, terms = torch.randn(5, 16, 3), (degree + 1) ** 2
    g = gaussians_of(baked(surfels(5), "sv"), coefficients)
    write_gaussians(tmp_path / "a.ply", g)
    columns = ply.parse_ply((tmp_path / "a.ply").read_bytes())["vertex"]
    few = {name: value for name, value in columns.items() if not name.startswith(("f_rest", "n"))}
    rest = coefficients[:, 1:terms].transpose(1, 2).flatten(1)
    few |= {f"f_rest_{i}": rest[:, i].numpy() for i in range(rest.shape[1])}
    few |= {f"rot_{i}": 3 * columns[f"rot_{i}"] for i in range(4)}
    ply.write_ply(tmp_path / "b.ply", few)
    found = read_gaussians(tmp_path / "b.ply")
    assert torch.equal(found.harmonics[:, :terms], coefficients[:, :terms]) and not found.harmonics[:, terms:].any()
    assert torch.allclose(found.quats, g.quats, atol=1e-6)
    if degree:
        del few["f_rest_1"]
        ply.write_ply(tmp_path / "b.ply", few)
        with pytest.raises(ply.PlyError, match="f_rest"):
            read_gaussians(tmp_path / "b.ply")


def test_opacities_of_0_and_1_are_read(surfels, tmp_path: Path) -> None:
    write_gaussians(tmp_path / "a.ply", gaussians_of(baked(surfels(3), "sv"), torch.randn(3, 16, 3)))
    columns = ply.parse_ply((tmp_path / "a.ply").read_bytes())["vertex"]
    ply.write_ply(tmp_path / "b.ply", columns | {"opacity": np.array([-np.inf, 0.5, np.inf], np.float32)})
    found = read_gaussians(tmp_path / "b.ply").opacity_logits
    assert found.isfinite().all() and torch.sigmoid(found).tolist() == pytest.approx([0, 1 / (1 + np.exp(-0.5)), 1])
    ply.write_ply(tmp_path / "b.ply", columns | {"opacity": np.array([np.nan, 0, 0], np.float32)})
    with pytest.raises(ply.PlyError, match="opacity is not finite in row 0"):
        read_gaussians(tmp_path / "b.ply")


def test_a_missing_column_is_named(tmp_path: Path) -> None:
    ply.write_ply(tmp_path / "a.ply", {"x": np.zeros(1, np.float32)})
    with pytest.raises(ply.PlyError, match="the column y"):
        read_gaussians(tmp_path / "a.ply")


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
