"""Images from texels: against the golden render, the float64 reference, finite differences and the baked renderer."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from bitymi_ns import ops
from bitymi_ns.ops import backend
from bitymi_ns.ops.reference.texel import texel_image as reference
from bitymi_ns.scene import Camera
from bitymi_ns.scene.baked import BakedScene
from tests.ops.golden import SURFEL_KEYS, SceneCase, load_golden, random_scene

SIZES = [(4, 8), (1, 1), (8, 4), (0, 0), (4, 4), (16, 4)]


def fragments_of(case: SceneCase, dtype: torch.dtype) -> ops.Fragments:
    camera = Camera(case.viewmat.to(dtype), case.K.to(dtype), case.width, case.height)
    with torch.no_grad():
        return ops.trace(ops.project(*(case.params[key].to(dtype) for key in SURFEL_KEYS), camera))


class Case:
    """A view of a random scene whose surfels have tiles of several sizes and extents."""

    def __init__(self, n: int = 30, dtype: torch.dtype = torch.float64, **scene: int | float) -> None:
        g = torch.Generator().manual_seed(n)

        def uniform(low: float, high: float, *shape: int) -> Tensor:
            return (torch.rand(*shape, generator=g, dtype=torch.float64) * (high - low) + low).to(dtype)

        case = random_scene(n, n, **{"width": 40, "height": 30, **scene})
        self.fragments = fragments_of(case, dtype)
        size = torch.tensor(SIZES, dtype=torch.int32).repeat(n // len(SIZES) + 1, 1)[:n]
        self.tiles = ops.TexelTiles.of_sizes(size, uniform(1.0, 3.0, n))
        self.base = uniform(-0.9, 0.5, n, 3)
        self.texels = uniform(-0.6, 0.6, self.tiles.count, 3)

    def reference(self, base: Tensor, texels: Tensor, bound: float) -> Tensor:
        rows = zip(self.tiles.first.tolist(), self.tiles.size.tolist(), strict=True)
        tiles = [texels[first : first + r_u * r_v].view(r_v, r_u, 3) for first, (r_u, r_v) in rows]
        f = self.fragments
        arrays = (f.weight.double(), f.uv.double(), f.surfel, f.pixel)
        return reference(*arrays, base, tiles, self.tiles.extent.double(), bound, f.width * f.height)


@pytest.mark.parametrize("bound", [0.0, 0.05])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["double", "single"])
def test_image_and_gradients_against_the_reference(dtype: torch.dtype, bound: float) -> None:
    case = Case(dtype=dtype)
    got, want = ([t.clone().requires_grad_() for t in (case.base, case.texels)] for _ in range(2))
    want = [t.detach().double().requires_grad_() for t in want]
    image = ops.texel_image(ops.TexelFragments.of(case.fragments), *got, case.tiles, bound)
    expected = case.reference(*want, bound)
    loss_weights = torch.linspace(-1, 1, image.numel(), dtype=torch.float64).view_as(image)
    (image * loss_weights.to(dtype)).sum().backward()
    (expected * loss_weights).sum().backward()
    tolerance = 1e-12 if dtype == torch.float64 else 2e-5
    torch.testing.assert_close(image.double(), expected, rtol=tolerance, atol=tolerance)
    for mine, theirs in zip(got, want, strict=True):
        assert theirs.grad.abs().max() > 0.1
        torch.testing.assert_close(mine.grad.double(), theirs.grad, rtol=10 * tolerance, atol=10 * tolerance)


def test_gradients_by_finite_differences() -> None:
    case = Case(12, width=12, height=9, scale=0.4)
    fragments = ops.TexelFragments.of(case.fragments)
    leaves = [t.requires_grad_() for t in (case.base, case.texels)]
    assert torch.autograd.gradcheck(lambda b, t: ops.texel_image(fragments, b, t, case.tiles, 0.01), leaves)


def test_golden_image_and_gradients_of_the_texels() -> None:
    golden = load_golden("textured")
    sizes = torch.tensor([[tile.shape[1], tile.shape[0]] for tile in golden.tiles])
    tiles = ops.TexelTiles.of_sizes(sizes, torch.full((len(sizes),), 3.0, dtype=torch.float64))
    texels = torch.cat([tile.reshape(-1, 3) for tile in golden.tiles]).requires_grad_()
    fragments = fragments_of(golden, torch.float64)
    center = -golden.viewmat[:3, :3].T @ golden.viewmat[:3, 3]
    base = ops.view_color("sv", golden.params, golden.params["means"], center)
    rgb = ops.texel_image(ops.TexelFragments.of(fragments), base, texels, tiles).view_as(golden.outputs["rgb"])
    alpha = ops.composite(fragments, torch.ones(len(fragments), 1, dtype=torch.float64)).view(*rgb.shape[:2], 1)
    torch.testing.assert_close(rgb + (1 - alpha) * golden.background, golden.outputs["rgb"], rtol=1e-11, atol=1e-12)
    (rgb * golden.loss_weights["rgb"]).sum().backward()
    want = torch.cat([grad.reshape(-1, 3) for grad in golden.tile_grads])
    torch.testing.assert_close(texels.grad, want, rtol=1e-9, atol=1e-12)


def test_a_part_of_the_fragments_gives_its_part_of_the_image() -> None:
    case = Case(200, width=150, height=90)
    keep = case.fragments.weight >= 0.1
    parts = [ops.TexelFragments.of(case.fragments, each) for each in (keep, ~keep)]
    assert [len(part) for part in parts] == [int(keep.sum()), int((~keep).sum())] and 0 < len(parts[0]) < len(keep)
    image = sum(ops.texel_image(part, case.base, case.texels, case.tiles) for part in parts)
    whole = ops.texel_image(ops.TexelFragments.of(case.fragments), case.base, case.texels, case.tiles)
    torch.testing.assert_close(image, whole, rtol=1e-12, atol=1e-12)


def test_gradients_do_not_depend_on_the_number_of_threads() -> None:
    case = Case(300, torch.float32, width=150, height=90)
    results = []
    for threads in (1, 2, 3, 7):
        backend.module(torch.device("cpu")).set_num_threads(threads)
        leaves = [case.base.clone().requires_grad_(), case.texels.clone().requires_grad_()]
        image = ops.texel_image(ops.TexelFragments.of(case.fragments), *leaves, case.tiles, 0.02)
        image.square().sum().backward()
        results.append([image.detach(), *(leaf.grad for leaf in leaves)])
    backend.module(torch.device("cpu")).set_num_threads(0)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(other, results[0], strict=True))


def test_it_is_what_the_baked_renderer_shows() -> None:
    case = random_scene(60, 3, width=60, height=40)
    camera = Camera(case.viewmat, case.K, case.width, case.height)
    g = torch.Generator().manual_seed(0)
    atlas = torch.rand(1, 16, 60 * 8, 4, generator=g) - 0.5
    tiles = torch.tensor([[8 * i, 0, 0, 8, 16] for i in range(60)], dtype=torch.int32)
    extent = torch.rand(60, generator=g) * 2 + 1
    baked = BakedScene(case.params, "sv", tiles, atlas, extent=extent, weight_bound=0.03).render(camera)
    fragments = ops.TexelFragments.of(fragments_of(case, torch.float64))
    base = ops.view_color("sv", case.params, case.params["means"], camera.center)
    listed = atlas[0, :, :, :3].view(16, 60, 8, 3).transpose(0, 1).reshape(-1, 3).double()
    table = ops.TexelTiles.of_sizes(tiles[:, 3:], extent.double())
    image = ops.texel_image(fragments, base, listed, table, float(torch.tensor(0.03)))
    torch.testing.assert_close(image.view_as(baked.rgb), baked.rgb, rtol=1e-7, atol=1e-7)


def test_a_view_that_shows_nothing() -> None:
    case = Case()
    empty = ops.TexelFragments.of(case.fragments, torch.zeros(len(case.fragments), dtype=torch.bool))
    texels = case.texels.requires_grad_()
    image = ops.texel_image(empty, case.base, texels, case.tiles)
    image.sum().backward()
    assert len(empty) == 0 and not image.any() and not texels.grad.any()


def test_what_does_not_fit_is_refused() -> None:
    case = Case()
    fragments = ops.TexelFragments.of(case.fragments)
    with pytest.raises(ValueError, match="the tiles hold"):
        ops.texel_image(fragments, case.base, case.texels[1:], case.tiles)
    with pytest.raises(ValueError, match="base must have shape"):
        ops.texel_image(fragments, case.base[1:], case.texels, case.tiles)
