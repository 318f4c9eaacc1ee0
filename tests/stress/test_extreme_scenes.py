"""Numbers that misbehave: finite in, finite out, forward and backward, in single and double precision."""

from __future__ import annotations

import pytest
import torch

from bitymi_ns import ops
from bitymi_ns.ops.reference import render as reference_render
from bitymi_ns.ops.reference import view_color as reference_view_color
from bitymi_ns.scene import Camera, HashField, Scene, SceneConfig
from tests.ops.golden import SURFEL_KEYS, SV_KEYS, SceneCase, extreme_scenes, random_scene

CASES = extreme_scenes()


def render(case: SceneCase, dtype: torch.dtype):
    field = HashField(SceneConfig(), (0.0, 0.0, 0.0), 2.0, True, 10, torch.Generator().manual_seed(0))
    params = {key: value.to(dtype) for key, value in case.params.items()}
    scene = Scene(SceneConfig(texture_moves_surfels=True), params, field).to(dtype)
    camera = Camera(case.viewmat.to(dtype), case.K.to(dtype), case.width, case.height)
    output = scene.render(camera, case.background.to(dtype), maps=True)
    return scene, output


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["double", "single"])
@pytest.mark.parametrize("case", CASES, ids=[case.name for case in CASES])
def test_finite_in_finite_out(case: SceneCase, dtype: torch.dtype) -> None:
    scene, output = render(case, dtype)
    images = [output.rgb, output.alpha, output.beta, output.depth, output.normal]
    for image in images:
        assert image.isfinite().all()
    assert (output.alpha >= 0).all() and (output.alpha <= 1 + 1e-5).all()
    sum(image.sum() for image in images).backward()
    for name, parameter in scene.named_parameters():
        assert parameter.grad is None or parameter.grad.isfinite().all(), name


@pytest.mark.parametrize("case", [c for c in CASES if c.single], ids=[c.name for c in CASES if c.single])
def test_single_precision_agrees_with_the_reference(case: SceneCase) -> None:
    params = {key: value.float() for key, value in case.params.items()}
    scene = Scene(SceneConfig(texture="none"), params, None)
    camera = Camera(case.viewmat.float(), case.K.float(), case.width, case.height)
    got = scene.render(camera, case.background.float(), maps=True)
    doubles = {key: value.double() for key, value in params.items()}
    directions = reference_render.view_directions(doubles["means"], case.viewmat)
    colors = reference_view_color.sv(*(doubles[key] for key in SV_KEYS), directions)
    geometry = [doubles[key] for key in SURFEL_KEYS]
    want = reference_render.render(*geometry, colors, case.viewmat, case.K, case.width, case.height, case.background)
    error = (got.rgb.detach().double() - want.rgb).abs().amax(-1)
    assert (error < 2e-4).double().mean() > 0.99, f"largest error {error.max():.2e}"


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("name", SURFEL_KEYS)
def test_a_row_that_is_not_finite_is_dropped_and_counted(name: str, value: float) -> None:
    case = random_scene(20, 0)
    params = {key: tensor.float() for key, tensor in case.params.items()}
    params[name][3] = value
    camera = Camera(case.viewmat.float(), case.K.float(), case.width, case.height)
    scene = Scene(SceneConfig(texture="none"), params, None)
    output = scene.render(camera, maps=True)
    assert output.projection.not_finite == 1
    assert not (output.fragments.surfel == 3).any()
    assert output.rgb.isfinite().all()
    output.rgb.sum().backward()
    for key, parameter in scene.surfels.items():
        assert parameter.grad.isfinite().all(), key


def test_view_colors_at_extreme_temperatures_and_directions() -> None:
    n = 6
    params = {
        "sv_sites": torch.zeros(n, 7, 3),
        "sv_log_tau": torch.full((n, 7), 80.0),
        "sv_rgb": torch.rand(n, 7, 3),
    }
    params["sv_sites"][1:] = torch.randn(n - 1, 7, 3) * torch.tensor([1e-20, 1e-10, 1.0, 1e10, 1e18]).view(-1, 1, 1)
    leaves = {name: value.requires_grad_() for name, value in params.items()}
    center = torch.zeros(3)
    means = torch.cat([torch.zeros(1, 3), torch.randn(n - 1, 3)]).requires_grad_()
    color = ops.view_color("sv", leaves, means, center)
    color.sum().backward()
    assert color.isfinite().all() and means.grad.isfinite().all()
    assert all(leaf.grad.isfinite().all() for leaf in leaves.values())


def test_an_empty_scene_and_an_empty_view() -> None:
    case = random_scene(5, 0)
    params = {key: tensor.float()[:0] for key, tensor in case.params.items()}
    camera = Camera(case.viewmat.float(), case.K.float(), case.width, case.height)
    background = torch.tensor([0.2, 0.4, 0.6])
    output = Scene(SceneConfig(texture="none"), params, None).render(camera, background, maps=True)
    assert torch.equal(output.rgb, background.expand_as(output.rgb)) and len(output.fragments) == 0
