"""Surfels in views of another size than the photographs: against the reference and pixel averages."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from bitymi_ns import ops
from bitymi_ns.measure.stability.scenes import SceneCase, random_scene
from bitymi_ns.ops import baked_cpu
from bitymi_ns.ops.baked_scene import halved, tile_levels
from bitymi_ns.ops.constants import SUPPORT
from bitymi_ns.ops.parameters import GEOMETRY
from bitymi_ns.ops.reference import project as reference_project
from bitymi_ns.ops.reference import trace as reference_trace
from bitymi_ns.scene.baked import BakedScene
from tests.cuda.baked_scenes import scene_of
from tests.ops.golden import camera_of


def drawn(case: SceneCase, photo_pixel: float) -> torch.Tensor:
    """Render [H, W, 4] rgb and alpha of a case, float32."""
    return baked_cpu.frame(scene_of(case), camera_of(case, torch.float32), False, photo_pixel)[0]


@pytest.mark.parametrize("scale", [2.0, 0.25, 0.03, 0.002])
@pytest.mark.parametrize("photo_pixel", [0.2, 0.5, 0.9, 1.0, 3.0])
def test_coverage_depth_and_normals_agree_with_the_reference(scale: float, photo_pixel: float) -> None:
    case = random_scene(40, 3, scale=scale)
    image, overdraw = baked_cpu.frame(scene_of(case), camera_of(case, torch.float32), True, photo_pixel)
    values = [case.params[name].double() for name in GEOMETRY]
    projected = reference_project.project(*values, case.viewmat, case.K)
    want = reference_trace.trace(projected, case.width, case.height, photo_pixel=photo_pixel)
    shape = (case.height, case.width)
    pairs = {
        3: want.weight.sum(1),
        4: want.weight @ projected.beta,
        5: torch.where(want.blended, want.weight * want.depth, 0.0).sum(1),
    }
    same = overdraw[..., 0] == want.blended.sum(1).reshape(shape)  # fragments near 1/255 may differ
    assert same.double().mean() > 0.998
    for channel, expected in pairs.items():
        error = (image[..., channel].double() - expected.reshape(shape)).abs()[same]
        assert error.max() < 3e-4 * max(1.0, float(expected.abs().max())), channel
    assert overdraw.sum() > 0


@pytest.mark.parametrize("size", [3.0, 0.4, 0.05])
@pytest.mark.parametrize("beta", [0.3, 2.0, 3.8])
def test_a_disc_keeps_what_it_covers_when_it_is_drawn_smaller(size: float, beta: float) -> None:
    """Averaged over positions in a pixel, the coverage of a disc at a quarter of the size equals the photograph's."""

    def covered(scale: float, photo_pixel: float) -> float:
        width, total = 48, 0.0
        for k in range(16):
            at = (24 + (k % 4) / 4, 24 + (k // 4) / 4)
            K = torch.tensor([[100 * scale, 0, at[0]], [0, 100 * scale, at[1]], [0, 0, 1.0]], dtype=torch.float64)
            raw = math.log(beta / (4 - beta))
            s = math.log(size / 10)
            values = [
                torch.tensor(v, dtype=torch.float64)
                for v in ([[0, 0, 10.0]], [[0.9, 0.3, 0, 0]], [[s, s]], [8.0], [raw])
            ]
            projected = reference_project.project(*values, torch.eye(4, dtype=torch.float64), K)
            total += float(reference_trace.trace(projected, width, width, photo_pixel=photo_pixel).weight.sum())
        return total / 16

    assert covered(0.25, 0.25) * 16 == pytest.approx(covered(1.0, 1.0), rel=0.12)


def test_a_magnified_surfel_is_as_wide_as_in_the_photograph() -> None:
    case = random_scene(1, 0, 64, 64)
    case.viewmat = torch.eye(4, dtype=torch.float64)
    case.params["means"] = torch.tensor([[0.0, 0.0, 10.0]])
    case.params["log_scales"] = torch.full((1, 2), -12.0)
    case.params["opacity_logits"] = torch.tensor([2.0])
    case.K = torch.tensor([[100.0, 0, 32], [0, 100.0, 32], [0, 0, 1]], dtype=torch.float64)
    once, large = drawn(case, 1.0)[..., 3].sum(), drawn(case, 4.0)[..., 3].sum()
    assert 14 < float(large / once) < 18


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 1 << 30), st.floats(-14, 6), st.floats(0.02, 20), st.floats(0.0, math.pi / 2))
def test_any_surfel_stays_finite(seed: int, log_scale: float, photo_pixel: float, tilt: float) -> None:
    case = random_scene(20, seed, 24, 24, scale=math.exp(log_scale))
    case.params["quats"][:4] = torch.tensor([math.cos(tilt / 2), math.sin(tilt / 2), 0.0, 0.0])
    image = drawn(case, photo_pixel)
    assert bool(image.isfinite().all()) and float(image[..., 3].max()) <= 1.0


def test_resized_surfels_are_neither_traced_nor_learned() -> None:
    case = random_scene(5, 0)
    values = [case.params[name].float() for name in GEOMETRY]
    with pytest.raises(ValueError, match="baked renderer alone"):
        ops.trace(ops.project(*values, camera_of(case, torch.float32), photo_pixel=0.5))
    values[0].requires_grad_()
    with pytest.raises(ValueError, match="without gradients"):
        ops.project(*values, camera_of(case, torch.float32), photo_pixel=0.5)


def checkerboard(side: int, tiles: list[list[int]] | None = None) -> tuple[BakedScene, SceneCase]:
    """Make a square that fills the view, with a tile of black and white texels."""
    case = random_scene(1, 0, 16, 16)
    case.viewmat = torch.eye(4, dtype=torch.float64)
    params = {
        **{name: value.float() for name, value in case.params.items()},
        "means": torch.tensor([[0.0, 0.0, 1.0]]),
        "quats": torch.tensor([[1.0, 0, 0, 0]]),
        "log_scales": torch.zeros(1, 2),
        "opacity_logits": torch.tensor([20.0]),
        "beta_raw": torch.tensor([-20.0]),
    }
    case.K = torch.tensor([[16 / 6.0, 0, 8], [0, 16 / 6.0, 8], [0, 0, 1]], dtype=torch.float64)  # a texel is 16/side px
    x, y = torch.meshgrid(torch.arange(side), torch.arange(side), indexing="ij")
    atlas = (255 * ((x + y) % 2))[None, ..., None].expand(1, side, side, 4).to(torch.uint8).contiguous()
    place = torch.tensor(tiles or [[0, 0, 0, side, side]], dtype=torch.int32)
    scene = BakedScene(params, "sv", place, atlas, offset=0.0, scale=1.0, mean_residual=torch.full((1, 3), 0.5))
    return scene, case


@pytest.mark.parametrize("side", [32, 64])
def test_texels_smaller_than_pixels_are_averaged(side: int) -> None:
    scene, case = checkerboard(side)
    camera = camera_of(case, torch.float32)
    inner = (slice(5, 11), slice(5, 11), slice(0, 3))
    base = baked_cpu.frame(checkerboard(side, [[0, 0, 0, 0, 0]])[0], camera, False)[0][inner]
    want = base[0, 0] + 0.0
    photo_pixel = 16 / side
    image = baked_cpu.frame(scene, camera, False, photo_pixel)[0][inner]
    assert float((image - image.mean((0, 1))).abs().max()) < 0.01
    torch.testing.assert_close(image.mean((0, 1)), want.expand(3), rtol=0.02, atol=0.02)


def test_levels_are_means_of_texels() -> None:
    g = torch.Generator().manual_seed(0)
    atlas = torch.rand(2, 8, 12, 4, generator=g)
    torch.testing.assert_close(halved(atlas)[1, 2, 3], atlas[1, 4:6, 6:8].mean((0, 1)))
    whole = (atlas * 255).to(torch.uint8)
    exact = halved(whole.float())
    assert (halved(whole).float() - exact).abs().max() <= 0.5
    tiles = torch.tensor([[4, 4, 1, 8, 4], [0, 0, 0, 0, 0], [2, 0, 0, 4, 4], [1, 0, 0, 4, 4]], dtype=torch.int32)
    levels = list(tile_levels(whole, tiles))
    assert [name for name, _, _ in levels] == ["half", "quarter"]
    assert levels[0][2].tolist() == [[2, 2, 1, 4, 2], [0] * 5, [1, 0, 0, 2, 2], [0] * 5]
    assert levels[1][2].tolist() == [[1, 1, 1, 2, 1], [0] * 5, [0] * 5, [0] * 5]
    assert list(tile_levels(whole[:, :1], tiles)) == []
    assert SUPPORT == 3
