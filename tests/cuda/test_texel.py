"""Texels on CUDA: any tile, any number of fragments, partial lists, coverage."""

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from torch import Tensor

from bitymi_ns import ops
from tests.ops.test_kernels import relative
from tests.ops.test_texel import Case, check_coverage, check_parts, check_surfel_coverage, one_surfel


def of_one_surfel(
    device: torch.device, uv: Tensor, weight: Tensor, tiles: ops.TexelTiles, *leaves: Tensor
) -> list[Tensor]:
    """Compute the image and the gradients of base, texels and uv; the last leaf is the image's gradient."""
    base, texels, towards = (t.to(device) for t in leaves)
    learns = [t.clone().requires_grad_() for t in (base, texels, uv.to(device))]
    fragments, projection = one_surfel(learns[2], weight.to(device))
    tiles = ops.TexelTiles.of_sizes(tiles.size.to(device), tiles.extent.to(device))
    image = ops.blended_image(fragments, projection, *learns[:2], tiles, 0.02)[:, :3]
    image.backward(towards)
    return [t.detach().cpu() for t in (image, *(leaf.grad for leaf in learns))]


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.sampled_from([(1, 1), (4, 1), (1, 4), (2, 2), (4, 8), (64, 4)]),
    st.sampled_from([1e-6, 1e-3, 0.5, 3.0, 16.0]),
    st.sampled_from([1e-30, 1.0, 1e30]),
    st.sampled_from([1, 16, 70]),
    st.integers(0, 2**31),
)
def test_one_surfel_of_any_tile(both, size: tuple[int, int], extent: float, huge: float, count: int, seed: int) -> None:
    """Fragments of one tile in the same and different cells, at texel centres, between and beyond them."""
    g = torch.Generator().manual_seed(seed)
    sides = torch.tensor(size, dtype=torch.float64)[:, None]
    cell = torch.stack([torch.randint(-2, side + 2, (count,), generator=g) for side in size])
    between = torch.rand(2, count, generator=g, dtype=torch.float64) * (torch.rand(count, generator=g) < 0.8)
    uv = (cell + between + 0.5) / sides * 2 * extent - extent
    weight = torch.where(torch.arange(count) % 4 == 0, 0.01, 0.02).double()
    tiles = ops.TexelTiles.of_sizes(torch.tensor([size]), torch.tensor([extent], dtype=torch.float64))
    base, texels = (torch.randn(n, 3, generator=g, dtype=torch.float64) for n in (1, tiles.count))
    towards = huge * torch.randn(count, 3, generator=g, dtype=torch.float64)
    got, want = both(lambda where: of_one_surfel(where, uv, weight, tiles, base, texels, towards))
    assert all(relative(a, b) < 1e-12 for a, b in zip(got, want, strict=True))


def test_a_part_of_the_fragments_gives_its_part_of_the_image(device: torch.device) -> None:
    check_parts(Case(40, device=device, width=50, height=40))


@pytest.mark.parametrize("masked", [False, True])
def test_coverage(masked: bool, device: torch.device) -> None:
    check_coverage(Case(device=device), masked)


def test_coverage_of_surfels(device: torch.device) -> None:
    check_surfel_coverage(Case(device=device))


def test_tensors_of_another_device_are_refused(device: torch.device) -> None:
    if device.type != "cuda":
        pytest.skip("all tensors are on the CPU")
    case = Case(device=device)
    with pytest.raises(ValueError, match="share is on device 'cpu'"):
        case.image(case.base, case.texels, descent=ops.TexelDescent(torch.ones(len(case.texels)), 0.1))
