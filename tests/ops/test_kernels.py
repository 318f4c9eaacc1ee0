"""Compiled kernels against golden renders, float64 references and finite differences."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from bitymi_ns import ops
from bitymi_ns.measure.stability.scenes import SV_KEYS
from bitymi_ns.ops import backend
from bitymi_ns.ops.parameters import GEOMETRY
from bitymi_ns.ops.reference import field as reference_field
from bitymi_ns.ops.reference import render as reference_render
from bitymi_ns.ops.reference import view_color as reference_view_color
from bitymi_ns.ops.reference.view_color import view_directions
from bitymi_ns.scene import Camera, HashField, Scene, SceneConfig
from bitymi_ns.scene.baked import BakedScene
from tests.cuda.baked_scenes import front, textured
from tests.ops.golden import (
    GOLDEN_NAMES,
    SceneCase,
    atlas_of,
    camera_of,
    composite_colors,
    load_golden,
    random_scene,
    reference_ssim,
    relative,
    values_of,
)

EXACT_RIM = 1e-12  # the references bound nothing
OUTPUTS = {"rgb": "rgb", "alpha": "alpha", "depth": "depth", "beta_map": "beta"}


def scene_of(case: SceneCase, dtype: torch.dtype, rim: float = EXACT_RIM) -> tuple[Scene, Camera]:
    params = {key: value.to(dtype) for key, value in case.params.items()}
    scene = Scene(SceneConfig(texture="none", rim=rim, near=0.2), params, None)
    return scene, camera_of(case, dtype)


def images(output) -> dict[str, Tensor]:
    return {name: getattr(output, attribute).squeeze(-1) for name, attribute in OUTPUTS.items()}


def check_gradient(got: Tensor, want: Tensor, name: str) -> None:
    """Compare gradients: double everywhere, single to 1e-4 in 97 % of the numbers, as the kernel's derivative amplifies
    rounding by up to 1 / rim where a rim passes near a pixel centre."""
    if got.dtype == torch.float64:
        assert relative(got, want) < 1e-10, name
        return
    scale = want.abs().max().clamp(min=1e-30)
    error = (got.double() - want).abs() / scale
    assert (error < 1e-4).double().mean() >= 0.97, name
    assert error.max() < 1e-2, name


UNTEXTURED = [name for name in GOLDEN_NAMES if name != "textured"]


@pytest.mark.parametrize("name", UNTEXTURED)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["double", "single"])
def test_golden_images_and_gradients(name: str, dtype: torch.dtype) -> None:
    golden = load_golden(name)

    def run(dtype: torch.dtype, rim: float):
        scene, camera = scene_of(golden, dtype, rim)
        output = scene.render(camera, golden.background.to(dtype), maps=True)
        got = images(output)
        sum((got[key] * golden.loss_weights[key].to(dtype)).sum() for key in got).backward()
        return output, got, {key: parameter.grad for key, parameter in scene.surfels.items()}

    single = dtype == torch.float32
    output, got, grads = run(dtype, 1e-3 if single else EXACT_RIM)
    for key, image in got.items():
        want = golden.outputs[key]
        error = (image.detach().double() - want).abs() / want.abs().max()
        if dtype == torch.float64:
            assert error.max() < 1e-12, key
        else:  # the thresholds of alpha and transmittance may flip in single precision
            assert (error < 1e-4).double().mean() > 0.999, key
    assert torch.equal(output.overdraw[..., 0].double(), golden.outputs["overdraw"].double())
    # single precision is compared with double at the same rim bound
    wanted = run(torch.float64, 1e-3)[2] if single else golden.grads
    for key, want in wanted.items():
        check_gradient(grads[key], want, key)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["double", "single"])
def test_golden_textured_scene_through_the_baked_renderer(dtype: torch.dtype) -> None:
    golden = load_golden("textured")
    params = {key: value.to(dtype) for key, value in golden.params.items()}
    scene = BakedScene(params, "sv", *atlas_of(golden), weight_bound=0.0)
    output = scene.render(camera_of(golden, dtype), golden.background.to(dtype), maps=True)
    for key, image in images(output).items():
        # texels are always single precision
        assert relative(image, golden.outputs[key]) < (3e-8 if dtype == torch.float64 else 1e-4), key
    assert torch.equal(output.overdraw[..., 0].double(), golden.outputs["overdraw"].double())


def test_a_surfel_without_a_tile_has_its_mean_residual_where_a_tile_would_count() -> None:
    case = random_scene(80, 4, width=70, height=50)
    params = {key: value.float() for key, value in case.params.items()}
    camera = camera_of(case, torch.float32)
    residual = torch.rand(80, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    atlas = torch.zeros(1, 4, 4 * 80, 4)
    atlas[0, :, :, :3] = residual.repeat_interleave(4, dim=0)
    tiles = torch.tensor([(4 * i, 0, 0, 4, 4) for i in range(80)], dtype=torch.int32)
    tiled = BakedScene(params, "sv", tiles, atlas, weight_bound=0.05).render(camera).rgb
    assert not torch.allclose(tiled, BakedScene(params, "sv", tiles, None).render(camera).rgb, atol=0.05)
    none = torch.zeros_like(tiles)
    some = torch.where(torch.arange(80)[:, None] % 2 == 0, tiles, none)
    for few, texels in ((some, atlas), (none, None)):
        scene = BakedScene(params, "sv", few, texels, weight_bound=0.05, mean_residual=residual)
        torch.testing.assert_close(scene.render(camera).rgb, tiled, atol=1e-5, rtol=0)


def test_texels_of_bytes_are_those_of_floats() -> None:
    scene = textured(60, 0)
    whole = replace(scene, atlas=scene.atlas.float() / 255)
    torch.testing.assert_close(scene.render(front()).rgb, whole.render(front()).rgb, atol=1e-5, rtol=0)


@pytest.mark.parametrize("seed", range(3))
def test_random_scenes_in_single_precision(seed: int) -> None:
    case = random_scene(80, seed, width=70, height=50)
    scene, camera = scene_of(case, torch.float32)
    output = scene.render(camera, case.background.float(), maps=True)
    leaves = {key: value.clone().requires_grad_() for key, value in case.params.items()}
    directions = view_directions(leaves["means"], case.viewmat)
    colors = reference_view_color.sv(*(leaves[key] for key in SV_KEYS), directions)
    geometry = [leaves[key] for key in GEOMETRY]
    want = reference_render.render(geometry, colors, case, case.background)
    generator = torch.Generator().manual_seed(seed)
    loss, reference_loss = 0.0, 0.0
    for key, attribute in {**OUTPUTS, "normal": "normal"}.items():
        got, expected = getattr(output, attribute), getattr(want, key)
        expected = expected.reshape(got.shape)
        error = (got.detach().double() - expected.detach()).abs() / expected.detach().abs().max()
        assert (error < 1e-5).double().mean() > 0.999, key
        weight = torch.rand(got.shape, generator=generator, dtype=torch.float64)
        loss = loss + (got * weight.float()).sum()
        reference_loss = reference_loss + (expected * weight).sum()
    loss.backward()
    reference_loss.backward()
    for key, leaf in leaves.items():
        check_gradient(scene.surfels[key].grad, leaf.grad, key)


def test_depth_and_uv_gradients_of_the_trace_by_finite_differences() -> None:
    case = random_scene(6, 3, width=9, height=7, scale=0.5)
    camera, values = camera_of(case), values_of(case, grad=True)
    g = torch.Generator().manual_seed(0)
    count = len(ops.trace(ops.project(*values, camera)))
    weights = [torch.rand(k, count, generator=g, dtype=torch.float64) for k in (1, 2, 1)]

    def function(*parameters: Tensor) -> Tensor:
        fragments = ops.trace(ops.project(*parameters, camera), rim=EXACT_RIM)
        parts = (fragments.weight[None], fragments.uv, fragments.depth[None])
        return sum((part * weight).sum() for part, weight in zip(parts, weights, strict=True))

    assert torch.autograd.gradcheck(function, values, eps=1e-7, atol=1e-5, rtol=1e-4)


def make_field(contract: bool, dtype: torch.dtype, seed: int = 0, log2: int = 8) -> HashField:
    g = torch.Generator().manual_seed(seed)
    field = HashField(SceneConfig(min_resolution=8), (0.1, -0.2, 0.3), 1.5, contract, log2, g)
    with torch.no_grad():
        for parameter in field.parameters():
            parameter.copy_(torch.randn(parameter.shape, generator=g) * 0.5)
    return field.to(dtype)


def field_reference(field: HashField, x: Tensor) -> Tensor:
    geometry = field.geometry
    weights = [w.detach().double() for w in field.weights]
    mid = torch.tensor(geometry.mid, dtype=torch.float64)
    return reference_field.field(
        x.double(), *weights, mid, geometry.half, geometry.min_resolution, contraction=geometry.contract
    )


@pytest.mark.parametrize("contract", [True, False])
@pytest.mark.parametrize("count", [1, 15, 16, 17, 5000])
def test_field_against_the_reference(contract: bool, count: int) -> None:
    g = torch.Generator().manual_seed(count)
    x = torch.randn(count, 3, generator=g, dtype=torch.float64) * 4
    torch.testing.assert_close(
        make_field(contract, torch.float64)(x),
        field_reference(make_field(contract, torch.float64), x),
        rtol=1e-10,
        atol=1e-11,
    )
    single = make_field(contract, torch.float32)
    # a position near a cell's face may round into the neighbouring cell, where the value is the same
    torch.testing.assert_close(single(x.float()).double(), field_reference(single, x.float()), rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("contract", [True, False])
def test_field_gradients_by_finite_differences(contract: bool) -> None:
    field = make_field(contract, torch.float64, log2=5)
    x = (torch.randn(9, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64) * 2).requires_grad_()
    weights = [w.detach().clone().requires_grad_() for w in field.weights]

    def function(points: Tensor, *values: Tensor) -> Tensor:
        return ops.field(points, field.geometry, *values)

    assert torch.autograd.gradcheck(function, (x, *weights), eps=1e-7, atol=1e-5, rtol=1e-3)


@pytest.mark.parametrize("move", [False, True])
def test_shading_equals_the_field_module_fragment_by_fragment(move: bool) -> None:
    case = random_scene(25, 11, width=20, height=18, scale=0.4)
    camera = camera_of(case)
    field = make_field(True, torch.float64, log2=6)

    def render(fused: bool) -> list[Tensor]:
        leaves = values_of(case, grad=True)
        base = (torch.linspace(-0.8, 0.8, 75, dtype=torch.float64).view(25, 3)).requires_grad_()
        field.zero_grad()
        projection = ops.project(*leaves, camera)
        fragments = ops.trace(projection)
        if fused:
            rho = ops.fragment_residual(fragments, projection.frames, field.geometry, field.weights, 0.05, move)
            image = ops.blended_image(fragments, projection, base, maps=True, residual=rho)
        else:
            rows = fragments.surfel.long()
            frames, uv = projection.frames[rows], fragments.uv
            x = frames[:, :3] + uv[0][:, None] * frames[:, 3:6] + uv[1][:, None] * frames[:, 6:9]
            rho = field(x if move else x.detach()) * (fragments.weight.detach()[:, None] >= 0.05)
            colors = ((base[rows] + 0.5).clamp(min=0) + rho).clamp(min=0)
            image = composite_colors(fragments, projection, colors, maps=True)
        (image * torch.linspace(-1, 1, image.numel(), dtype=torch.float64).view_as(image)).sum().backward()
        return [image.detach(), base.grad, *(leaf.grad for leaf in leaves), *(w.grad.clone() for w in field.weights)]

    for fused, plain in zip(render(True), render(False), strict=True):
        torch.testing.assert_close(fused, plain, rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("threads", [1, 3])
def test_masked_counts_count_blended_fragments_on_masked_pixels(threads: int) -> None:
    case = random_scene(30, 4)
    scene, camera = scene_of(case, torch.float32)
    fragments = scene.render(camera).fragments
    mask = torch.rand(case.width * case.height, generator=torch.Generator().manual_seed(0)) > 0.5
    backend.module(torch.device("cpu")).set_num_threads(threads)
    counts = fragments.masked_counts(mask)
    backend.module(torch.device("cpu")).set_num_threads(0)
    on_mask = fragments.surfel[mask[fragments.pixel.long()]].long()
    assert torch.equal(counts.long(), torch.bincount(on_mask, minlength=30))


@pytest.mark.parametrize("size", [(11, 11, 3), (20, 31, 3), (40, 17, 1), (10, 30, 3)])
def test_ssim_and_its_gradient(size: tuple[int, int, int]) -> None:
    g = torch.Generator().manual_seed(1)
    a, b = (torch.rand(size, generator=g, dtype=torch.float64) for _ in range(2))
    if size[0] < 11:
        assert ops.ssim(a, b) == 1.0
        return
    p, q = a.clone().requires_grad_(), a.clone().requires_grad_()
    got, want = ops.ssim(p, b), reference_ssim(q, b)
    got.backward()
    want.backward()
    torch.testing.assert_close(got, want, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(p.grad, q.grad, rtol=1e-9, atol=1e-14)
    assert abs(float(ops.ssim(a.float(), b.float())) - float(want)) < 1e-5


def test_absolute_gradient_bounds_the_gradient_and_adds_over_fragments() -> None:
    case = random_scene(30, 8)
    scene, camera = scene_of(case, torch.float64)
    output = scene.render(camera)
    output.rgb.square().sum().backward()
    projection = output.projection
    assert (projection.mean2d_absgrad >= projection.mean2d_grad.abs() - 1e-12).all()
    assert (projection.mean2d_absgrad > projection.mean2d_grad.abs() + 1e-9).any()


def test_results_do_not_depend_on_the_number_of_threads_beyond_rounding() -> None:
    case = random_scene(300, 9, width=150, height=90)
    results = []
    for threads in (1, 2, 3):
        backend.module(torch.device("cpu")).set_num_threads(threads)
        scene, camera = scene_of(case, torch.float32)
        output = scene.render(camera)
        output.rgb.square().sum().backward()
        results.append((output.rgb.detach(), scene.surfels["means"].grad))
    backend.module(torch.device("cpu")).set_num_threads(0)
    for rgb, grad in results[1:]:
        assert torch.equal(rgb, results[0][0])
        torch.testing.assert_close(grad, results[0][1], rtol=1e-4, atol=1e-4)


def test_wrong_inputs_are_refused() -> None:
    case = random_scene(4, 0)
    scene, camera = scene_of(case, torch.float32)
    p = {key: scene.surfels[key].detach() for key in GEOMETRY}
    with pytest.raises(ValueError, match="quats must have shape"):
        ops.project(**{**p, "quats": p["quats"][:, :3]}, camera=camera)
    with pytest.raises(TypeError, match="float32 or float64"):
        ops.project(**{key: value.half() for key, value in p.items()}, camera=camera)
    skewed = Camera(camera.viewmat, camera.K + torch.tensor([[0, 1.0, 0], [0, 0, 0], [0, 0, 0]]), 4, 4)
    with pytest.raises(ValueError, match="skew"):
        ops.project(**p, camera=skewed)
    with pytest.raises(ValueError, match="unknown view colour"):
        ops.view_color("fancy", scene.surfels, p["means"], torch.zeros(3))
    with pytest.raises(ValueError, match="one size"):
        ops.ssim(torch.rand(20, 20, 3), torch.rand(20, 21, 3))
    with pytest.raises(ValueError, match="pixels"):
        scene.render(camera).fragments.masked_counts(torch.ones(3, dtype=torch.bool))
