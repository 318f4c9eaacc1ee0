"""Texels: against finite differences and the baked renderer; partial lists; coverage."""

import functools
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from bitymi_ns import ops
from bitymi_ns.ops import backend
from bitymi_ns.ops.backend import cuda_backend
from bitymi_ns.scene import Camera
from bitymi_ns.scene.baked import BakedScene
from tests.ops.golden import random_scene, traced, values_of

SIZES = [(4, 8), (1, 1), (8, 4), (0, 0), (4, 4), (16, 4)]


def textures(n: int, dtype: torch.dtype, device: torch.device | str) -> tuple[Tensor, Tensor, ops.TexelTiles]:
    """Make base colours, texels, and tiles of several sizes and extents."""
    g = torch.Generator().manual_seed(n)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return (torch.rand(*shape, generator=g, dtype=torch.float64) * (high - low) + low).to(device, dtype)

    size = torch.tensor(SIZES, dtype=torch.int32, device=device).repeat(n // len(SIZES) + 1, 1)[:n]
    tiles = ops.TexelTiles.of_sizes(size, uniform(1.0, 3.0, n))
    return uniform(-0.9, 0.5, n, 3), uniform(-0.6, 0.6, tiles.count, 3), tiles


class Case:
    """A view of a random scene whose tiles have several sizes and extents."""

    def __init__(
        self,
        n: int = 30,
        dtype: torch.dtype = torch.float64,
        device: torch.device | str = "cpu",
        **options: int | float,
    ) -> None:
        scene = random_scene(n, n, **{"width": 40, "height": 30, **options})
        with torch.no_grad():
            self.fragments, self.projection = traced(scene, values_of(scene, dtype, device))
        self.base, self.texels, self.tiles = textures(n, dtype, device)

    def image(self, base: Tensor, texels: Tensor, fragments: ops.Fragments | None = None, **options) -> Tensor:
        """Render [H W, 3]."""
        drawn = (self.fragments if fragments is None else fragments, self.projection, base, texels, self.tiles)
        return ops.blended_image(*drawn, **options)[:, :3]


def one_surfel(uv: Tensor, weight: Tensor) -> tuple[ops.Fragments, ops.Projection]:
    """Make fragments of one surfel in a row of pixels from coordinates [2, F] and weights [F]."""
    fragments, projection = row_of_pixels(len(weight), weight.dtype, weight.device, cuda_backend(weight.device))
    order = fragments.pixel.long()
    return replace(fragments, uv=uv[:, order], weight=weight[order]), projection


@functools.cache
def row_of_pixels(
    count: int, dtype: torch.dtype, device: torch.device, cuda: bool
) -> tuple[ops.Fragments, ops.Projection]:
    """Make a surfel that covers a row of pixels; `cuda`: with CUDA's layout."""
    like = torch.empty(0, dtype=dtype, device=device)
    K = torch.tensor([[100.0, 0.0, count / 2], [0.0, 100.0, 0.5], [0.0, 0.0, 1.0]]).to(like)
    surfel = [[0.0, 0.0, 2.0]], [[1.0, 0.0, 0.0, 0.0]], [[2.0, 2.0]], [4.0], [0.0]
    with torch.no_grad():
        camera = Camera(torch.eye(4).to(like), K, count, 1)
        projection = ops.project(*(torch.tensor(value).to(like) for value in surfel), camera)
        fragments = ops.trace(projection)
    assert torch.equal(fragments.pixel.sort().values.cpu(), torch.arange(count, dtype=torch.int32))
    return fragments, projection


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(
    st.sampled_from([(1, 1), (4, 1), (1, 4), (2, 2), (4, 8), (64, 4)]),
    st.sampled_from([1e-6, 1e-3, 0.5, 3.0, 16.0]),
    st.integers(0, 2**31),
)
def test_gradients_by_finite_differences(size: tuple[int, int], extent: float, seed: int) -> None:
    """Between texel centres and beyond the outer ones, for tiles of any size."""
    g = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return torch.rand(*shape, generator=g, dtype=torch.float64) * (high - low) + low

    cell = torch.stack([torch.randint(-2, side + 2, (12,), generator=g) for side in size]) + uniform(0.05, 0.95, 2, 12)
    sides = torch.tensor(size, dtype=torch.float64)[:, None]
    uv = (cell + 0.5) / sides * 2 * extent - extent  # `cell` in texels from the first centre
    tiles = ops.TexelTiles.of_sizes(torch.tensor([size]), torch.tensor([extent], dtype=torch.float64))
    base, texels = uniform(-0.4, 0.5, 1, 3), uniform(0.1, 0.6, tiles.count, 3)
    weight = torch.where(torch.arange(12) % 4 == 0, 0.01, 0.02).double()
    leaves = [t.requires_grad_() for t in (base, texels, uv / extent)]

    def image(base: Tensor, texels: Tensor, scaled: Tensor) -> Tensor:
        fragments, projection = one_surfel(scaled * extent, weight)
        return 50 * ops.blended_image(fragments, projection, base, texels, tiles, 0.02)[:, :3]

    assert torch.autograd.gradcheck(image, leaves)
    image(*leaves).sum().backward()
    slope = leaves[2].grad
    beyond = (cell < 0) | (cell > sides - 1)
    assert not slope[beyond].any() and not slope[:, ::4].any()


def test_colors_at_the_borders() -> None:
    """At the outer centres the slope is 0, and a weight at the bound has a residual."""
    tiles = ops.TexelTiles.of_sizes(torch.tensor([[4, 4]]), torch.tensor([2.0]))
    texels = torch.arange(16.0)[:, None].expand(-1, 3).contiguous()
    centre = 1.5
    uv = torch.tensor([[-centre, centre, 0.0, 0.0], [0.5, 0.5, -centre, 3.0]]).requires_grad_()
    weight = torch.tensor([0.02, 0.02, 0.02, 0.0199])
    fragments, projection = one_surfel(uv, weight)
    image = ops.blended_image(fragments, projection, torch.zeros(1, 3), texels, tiles, 0.02)[:, 0]
    torch.testing.assert_close(image / weight, torch.tensor([8.5, 11.5, 2.0, 0.5]))
    image.sum().backward()
    torch.testing.assert_close(uv.grad / 0.02, torch.tensor([[0.0, 0.0, 1.0, 0.0], [4.0, 4.0, 0.0, 0.0]]))


def test_it_is_what_the_baked_renderer_shows() -> None:
    case = random_scene(60, 3, width=60, height=40)
    camera = Camera(case.viewmat, case.K, case.width, case.height)
    g = torch.Generator().manual_seed(0)
    atlas = torch.rand(1, 16, 60 * 8, 4, generator=g) - 0.5
    tiles = torch.tensor([[8 * i, 0, 0, 8, 16] for i in range(60)], dtype=torch.int32)
    extent = torch.rand(60, generator=g) * 2 + 1
    baked = BakedScene(case.params, "sv", tiles, atlas, extent=extent, weight_bound=0.03).render(camera)
    base = ops.view_color("sv", case.params, case.params["means"], camera.center)
    texels = atlas[0, :, :, :3].view(16, 60, 8, 3).transpose(0, 1).reshape(-1, 3).double()
    table = ops.TexelTiles.of_sizes(tiles[:, 3:], extent.double())
    image = ops.blended_image(*traced(case, values_of(case)), base, texels, table, float(torch.tensor(0.03)))[:, :3]
    torch.testing.assert_close(image.view_as(baked.rgb), baked.rgb, rtol=1e-7, atol=1e-7)


def check_parts(case: Case) -> None:
    """Check two partial lists: numbers, ids, images and gradients."""
    f = case.fragments
    keep = f.weight >= 0.1
    parts = [ops.select(f, each) for each in (keep, ~keep, torch.zeros_like(keep), torch.ones_like(keep))]
    assert [len(part) for part in parts] == [int(keep.sum()), int((~keep).sum()), 0, len(f)]
    assert 0 < len(parts[0]) < len(f)
    for part, each in zip(parts, (keep, ~keep), strict=False):
        for name in ("weight", "depth", "sigma", "surfel", "pixel"):
            assert torch.equal(getattr(part, name), getattr(f, name)[each]), name
        assert torch.equal(part.uv, f.uv[:, each])

    def drawn(part: ops.Fragments) -> list[Tensor]:
        texels = case.texels.clone().requires_grad_()
        image = case.image(case.base, texels, part)
        (image * torch.linspace(-1, 1, image.numel()).view_as(image).to(image)).sum().backward()
        return [image.detach(), texels.grad]

    bright, faint, none, every = map(drawn, parts)
    whole = drawn(f)
    assert not any(t.any() for t in none) and torch.equal(every[0], whole[0])
    torch.testing.assert_close(every[1], whole[1], rtol=1e-12, atol=1e-12)  # sums in another order on CUDA
    for a, b, both in zip(bright, faint, whole, strict=True):
        assert a.any() and b.any()
        torch.testing.assert_close(a + b, both, rtol=1e-12, atol=1e-12)
    with pytest.raises(ValueError, match="keep must have shape"):
        ops.select(f, keep[1:])


def test_a_part_of_the_fragments_gives_its_part_of_the_image() -> None:
    check_parts(Case(200, width=150, height=90))


def check_coverage(case: Case, masked: bool) -> None:
    """Compare coverage with the gradient of the summed image of bright surfels, whose channels are not clipped."""
    f = case.fragments
    mask = None
    if masked:
        mask = (torch.arange(f.height * f.width) % 3 > 0).view(f.height, f.width, 1).to(f.weight.device)
    texels = torch.zeros_like(case.texels).requires_grad_()
    counts = 1.0 if mask is None else mask.view(-1, 1)
    want = []
    for power in (1, 2):
        weighed = replace(f, weight=f.weight.pow(power))
        image = case.image(torch.zeros_like(case.base), texels, weighed, bound=0.05**power)
        want.append(1 + torch.autograd.grad((image * counts).sum(), texels)[0])  # 1: initial value
    covered = torch.ones_like(case.texels[:, :2])
    ops.add_texel_coverage(case.projection, case.tiles, mask, 0.05, covered)
    assert want[0].max() > 2
    for mine, theirs in zip(covered.unbind(1), want, strict=True):
        torch.testing.assert_close(mine[:, None].expand(-1, 3), theirs, rtol=1e-11, atol=1e-11)


def check_surfel_coverage(case: Case, bound: float = 0.05) -> None:
    """Compare coverage with sums over the listed fragments."""
    f, shown = case.fragments, ops.surfel_coverage(case.projection, bound)
    for i, (largest, weights, squares) in enumerate(shown.tolist()):
        weight, sigma = f.weight[f.surfel == i], f.sigma[f.surfel == i]
        assert largest == pytest.approx(float((weight / sigma.abs()).max()) if len(weight) else 0.0, rel=1e-11)
        assert weights == pytest.approx(float(weight[weight >= bound].sum()), rel=1e-11)
        assert squares == pytest.approx(float(weight.square().sum()), rel=1e-11)
    assert (shown > 0).any(0).all() and not shown.all()


@pytest.mark.parametrize("masked", [False, True])
def test_coverage(masked: bool) -> None:
    check_coverage(Case(), masked)


def test_coverage_of_surfels() -> None:
    check_surfel_coverage(Case())


@pytest.mark.parametrize("threads", [1, 3])
def test_coverage_in_single_precision(threads: int) -> None:
    single, double = Case(200, torch.float32, width=150, height=90), Case(200, width=150, height=90)
    found = []
    backend.module(torch.device("cpu")).set_num_threads(threads)
    for case in (single, double):
        covered = torch.zeros_like(case.texels[:, :2])
        ops.add_texel_coverage(case.projection, case.tiles, None, 0.0, covered)
        found.append((covered.double(), ops.surfel_coverage(case.projection, 0.0).double()))
    backend.module(torch.device("cpu")).set_num_threads(0)
    for mine, exact in zip(*found, strict=True):
        near = torch.isclose(mine, exact, rtol=1e-4, atol=1e-4)  # a fragment may fall on the other side of a limit
        assert near.double().mean() > 0.99
        torch.testing.assert_close(mine.sum(0), exact.sum(0), rtol=1e-4, atol=1e-4)
