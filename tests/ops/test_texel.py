"""Images from texels: against the golden render, the float64 reference, finite differences and the baked renderer."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from bitymi_ns import ops
from bitymi_ns.ops import backend
from bitymi_ns.ops.fragment_list import Places
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
    with pytest.raises(ValueError, match="the tiles hold"):
        ops.texel_colors(case.fragments, case.base, case.texels[1:], case.tiles)
    with pytest.raises(ValueError, match="fragments are those of 31 surfels, not of 30"):
        ops.texel_colors(replace(case.fragments, surfels=31), case.base, case.texels, case.tiles)


def colors_by_reference(case: Case, base: Tensor, texels: Tensor, uv: Tensor, bound: float) -> Tensor:
    """[F, 3]: the reference's image of pictures with one fragment per pixel, all of weight 1."""
    f, tiles = case.fragments, case.tiles
    rows = zip(tiles.first.tolist(), tiles.size.tolist(), strict=True)
    listed = [texels[first : first + r_u * r_v].view(r_v, r_u, 3) for first, (r_u, r_v) in rows]
    light = f.weight < bound  # drawn without residual
    listed_none = [tile[:0] for tile in listed]
    each = torch.arange(len(f))
    extent = tiles.extent.double()
    one = torch.ones(len(f), dtype=torch.float64)
    plain, full = (
        reference(one, uv, f.surfel, each, base, tiles_of, extent, 0.0, len(f)) for tiles_of in (listed_none, listed)
    )
    return torch.where(light[:, None], plain, full)


@pytest.mark.parametrize("bound", [0.0, 0.05])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["double", "single"])
def test_colors_and_gradients_against_the_reference(dtype: torch.dtype, bound: float) -> None:
    case = Case(dtype=dtype)
    f = replace(case.fragments, uv=case.fragments.uv.clone())
    got = [t.clone().requires_grad_() for t in (case.base, case.texels, f.uv)]
    want = [t.detach().double().requires_grad_() for t in got]
    colors = ops.texel_colors(replace(f, uv=got[2]), got[0], got[1], case.tiles, bound)
    expected = colors_by_reference(case, *want, bound)
    loss_weights = torch.linspace(-1, 1, colors.numel(), dtype=torch.float64).view_as(colors)
    (colors * loss_weights.to(dtype)).sum().backward()
    (expected * loss_weights).sum().backward()
    tolerance = 1e-12 if dtype == torch.float64 else 2e-5
    torch.testing.assert_close(colors.double(), expected, rtol=tolerance, atol=tolerance)
    for mine, theirs in zip(got, want, strict=True):
        assert theirs.grad.abs().max() > 0.1
        torch.testing.assert_close(mine.grad.double(), theirs.grad, rtol=100 * tolerance, atol=100 * tolerance)
    still = [t.detach().clone().requires_grad_() for t in got]
    fixed = ops.texel_colors(replace(f, uv=still[2]), still[0], still[1], case.tiles, bound, move_surfels=False)
    (fixed * loss_weights.to(dtype)).sum().backward()
    assert still[2].grad is None and all(torch.equal(a.grad, b.grad) for a, b in zip(still[:2], got, strict=False))


def one_surfel(uv: Tensor, weight: Tensor) -> ops.Fragments:
    """Fragments of one surfel, given where they are."""
    count = uv.shape[1]
    zeros, start = torch.zeros(count, dtype=torch.int32), torch.tensor([0, count])
    pixel = torch.arange(count, dtype=torch.int32)
    places = Places(lambda: {"surfel": zeros, "pixel": pixel})
    return ops.Fragments(weight, uv, weight, weight, start, count, 1, start, 1, places)


@settings(max_examples=60, deadline=None)
@given(
    st.sampled_from([(1, 1), (4, 1), (1, 4), (2, 2), (4, 8), (64, 4)]),
    st.sampled_from([1e-6, 1e-3, 0.5, 3.0, 16.0]),
    st.integers(0, 2**31),
)
def test_gradients_of_colors_by_finite_differences(size: tuple[int, int], extent: float, seed: int) -> None:
    """At places between the texel centres and beyond the outer ones, in tiles of any size."""
    g = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return torch.rand(*shape, generator=g, dtype=torch.float64) * (high - low) + low

    cell = torch.stack([torch.randint(-2, side + 2, (12,), generator=g) for side in size]) + uniform(0.05, 0.95, 2, 12)
    sides = torch.tensor(size, dtype=torch.float64)[:, None]
    uv = (cell + 0.5) / sides * 2 * extent - extent  # `cell` texels from the first one's centre
    tiles = ops.TexelTiles.of_sizes(torch.tensor([size]), torch.tensor([extent], dtype=torch.float64))
    base, texels = uniform(-0.4, 0.5, 1, 3), uniform(0.1, 0.6, tiles.count, 3)
    weight = torch.where(torch.arange(12) % 4 == 0, 0.01, 0.02).double()
    leaves = [t.requires_grad_() for t in (base, texels, uv / extent)]

    def colors(base: Tensor, texels: Tensor, scaled: Tensor) -> Tensor:
        return ops.texel_colors(one_surfel(scaled * extent, weight), base, texels, tiles, 0.02)

    assert torch.autograd.gradcheck(colors, leaves)
    colors(*leaves).sum().backward()
    slope = leaves[2].grad
    beyond = (cell < 0) | (cell > sides - 1)
    assert not slope[beyond].any() and not slope[:, ::4].any()


def test_colors_at_the_borders() -> None:
    """At the outer centres the slope is 0, and a weight at the bound has its residual."""
    tiles = ops.TexelTiles.of_sizes(torch.tensor([[4, 4]]), torch.tensor([2.0]))
    texels = torch.arange(16.0)[:, None].expand(-1, 3).contiguous()
    centre = 1.5
    uv = torch.tensor([[-centre, centre, 0.0, 0.0], [0.5, 0.5, -centre, 3.0]]).requires_grad_()
    weight = torch.tensor([0.02, 0.02, 0.02, 0.0199])
    colors = ops.texel_colors(one_surfel(uv, weight), torch.zeros(1, 3), texels, tiles, 0.02)
    torch.testing.assert_close(colors[:, 0], torch.tensor([8.5, 11.5, 2.0, 0.5]))
    colors[:, 0].sum().backward()
    torch.testing.assert_close(uv.grad, torch.tensor([[0.0, 0.0, 1.0, 0.0], [4.0, 4.0, 0.0, 0.0]]))


def test_colors_sum_to_the_image_of_the_texels() -> None:
    case = Case(200, width=150, height=90)
    colors = ops.texel_colors(case.fragments, case.base, case.texels, case.tiles, 0.03)
    image = ops.texel_image(ops.TexelFragments.of(case.fragments), case.base, case.texels, case.tiles, 0.03)
    torch.testing.assert_close(ops.composite(case.fragments, colors), image, rtol=1e-12, atol=1e-12)


def test_gradients_of_colors_do_not_depend_on_the_number_of_threads() -> None:
    case = Case(300, torch.float32, width=150, height=90)
    results = []
    for threads in (1, 2, 3, 7):
        backend.module(torch.device("cpu")).set_num_threads(threads)
        leaves = [t.clone().requires_grad_() for t in (case.base, case.texels, case.fragments.uv)]
        colors = ops.texel_colors(replace(case.fragments, uv=leaves[2]), *leaves[:2], case.tiles, 0.02)
        colors.square().sum().backward()
        results.append([colors.detach(), *(leaf.grad for leaf in leaves)])
    backend.module(torch.device("cpu")).set_num_threads(0)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(other, results[0], strict=True))


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["double", "single"])
def test_a_descent_moves_the_texels_by_their_gradient(dtype: torch.dtype) -> None:
    case = Case(dtype=dtype)
    share = torch.linspace(0.1, 2.0, len(case.texels), dtype=dtype)
    texels, uv = case.texels.clone().requires_grad_(), case.fragments.uv.clone().requires_grad_()
    colors = ops.texel_colors(replace(case.fragments, uv=uv), case.base, texels, case.tiles, 0.02)
    towards = torch.linspace(-1, 1, colors.numel(), dtype=dtype).view_as(colors)
    colors.backward(towards)
    moved, at = case.texels.clone(), case.fragments.uv.clone().requires_grad_()
    again = ops.texel_colors(
        replace(case.fragments, uv=at), case.base, moved, case.tiles, 0.02, descent=ops.TexelDescent(share, 0.3)
    )
    assert torch.equal(again, colors) and torch.equal(moved, case.texels)
    again.backward(towards)
    torch.testing.assert_close(moved, case.texels - 0.3 * share[:, None] * texels.grad)
    assert texels.grad.abs().max() > 0.1 and torch.equal(at.grad, uv.grad)  # by the texels before they moved
    with pytest.raises(ValueError, match="ask for no gradient"):
        ops.texel_colors(case.fragments, case.base, texels, case.tiles, descent=ops.TexelDescent(share, 0.3))
