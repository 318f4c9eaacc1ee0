"""Surfel colours for other programs: the fit against a float64 reference, the residual against its mean."""

import pytest
import torch

from bitymi_ns.bundle import Bundle
from bitymi_ns.interchange.surfel_colors import fit_colors, rows_of, weighted_fit, weighted_residuals
from bitymi_ns.ops.reference import view_color as reference
from bitymi_ns.ops.reference.view_color import sh_basis
from bitymi_ns.scene.baked import BakedScene
from bitymi_ns.scene.tile_sizes import kernel_parameters


def baked(params: dict, kind: str, **more) -> BakedScene:
    return BakedScene(params, kind, torch.zeros(len(params["means"]), 5, dtype=torch.int32), **more)


NOBODY = torch.zeros(0, 40, dtype=torch.bool), torch.zeros(0, 3, dtype=torch.float64)


def test_the_fit_is_that_of_weighted_least_squares() -> None:
    g = torch.Generator().manual_seed(0)
    d = torch.nn.functional.normalize(torch.randn(5, 40, 3, generator=g, dtype=torch.float64), dim=2)
    values = torch.randn(5, 40, 3, generator=g, dtype=torch.float64)
    weight = torch.rand(5, 40, generator=g, dtype=torch.float64)
    found = weighted_fit(d, values, weight)
    for i in range(5):
        root = weight[i].sqrt()[:, None]
        expected = torch.linalg.lstsq(sh_basis(3, d[i]) * root, values[i] * root).solution
        assert torch.allclose(found[i], expected, rtol=0, atol=1e-9)


def test_harmonics_that_stay_positive_are_found_again(surfels) -> None:
    params = surfels(40, "sh")
    params["sh_dc"], params["sh_rest"] = params["sh_dc"].abs() + 2.0, 0.1 * params["sh_rest"]
    found = fit_colors(baked(params, "sh"), None, *NOBODY).harmonics
    assert torch.allclose(found[:, 0], params["sh_dc"], atol=1e-5)
    assert torch.allclose(found[:, 1:], params["sh_rest"], atol=1e-5)
    terms = torch.randn(7, 6)
    rows = rows_of({"means": torch.arange(6.0).view(2, 3), "view_terms": terms}, torch.tensor([1]))
    assert rows["view_terms"] is terms and rows["means"].tolist() == [[3.0, 4.0, 5.0]]


@pytest.mark.parametrize("residual", [None, -0.2])
def test_the_fit_follows_the_colour_where_cameras_look_from(surfels, residual: float | None) -> None:
    """Spherical Voronoi colours, including clipping by both ReLUs."""
    params, g = surfels(40, "sv"), torch.Generator().manual_seed(0)
    away = torch.tensor([0.0, 0.0, 1.0]) + 0.2 * torch.randn(6, 3, generator=g)
    centers = params["means"].mean(0).double() + 9 * torch.nn.functional.normalize(away, dim=1)
    seen = torch.ones(6, 40, dtype=torch.bool)
    added = None if residual is None else torch.full((40, 3), residual)
    fitted = fit_colors(baked(params, "sv"), added, seen, centers.double())
    for center in centers:
        d = torch.nn.functional.normalize(params["means"].double() - center, dim=1)
        sites = [params[name].double() for name in ("sv_sites", "sv_log_tau", "sv_rgb")]
        target = torch.relu(reference.sv(*sites, d) + 0.5)
        target = target if residual is None else torch.relu(target + residual)
        found = torch.relu((sh_basis(3, d)[..., None] * fitted.harmonics.double()).sum(1) + 0.5)
        assert float((found - target).abs().mean()) < 0.01
    assert fitted.color.shape == (40, 3) and bool((fitted.color >= 0).all())


def test_the_residual_is_the_mean_over_the_disc(bundle: Bundle) -> None:
    scene = bundle.scene
    found = weighted_residuals(scene)
    atlas, beta = scene.residuals().double(), kernel_parameters(scene.surfels)[1].double()
    for i, (x, y, layer, r_u, r_v) in enumerate(scene.tiles.tolist()):
        u, v = ((torch.arange(r) + 0.5) / r * 2 * scene.extent[i] - scene.extent[i] for r in (r_u, r_v))
        rest = (1 - (u[None] ** 2 + v[:, None] ** 2) / 9).clamp(min=0).double()
        weight = torch.where(rest > 0, rest ** beta[i], 0.0) + 1e-6
        tile = atlas[layer, y : y + r_v, x : x + r_u]
        assert torch.allclose(found[i].double(), (tile * weight[..., None]).sum((0, 1)) / weight.sum(), atol=1e-5)
    scene.atlas[..., 3], scene.alpha_scale = 0, 255 / 128
    x, y, layer, r_u, r_v = scene.tiles[0].tolist()
    scene.atlas[layer, y + 1, x + 2, 3] = 128  # everything else is transparent
    cut = weighted_residuals(scene)
    assert torch.allclose(cut[0], scene.residuals()[layer, y + 1, x + 2], atol=1e-3)
    assert torch.allclose(cut[1:], found[1:], atol=1e-5)
    scene.atlas = None
    assert torch.equal(weighted_residuals(scene), scene.mean_residual)
    scene.mean_residual = None
    assert weighted_residuals(scene) is None
