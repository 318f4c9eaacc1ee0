"""The pixel prefilter: against the reference, its moments, continuity, no holes."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from bitymi_ns import ops
from bitymi_ns.bundle import read_bundle
from bitymi_ns.measure.stability.scenes import SceneCase, random_scene
from bitymi_ns.ops.project import GEOMETRY
from bitymi_ns.ops.reference import project as reference_project
from bitymi_ns.ops.reference import trace as reference_trace
from bitymi_ns.scene import Scene, SceneConfig
from tests.bake.scenes import write
from tests.ops.golden import camera_of, dense, reference, traced


def test_the_launch_chooses_the_kernel_and_not_the_row() -> None:
    case = random_scene(40, 3, scale=0.25)
    values = [case.params[name].double() for name in GEOMETRY]
    wanted, plain = traced(case, values)
    _, filtered = traced(case, values, prefilter="pixel")
    assert (filtered.geom[:, 15] > 0).any() and not (plain.geom[:, 15] > 0).any()
    got = ops.trace(replace(plain, geom=filtered.geom), 0.0)
    assert torch.equal(got.weight, wanted.weight) and torch.equal(got.sigma, wanted.sigma)


@pytest.mark.parametrize("scale", [2.0, 0.25, 0.03, 0.002])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["double", "single"])
def test_fragments_and_gradients_agree_with_the_reference(scale: float, dtype: torch.dtype) -> None:
    case = random_scene(40, 3, scale=scale)
    values = [case.params[name].to(dtype).requires_grad_() for name in GEOMETRY]
    fragments, _ = traced(case, values, prefilter="pixel")
    exact = [value.detach().double().requires_grad_() for value in values]
    want = reference(case, exact, prefilter="pixel")
    generator = torch.Generator().manual_seed(1)
    loss, wanted = 0.0, 0.0
    kept = want.blended & (dense(fragments, torch.ones(len(fragments)), 40) > 0)
    assert (kept != want.blended).double().mean() < 1e-4 and kept.any()
    pairs = [
        (dense(fragments, fragments.weight, 40), want.weight),
        *((dense(fragments, fragments.uv[i], 40), want.uv[..., i]) for i in (0, 1)),
        (dense(fragments, fragments.depth, 40), want.depth),
    ]
    for got, expected in pairs:
        got, expected = torch.where(kept, got, 0.0), torch.where(kept, expected, 0.0)
        tolerance = 1e-11 if dtype == torch.float64 else 2e-4
        assert (got.double() - expected).abs().max() < tolerance * expected.abs().max()
        weight = torch.rand(got.shape, generator=generator, dtype=torch.float64)
        loss = loss + (got * weight.to(got)).sum()
        wanted = wanted + (expected * weight).sum()
    loss.backward()
    wanted.backward()
    for name, value, reference_value in zip(GEOMETRY, values, exact, strict=True):
        scale_of = reference_value.grad.abs().max()
        error = (value.grad.double() - reference_value.grad).abs().max() / scale_of
        assert error < (1e-9 if dtype == torch.float64 else 5e-3), (name, error)


def disc(
    scale: tuple[float, float], tilt: float, beta: float, at: tuple[float, float]
) -> tuple[SceneCase, list[Tensor]]:
    """Make one disc at depth 10 in a 32 x 32 view of focal length 100, centred at a pixel position."""
    case = random_scene(1, 0, 32, 32)
    case.viewmat = torch.eye(4, dtype=torch.float64)
    case.K = torch.tensor([[100.0, 0, 16], [0, 100.0, 16], [0, 0, 1]], dtype=torch.float64)
    mean = torch.tensor([[(at[0] - 16) / 10, (at[1] - 16) / 10, 10.0]], dtype=torch.float64)
    quat = torch.tensor([[math.cos(tilt / 2), math.sin(tilt / 2), 0.0, 0.0]], dtype=torch.float64)
    logs = torch.tensor([[math.log(s) for s in scale]], dtype=torch.float64)
    raw = math.log(beta) - math.log(4 - beta)
    return case, [mean, quat, logs, *(torch.tensor([x], dtype=torch.float64) for x in (20.0, raw))]


@pytest.mark.parametrize("beta", [0.2, 1.0, 3.5])
@pytest.mark.parametrize("size", [0.3, 0.1, 0.02])
def test_small_discs_cover_their_area_wherever_they_lie(size: float, beta: float) -> None:
    """Averaged over positions in a pixel, the kernel's sum is the projected area 9 pi s_u s_v f^2 / z^2 / (beta + 1),
    centred on the disc; it is lost at none of them."""
    area = math.pi * 9 * size**2 / (beta + 1)
    pixels = reference_trace.pixel_centers(32, 32)
    sums, centers = [], []
    for k in range(36):
        at = (15 + (k % 6) / 6, 15 + (k // 6) / 6)
        case, values = disc((size / 10, size / 10), 0.0, beta, at)
        projected = reference_project.project(*values, case.viewmat, case.K)
        kernel, _, _ = reference_trace._filtered(projected, pixels, 0.2)  # without the threshold 1/255
        sums.append(float(kernel.sum()))
        centers.append((kernel * pixels).sum(0) / kernel.sum() - torch.tensor(at))
    assert sum(sums) / len(sums) == pytest.approx(area, rel=0.02)
    assert min(sums) > 0.6 * area and max(sums) < 1.25 * area
    assert torch.stack(centers).mean(0).abs().max() < 0.02


def test_discs_that_turn_edge_on_fade_with_the_cosine() -> None:
    """The low pass leaves a blob of about three pixels at any angle."""
    angles = (60.0, 85.0, 89.0, 89.5, 89.9, 89.99)
    covered, blob = [], []
    for degrees in angles:
        case, values = disc((0.5, 0.5), math.radians(degrees), 2.0, (16.0, 16.0))
        covered.append(float(traced(case, values, prefilter="pixel")[0].weight.sum()) / math.cos(math.radians(degrees)))
        blob.append(float(ops.trace(ops.project(*values, camera_of(case))).weight.sum()))
    assert covered[0] == pytest.approx(9 * math.pi * 25 / 3, rel=0.03)
    assert max(covered[:4]) < 1.1 * covered[0] and min(covered[:4]) > 0.8 * covered[0]
    assert covered[4] * math.cos(math.radians(89.9)) < 0.6 and covered[5] == 0  # below 1/255
    assert blob[-1] > 2.5


def test_a_baked_scene_is_drawn_as_the_trained_one(tmp_path: Path) -> None:
    case = random_scene(30, 6, scale=0.05)
    params = {key: value.float() for key, value in case.params.items()}
    scene = Scene(SceneConfig(texture="none", prefilter="pixel", near=0.2), params, None)
    tiles = torch.zeros(30, 5, dtype=torch.int32)
    write(tmp_path / "bundle", params, tiles.numpy(), None, prefilter="pixel")
    baked = read_bundle(tmp_path / "bundle").scene
    assert baked.prefilter == "pixel"
    camera = camera_of(case, torch.float32)
    a, b = scene.render(camera).rgb.detach(), baked.render(camera).rgb
    torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-5)
    baked.prefilter = "low_pass"
    assert (baked.render(camera).rgb - a).abs().max() > 1e-2
