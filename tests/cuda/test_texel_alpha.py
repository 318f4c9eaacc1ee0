"""Alpha texels on CUDA: fragments and gradients against the CPU, which tests/ops checks by finite differences."""

from dataclasses import dataclass, replace

import pytest
import torch
from torch import Tensor

from bitymi_ns import ops
from bitymi_ns.ops.parameters import GEOMETRY
from tests.cuda.conftest import HERE, in_orders
from tests.cuda.test_trace import by_pixel_and_surfel
from tests.ops.golden import SceneCase, camera_of, random_scene, relative


@dataclass
class Cut:
    """A scene with alpha texels."""

    case: SceneCase
    size: Tensor
    extent: Tensor
    alpha: Tensor
    bound: float = 0.02


def cut_scene(seed: int, count: int = 60, width: int = 50, height: int = 40, extreme: bool = False, **options) -> Cut:
    """Make surfels with tiles of 1 x 1 to 8 x 8 texels and some without; extreme: alphas of 0, of 2, of 1 and far below
    it, opaque and nearly invisible surfels, and extents that end within the support."""
    case = random_scene(count, seed, width, height)
    g = torch.Generator().manual_seed(seed)
    size = torch.randint(1, 9, (count, 2), generator=g, dtype=torch.int32)
    size[::5], size[1::7] = 0, 1
    extent = 1.5 + 1.5 * torch.rand(count, generator=g, dtype=torch.float64)
    texels = int(size.long().prod(1).sum())
    alpha = 2 * torch.rand(texels, generator=g, dtype=torch.float64)
    if extreme:
        few = torch.tensor([0.0, 2.0, 1.0, 1e-3, 1e-30], dtype=torch.float64)
        alpha = few[torch.randint(len(few), (texels,), generator=g)]
        case.params["opacity_logits"][::3], case.params["opacity_logits"][1::4] = 12.0, -5.0
        extent[::2] *= 0.1
    return Cut(case, size, extent, alpha, **options)


def traced(cut: Cut, dtype: torch.dtype, device: torch.device, seen: str = "weight uv depth") -> tuple:
    """Trace the fragments and compute gradients by name of a sum over the fields in `seen`."""
    leaves = {key: cut.case.params[key].to(device, dtype).clone().requires_grad_() for key in GEOMETRY}
    leaves["alpha"] = cut.alpha.to(device, dtype).clone().requires_grad_()
    projection = ops.project(*(leaves[key] for key in GEOMETRY), camera_of(cut.case, dtype))
    tiles = ops.TexelTiles.of_sizes(cut.size.to(device), cut.extent.to(device, dtype))
    fragments = ops.trace(replace(projection, alpha=ops.TexelAlpha(tiles, leaves["alpha"], cut.bound)), 1e-3)
    direction = torch.sin(fragments.pixel.double() * 0.7 + fragments.surfel.double() * 1.3).to(dtype)
    sum((getattr(fragments, name) * direction).sum() for name in seen.split()).backward()
    return fragments, {key: leaf.grad.cpu().double() for key, leaf in leaves.items()}


def is_cut(cut: Cut, fragments: ops.Fragments) -> Tensor:
    """Mask [F], by pixel and surfel, of marked fragments of surfels with tiles."""
    order = torch.argsort(fragments.pixel.cpu().long() * (1 << 32) + fragments.surfel.cpu().long())
    has_tile = cut.size[fragments.surfel.cpu().long(), 0] > 0
    marks = fragments.uv.detach()[1].cpu().contiguous().view(torch.int64) & 1
    return (marks.bool() & has_tile)[order]


@pytest.mark.parametrize("seen", ["weight uv depth", "weight", "uv depth"])
@pytest.mark.parametrize(
    "cut",
    [
        *(cut_scene(seed, extreme=seed % 2 == 1) for seed in range(4)),
        cut_scene(4, bound=0.0),
        cut_scene(5, bound=0.0, extreme=True),
        cut_scene(6, 30, 33, 17, extreme=True),
        cut_scene(7, 150, 20, 20, bound=0.1),
    ],
    ids=lambda cut: f"{cut.bound} {len(cut.size)}",
)
def test_fragments_and_gradients_are_those_of_the_cpu(cut: Cut, seen: str, both) -> None:
    (got, gradients), (want, expected) = both(lambda where: traced(cut, torch.float64, where, seen))
    for a, b in zip(by_pixel_and_surfel(got), by_pixel_and_surfel(want), strict=True):
        assert a.shape == b.shape and relative(a, b) < 1e-9
    marks = is_cut(cut, got)
    assert torch.equal(marks, is_cut(cut, want)) and 0 < marks.sum() < len(marks)
    assert bool(expected["alpha"].abs().max() > 0) == ("weight" in seen)
    for key, value in expected.items():
        assert gradients[key].isfinite().all() and relative(gradients[key], value) < 1e-8, key


def test_alphas_of_one_change_nothing(device: torch.device) -> None:
    cut = cut_scene(2)
    cut.alpha[:] = 1.0
    fragments, gradients = traced(cut, torch.float32, device)
    plain, expected = traced(replace(cut, size=torch.zeros_like(cut.size), alpha=cut.alpha[:0]), torch.float32, device)
    assert torch.equal(fragments.weight, plain.weight) and torch.equal(fragments.sigma, plain.sigma)
    for key in GEOMETRY:  # slopes along u and v are 0, and v differs in its mark
        assert relative(gradients[key], expected[key]) < 1e-5, key


def test_single_precision(device: torch.device, cpu) -> None:
    cut = cut_scene(8)
    got, gradients = traced(cut, torch.float32, device)
    with cpu():
        want, expected = traced(cut, torch.float64, HERE)
    assert abs(len(got) - len(want)) <= 3  # a fragment at a threshold
    for key, value in expected.items():
        error = (gradients[key] - value).abs() / value.abs().max()
        assert (error < 1e-3).double().mean() >= 0.97, key


@pytest.mark.usefixtures("exactly")
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["single", "double"])
def test_deterministic_gradients(dtype: torch.dtype, device: torch.device, cpu) -> None:
    """Sums do not depend on the order of blocks and equal the CPU's."""
    cut = cut_scene(9)
    found = in_orders(device, lambda: traced(cut, dtype, device)[1]["alpha"], 3)
    assert all(torch.equal(other, found[0]) for other in found[1:])
    with cpu():
        want = traced(cut, dtype, HERE)[1]["alpha"]
    assert relative(found[0], want) < (1e-3 if dtype == torch.float32 else 1e-10)
