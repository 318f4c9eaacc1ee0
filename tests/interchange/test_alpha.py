"""Alpha texels in files for other programs, against the CPU's baked renderer."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from bitymi_ns.bundle import Bundle
from bitymi_ns.interchange.extras import write_extras
from bitymi_ns.interchange.gaussians import Gaussians, gaussians_of
from bitymi_ns.interchange.quad_hits import nearest_hits
from bitymi_ns.interchange.quads import Quads, quads_of
from bitymi_ns.interchange.surfel_colors import fit_colors, weighted_residuals
from bitymi_ns.scene.baked import BakedScene
from bitymi_ns.scene.camera import Camera
from bitymi_ns.scene.tile_sizes import kernel_parameters
from bitymi_ns.train.init import tangents
from tests.interchange.test_frame import covariance
from tests.opened_elsewhere.splat import draw_gaussians

COUNT, SIDE, LEVEL = 40, 16, 0.15


@pytest.fixture
def cut(surfels) -> BakedScene:
    """Large surfels, each cut along a straight line; the last has no tile."""
    params, g = surfels(COUNT), torch.Generator().manual_seed(1)
    params["log_scales"] += 1.5
    params["opacity_logits"] = params["opacity_logits"].abs() + 0.5
    tiles = torch.zeros(COUNT, 5, dtype=torch.int32)
    tiles[:, 1], tiles[:, 3:] = SIDE * torch.arange(COUNT), SIDE
    tiles[-1] = 0
    axis, turn = torch.linspace(-1, 1, SIDE), 6.28 * torch.rand(COUNT, 1, 1, generator=g)
    shift = torch.rand(COUNT, 1, 1, generator=g) - 0.4
    m = torch.sigmoid(8 * (axis * turn.cos() + axis[:, None] * turn.sin() + shift))
    rgb = 0.5 + 0.25 * (torch.rand(COUNT, 1, 1, 3, generator=g).expand(-1, SIDE, SIDE, -1) - 0.5)
    atlas = torch.cat([rgb, m[..., None]], 3).view(1, COUNT * SIDE, SIDE, 4)
    means = {"mean_residual": torch.zeros(COUNT, 3), "alpha_scale": 1.0, "mean_alpha": m.mean((1, 2))}
    return BakedScene(params, "sv", tiles, atlas, -0.5, 1.0, torch.full((COUNT,), 2.4), **means)


def opaque(scene: BakedScene) -> BakedScene:
    return replace(scene, alpha_scale=0.0, mean_alpha=None)


def files(scene: BakedScene) -> tuple[Gaussians, Quads]:
    nobody = torch.zeros(0, COUNT, dtype=torch.bool), torch.zeros(0, 3, dtype=torch.float64)
    colors = fit_colors(scene, weighted_residuals(scene), *nobody)
    return gaussians_of(scene, colors.harmonics), quads_of(scene, colors.color, LEVEL)


def drawn(quads: Quads, camera: Camera) -> Tensor:
    image, hits = torch.zeros(camera.height * camera.width, 3), nearest_hits(quads, camera, 0.2)
    image[hits.pixel] = hits.color
    return image.view(camera.height, camera.width, 3)


def psnr(image: Tensor, wanted: Tensor) -> float:
    return -10 * float((image.clamp(0, 1) - wanted.clamp(0, 1)).square().mean().log10())


def test_files_draw_the_cut_that_the_renderer_draws(cut: BakedScene, camera: Callable[..., Camera]) -> None:
    view = camera(6.0)
    wanted = cut.render(view).rgb
    (gaussians, quads), (plain_gaussians, plain_quads) = files(cut), files(opaque(cut))
    gain = psnr(draw_gaussians(gaussians, view), wanted) - psnr(draw_gaussians(plain_gaussians, view), wanted)
    assert gain > 4
    assert psnr(drawn(quads, view), wanted) > psnr(drawn(plain_quads, view), wanted) + 2


def test_gaussians_have_the_moments_of_the_cut_kernel(cut: BakedScene) -> None:
    found = gaussians_of(cut, torch.zeros(COUNT, 16, 3))
    i, extent = 3, 2.4
    opacity, beta = (float(value[i]) for value in kernel_parameters(cut.surfels))
    axis = 6 * (torch.arange(400, dtype=torch.float64) + 0.5) / 400 - 3
    m = torch.nn.functional.grid_sample(  # bilinear between texel centres, constant beyond
        cut.alphas()[None, :, SIDE * i : SIDE * (i + 1)].double(),
        torch.stack(torch.meshgrid(axis / extent, axis / extent, indexing="xy"), -1)[None],
        padding_mode="border",
        align_corners=False,
    )[0, 0]
    u, v = torch.meshgrid(axis, axis, indexing="xy")
    kernel = opacity * (1 - (u**2 + v**2) / 9).clamp(min=0) ** beta * ((u**2 + v**2) < 9)
    f = (kernel * m).clamp(max=0.99)
    axes = (tangents(cut.surfels["quats"]) * cut.surfels["log_scales"].exp()[:, None])[i].double()
    offset = torch.stack([u, v], -1) @ axes.T
    mean = (f[..., None] * offset).sum((0, 1)) / f.sum()
    assert torch.allclose(found.means[i].double(), cut.surfels["means"][i].double() + mean, atol=0.02)
    centred = offset - mean
    expected = torch.einsum("yx,yxi,yxj->ij", f, centred, centred) / f.sum()
    assert torch.allclose(covariance(found)[i], expected, atol=0.03 * float(expected.max()))
    strength = (f.square().sum() / f.sum()) / (kernel.square().sum() / kernel.sum())
    assert float(found.opacity_logits[i].sigmoid()) == pytest.approx(opacity * float(strength), rel=0.03)


def test_alpha_of_one_changes_nothing_and_a_constant_the_opacity(cut: BakedScene) -> None:
    zeros, plain = torch.zeros(COUNT, 16, 3), opaque(cut)
    cut.atlas[..., 3] = 1.0
    cut.mean_alpha[:] = 1.0
    expected = gaussians_of(plain, zeros)
    for m in (1.0, 0.5):
        found = gaussians_of(replace(cut, alpha_scale=m, mean_alpha=m * cut.mean_alpha), zeros)
        assert torch.allclose(found.means, expected.means, atol=1e-5)
        assert torch.allclose(covariance(found), covariance(expected), rtol=1e-3, atol=1e-5)
        assert torch.allclose(found.opacity_logits.sigmoid(), m * expected.opacity_logits.sigmoid(), atol=1e-5)
    gone = gaussians_of(replace(cut, alpha_scale=1e-9, mean_alpha=0 * cut.mean_alpha), zeros)
    assert all(bool(torch.isfinite(value).all()) for value in vars(gone).values())
    assert float(gone.opacity_logits.sigmoid().max()) < 1 / 255


def test_quads_end_where_the_opacity_falls_to_the_level(cut: BakedScene) -> None:
    quads = quads_of(cut, torch.full((COUNT, 3), 0.5), LEVEL)
    opacity, beta = kernel_parameters(cut.surfels)
    row = 3  # every surfel has a quad
    assert len(quads) == COUNT
    pages, size = quads.pages[quads.page[row]], torch.tensor([quads.pages.shape[2], quads.pages.shape[1]])
    first, last = ((quads.uv[row, corner] * size).long() for corner in (0, 2))
    alpha = pages[first[1] : last[1] + 1, first[0] : last[0] + 1, 3] >= 128
    radius = float((quads.corners[row, 1] - quads.corners[row, 0]).norm() / 2 / cut.surfels["log_scales"][row, 0].exp())
    u, v = (torch.linspace(-1, 1, count) * radius for count in (alpha.shape[1], alpha.shape[0]))
    at = torch.stack(torch.meshgrid(u / 2.4, v / 2.4, indexing="xy"), -1)[None]
    tile = cut.alphas()[None, :, SIDE * row : SIDE * (row + 1)]
    m = torch.nn.functional.grid_sample(tile, at, padding_mode="border", align_corners=False)[0, 0]
    sigma = opacity[row] * (1 - (u**2 + v[:, None] ** 2) / 9).clamp(min=0) ** beta[row] * m
    sure = (sigma - LEVEL).abs() > 0.01
    assert torch.equal(alpha[sure], (sigma >= LEVEL)[sure]) and 0.2 < float(alpha.float().mean()) < 0.75
    cut.atlas[0, : SIDE * (COUNT - 1), :, 3] = 0.0  # leaves only the surfel without a tile
    assert len(quads_of(cut, torch.full((COUNT, 3), 0.5), LEVEL)) == 1


def test_a_cut_bundle_is_written(bundle: Bundle, camera: Callable[..., Camera], tmp_path) -> None:
    scene = bundle.scene
    scene.alpha_scale, scene.mean_alpha = 255 / 128, torch.ones(len(scene))
    scene.atlas[..., 3] = 255 * (torch.rand(scene.atlas.shape[:3], generator=torch.Generator().manual_seed(2)) > 0.5)
    written = write_extras(bundle, tmp_path / "out", cameras=[camera(5.5), camera(5.0)])
    assert all(each.count and each.bytes for each in written.values())
