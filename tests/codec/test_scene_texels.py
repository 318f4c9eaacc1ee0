"""A scene's texels as a list give the same projections as the baked renderer draws."""

from dataclasses import replace

import pytest
import torch

from bitymi_ns import ops
from bitymi_ns.codec.pages import texel_alpha
from bitymi_ns.ops.parameters import GEOMETRY
from bitymi_ns.scene.baked import BakedScene
from bitymi_ns.scene.camera import Camera
from tests.bake.conftest import make_camera, make_surfels


def cut_scene(count: int = 12, as_bytes: bool = True, **more) -> BakedScene:
    """Make large surfels with random tiles of 8 x 4 texels, the first without one, with colours and alpha."""
    surfels, g = make_surfels(count), torch.Generator().manual_seed(5)
    surfels["log_scales"] += 1.5
    tiles = torch.zeros(count, 5, dtype=torch.int32)
    tiles[:, 1], tiles[:, 3], tiles[:, 4] = 4 * torch.arange(count), 8, 4
    tiles[0] = 0
    atlas, scale = torch.rand(1, 4 * count, 8, 4, generator=g), 255 / 128
    atlas = (atlas * 255).round().to(torch.uint8) if as_bytes else atlas
    means = {"mean_residual": torch.full((count, 3), 0.1), "mean_alpha": torch.linspace(0.2, 1.5, count)}
    extent = torch.linspace(1.0, 3.0, count)
    return BakedScene(
        surfels, "sv", tiles, atlas, -0.5, 1.0, extent, **means, alpha_scale=scale, weight_bound=0.02, **more
    )


def coverage(scene: BakedScene, camera: Camera) -> torch.Tensor:
    projection = ops.project(*(scene.surfels[name] for name in GEOMETRY), camera, scene.near)
    fragments = ops.trace(replace(projection, alpha=texel_alpha(scene)))
    total = torch.zeros(camera.height * camera.width).index_add(0, fragments.pixel.long(), fragments.weight)
    return total.view(camera.height, camera.width, 1)


@pytest.mark.parametrize("as_bytes", [True, False])
def test_a_projection_is_cut_as_the_renderer_cuts(as_bytes: bool) -> None:
    scene, camera = cut_scene(as_bytes=as_bytes), make_camera(6.0)
    drawn = scene.render(camera).alpha
    assert torch.allclose(coverage(scene, camera), drawn, atol=1e-5)
    opaque = replace(scene, alpha_scale=0.0, mean_alpha=None)
    assert texel_alpha(opaque) is None and opaque.alphas() is None
    assert float((opaque.render(camera).alpha - drawn).abs().max()) > 0.1
    bare = replace(scene, atlas=None)  # every surfel has its constant
    assert torch.allclose(coverage(bare, camera), bare.render(camera).alpha, atol=1e-5)


def test_texels_are_listed_tile_after_tile() -> None:
    scene = cut_scene()
    alpha, pages = texel_alpha(scene), scene.alphas()
    assert alpha is not None and pages is not None and len(alpha.values) == 1 + 11 * 32
    assert float(alpha.values[0]) == pytest.approx(0.2)
    assert torch.equal(alpha.values[1:33], pages[0, 4:8].flatten()) and float(pages.max()) > 1.5
    blocks = replace(scene, atlas=None, blocks=torch.zeros(1, 12, 2, 16, dtype=torch.uint8))
    with pytest.raises(ValueError, match="not decoded"):
        texel_alpha(blocks)
