"""Colours of fragments from texels, and the step of the texels, by the CUDA kernels: against the CPU's and float64."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import fields, replace

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from torch import Tensor

from bitymi_ns import ops
from bitymi_ns.ops.backend import emulated_cuda
from tests.ops.golden import changed, extreme_scenes
from tests.ops.test_kernels import relative
from tests.ops.test_texel import SIZES, Case, colors_by_reference, fragments_of, one_surfel

Context = Callable[[], AbstractContextManager[None]]
DTYPES = pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["double", "single"])


@pytest.fixture
def exactly():
    """Torch asked for deterministic algorithms."""
    torch.use_deterministic_algorithms(True)
    yield
    torch.use_deterministic_algorithms(False)


def moved(of: ops.Fragments | ops.TexelTiles, device: torch.device):
    """Fragments or tiles with their tensors on a device."""
    tensors = {f.name: getattr(of, f.name) for f in fields(of)}
    found = {name: t.to(device) for name, t in tensors.items() if isinstance(t, Tensor)}
    if isinstance(of, ops.Fragments):
        found["places"] = changed(of.places, lambda t: t.to(device))
    return replace(of, **found)


def direction(like: Tensor) -> Tensor:
    """Of the gradient that colours are given."""
    return torch.cos(torch.arange(like.numel(), device=like.device).double()).view_as(like).to(like)


def run(case: Case, device: torch.device, bound: float = 0.05, towards: Tensor | None = None) -> list[Tensor]:
    """Colours and the gradients of base colours, texels and uv; on the CPU, in double."""
    fragments, tiles = moved(case.fragments, device), moved(case.tiles, device)
    leaves = [t.to(device).clone().requires_grad_() for t in (case.base, case.texels, case.fragments.uv)]
    colors = ops.texel_colors(replace(fragments, uv=leaves[2]), *leaves[:2], tiles, bound)
    colors.backward(direction(colors) if towards is None else towards.to(colors))
    return [t.detach().cpu().double() for t in (colors, *(leaf.grad for leaf in leaves))]


def case_of(cpu: Context, *arguments, **options) -> Case:
    with cpu():
        return Case(*arguments, **options)


@DTYPES
@pytest.mark.parametrize("bound", [0.0, 0.05, 2.0])
def test_colors_and_gradients_against_the_cpu_and_the_reference(
    bound: float, dtype: torch.dtype, device: torch.device, cpu: Context
) -> None:
    case = case_of(cpu, dtype=dtype)
    got = run(case, device, bound)
    with cpu():
        want = run(case, torch.device("cpu"), bound)
    leaves = [t.double().clone().requires_grad_() for t in (case.base, case.texels, case.fragments.uv)]
    expected = colors_by_reference(case, *leaves, bound)
    expected.backward(direction(expected))
    tolerance = 1e-12 if dtype == torch.float64 else 2e-5
    for mine, cpus, exact in zip(got, want, (expected.detach(), *(leaf.grad for leaf in leaves)), strict=True):
        assert relative(mine, cpus) < tolerance
        assert relative(mine, exact) < 10 * tolerance
    assert all(bool(grad.any()) == (bound < 1) for grad in got[2:]) and got[1].any()


@pytest.mark.parametrize("count", [1, 31, 32, 33, 257])
def test_any_number_of_fragments(count: int, device: torch.device, cpu: Context) -> None:
    """Also the last block of them, whose warps are not full."""
    case = case_of(cpu)
    f = case.fragments
    assert len(f) > count
    few = {name: getattr(f, name)[:count] for name in ("weight", "depth", "sigma")}
    places = changed(f.places, lambda t: t[:count])
    case.fragments = replace(f, **few, uv=f.uv[:, :count].contiguous(), places=places)
    got = run(case, device)
    with cpu():
        want = run(case, torch.device("cpu"))
    assert all(relative(a, b) < 1e-12 for a, b in zip(got, want, strict=True))


@pytest.mark.parametrize("scene", extreme_scenes(), ids=lambda case: case.name)
def test_extreme_scenes(scene, device: torch.device, cpu: Context) -> None:
    case = case_of(cpu)
    n = len(scene.params["means"])
    with cpu():
        case.fragments = fragments_of(scene, torch.float32)
    size = torch.tensor(SIZES, dtype=torch.int32).repeat(n // len(SIZES) + 1, 1)[:n]
    case.tiles = ops.TexelTiles.of_sizes(size, torch.linspace(1e-3, 3.0, n))
    g = torch.Generator().manual_seed(n)
    case.base, case.texels = torch.randn(n, 3, generator=g), torch.randn(case.tiles.count, 3, generator=g)
    got = run(case, device)
    with cpu():
        want = run(case, torch.device("cpu"))
    for a, b in zip(got, want, strict=True):
        assert b.isfinite().all() and relative(a, b) < 2e-5


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.sampled_from([(1, 1), (4, 1), (1, 4), (2, 2), (4, 8), (64, 4)]),
    st.sampled_from([1e-6, 1e-3, 0.5, 3.0, 16.0]),
    st.sampled_from([1e-30, 1.0, 1e30]),
    st.integers(0, 2**31),
)
def test_one_surfel_of_any_tile(
    device: torch.device, cpu: Context, size: tuple[int, int], extent: float, huge: float, seed: int
) -> None:
    """Seventy fragments of one tile, in cells together and apart, at texel centres, between and beyond them."""
    g = torch.Generator().manual_seed(seed)
    sides = torch.tensor(size, dtype=torch.float64)[:, None]
    cell = torch.stack([torch.randint(-2, side + 2, (70,), generator=g) for side in size])
    between = torch.rand(2, 70, generator=g, dtype=torch.float64) * (torch.rand(70, generator=g) < 0.8)
    case = Case.__new__(Case)
    weight = torch.where(torch.arange(70) % 4 == 0, 0.01, 0.02).double()
    case.fragments = one_surfel((cell + between + 0.5) / sides * 2 * extent - extent, weight)
    case.tiles = ops.TexelTiles.of_sizes(torch.tensor([size]), torch.tensor([extent], dtype=torch.float64))
    case.base = torch.randn(1, 3, generator=g, dtype=torch.float64)
    case.texels = torch.randn(case.tiles.count, 3, generator=g, dtype=torch.float64)
    towards = huge * torch.randn(70, 3, generator=g, dtype=torch.float64)
    got = run(case, device, 0.02, towards)
    with cpu():
        want = run(case, torch.device("cpu"), 0.02, towards)
    assert all(relative(a, b) < 1e-12 for a, b in zip(got, want, strict=True))


def test_without_fragments_and_without_texels(device: torch.device, cpu: Context) -> None:
    case = case_of(cpu)
    f = case.fragments
    none = {name: getattr(f, name)[:0] for name in ("weight", "depth", "sigma")}
    places = changed(f.places, lambda t: t[:0])
    shown, case.fragments = f, replace(f, **none, uv=f.uv[:, :0].contiguous(), places=places)
    colors, *grads = run(case, device)
    assert colors.shape == (0, 3) and not any(grad.any() for grad in grads)
    case.fragments, size = shown, torch.zeros_like(case.tiles.size)
    case.tiles, case.texels = ops.TexelTiles.of_sizes(size, case.tiles.extent), case.texels[:0]
    colors, dbase, dtexels, duv = run(case, device)
    torch.testing.assert_close(colors, (case.base + 0.5).relu()[shown.surfel.long()])
    assert dbase.any() and dtexels.shape == (0, 3) and not duv.any()


def step(case: Case, device: torch.device, texels: Tensor, share: Tensor, rate: float) -> list[Tensor]:
    """Gradients of base colours and uv, and the texels after a step; on the CPU."""
    fragments, tiles, texels = moved(case.fragments, device), moved(case.tiles, device), texels.to(device).clone()
    base, uv = (t.to(device).clone().requires_grad_() for t in (case.base, case.fragments.uv))
    descent = ops.TexelDescent(share.to(device), rate)
    colors = ops.texel_colors(replace(fragments, uv=uv), base, texels, tiles, 0.02, descent=descent)
    colors.backward(direction(colors))
    return [t.detach().cpu() for t in (base.grad, uv.grad, texels)]


@DTYPES
def test_a_descent_moves_the_texels_by_their_gradient(dtype: torch.dtype, device: torch.device, cpu: Context) -> None:
    case = case_of(cpu, dtype=dtype)
    share = torch.linspace(0.1, 2.0, len(case.texels), dtype=dtype)
    _, dbase, dtexels, duv = run(case, device, 0.02)
    got = step(case, device, case.texels, share, 0.3)
    with cpu():
        want = step(case, torch.device("cpu"), case.texels, share, 0.3)
    tolerance = 1e-12 if dtype == torch.float64 else 2e-5
    for a, b in zip(got, want, strict=True):
        assert relative(a, b) < tolerance
    assert relative(got[0].double(), dbase) < tolerance and relative(got[1].double(), duv) < tolerance
    expected = case.texels.double() - 0.3 * share.double()[:, None] * dtexels
    assert relative(got[2].double(), expected) < tolerance and (dtexels.abs() > 0.1).any()
    still = ~dtexels.any(1)
    assert still.any() and torch.equal(got[2][still], case.texels[still])


def test_what_was_learned_of_one_list_is_there_for_the_next(device: torch.device, cpu: Context) -> None:
    """Many steps towards given colours end at texels that give them."""
    case = case_of(cpu)
    f, tiles = moved(case.fragments, device), moved(case.tiles, device)
    base, texels = torch.zeros_like(case.base).to(device).requires_grad_(), torch.zeros_like(case.texels).to(device)
    covered = torch.zeros_like(texels)
    ops.add_texel_coverage([f], tiles, None, 0.02, covered)
    share = 1 / (covered[:, 0] + 0.1)
    with torch.no_grad():
        wanted = ops.texel_colors(f, base, 0.3 * case.texels.to(device), tiles, 0.02)
    errors = []
    for _ in range(40):
        colors = ops.texel_colors(f, base, texels, tiles, 0.02, descent=ops.TexelDescent(share, 1.0))
        colors.backward(f.weight[:, None] * (colors.detach() - wanted))
        errors.append(float((f.weight[:, None] * (colors.detach() - wanted).square()).sum()))
    assert errors[-1] < 0.05 * errors[0] and errors == sorted(errors, reverse=True)


@pytest.mark.parametrize("masked", [False, True])
def test_coverage_against_the_cpu(masked: bool, device: torch.device, cpu: Context) -> None:
    case = case_of(cpu)
    f = case.fragments
    mask = (torch.arange(f.height * f.width) % 3 > 0).view(f.height, f.width, 1) if masked else None
    total = torch.ones(len(case.texels), 3, dtype=torch.float64)  # of views before
    with cpu():
        want, weighed = total.clone(), ops.TexelFragments.of(f, f.weight >= 0.05)
        counts = torch.ones(f.height * f.width, 3, dtype=torch.float64) * (1.0 if mask is None else mask.view(-1, 1))
        grey = torch.zeros_like(case.base, dtype=torch.float64)
        ops.add_texel_gradient(counts, weighed, grey, torch.zeros_like(want), case.tiles, 0.0, want)
        again = total.clone()
        ops.add_texel_coverage([f], case.tiles, mask, 0.05, again)
    got = total.to(device)
    here = None if mask is None else mask.to(device)
    ops.add_texel_coverage([moved(f, device)], moved(case.tiles, device), here, 0.05, got)
    assert relative(got.cpu(), want) < 1e-12 and relative(again, want) < 1e-12 and want.max() > 2


def test_deterministic_sums_do_not_depend_on_the_order_of_threads(device: torch.device, cpu: Context, exactly) -> None:
    case = case_of(cpu, dtype=torch.float32)
    share, runs = torch.linspace(0.1, 2.0, len(case.texels)), []
    for seed in range(4):
        if device.type == "cpu":
            with emulated_cuda(seed):
                runs.append([*run(case, device), *step(case, device, case.texels, share, 0.3)])
        else:
            runs.append([*run(case, device), *step(case, device, case.texels, share, 0.3)])
    assert all(torch.equal(a, b) for other in runs[1:] for a, b in zip(runs[0], other, strict=True))
    with cpu():
        cpus = torch.device("cpu")
        want = [*run(case, cpus), *step(case, cpus, case.texels, share, 0.3)]
    assert all(relative(a, b) < 2e-5 for a, b in zip(runs[0], want, strict=True))


def test_a_gradient_that_is_not_finite_is_not_hidden(device: torch.device, cpu: Context) -> None:
    case = case_of(cpu, dtype=torch.float32)
    towards = torch.ones(len(case.fragments), 3)
    towards[len(towards) // 2] = float("nan")
    case.base.fill_(0.3)
    case.texels.fill_(0.1)
    for exact in (False, True):
        torch.use_deterministic_algorithms(exact)
        try:
            _, dbase, dtexels, _ = run(case, device, 0.0, towards)
        finally:
            torch.use_deterministic_algorithms(False)
        assert dbase.isnan().any() and dtexels.isnan().any()


def test_gradients_by_finite_differences(device: torch.device, cpu: Context) -> None:
    case = case_of(cpu, 12, width=12, height=9, scale=0.4)
    f, tiles = moved(case.fragments, device), moved(case.tiles, device)
    leaves = [t.to(device).requires_grad_() for t in (case.base, case.texels)]
    nondet = 1e-10 if device.type == "cuda" else 0.0  # the order of sums
    assert torch.autograd.gradcheck(lambda b, t: ops.texel_colors(f, b, t, tiles, 0.01), leaves, nondet_tol=nondet)


def test_what_does_not_fit_is_refused(device: torch.device, cpu: Context) -> None:
    case = case_of(cpu)
    f, tiles = moved(case.fragments, device), moved(case.tiles, device)
    base, texels = case.base.to(device), case.texels.to(device)
    with pytest.raises(ValueError, match="the tiles hold"):
        ops.texel_colors(f, base, texels[1:], tiles)
    with pytest.raises(ValueError, match="ask for no gradient"):
        learns = texels.clone().requires_grad_()
        ops.texel_colors(f, base, learns, tiles, descent=ops.TexelDescent(texels[:, 0], 0.1))
    if device.type == "cuda":
        with pytest.raises(ValueError, match="share is on device 'cpu'"):
            ops.texel_colors(f, base, texels, tiles, descent=ops.TexelDescent(torch.ones(len(texels)), 0.1))
