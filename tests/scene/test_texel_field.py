"""A scene with texels equals the baked renderer, with gradients confirmed by steps."""

import pytest
import torch
from torch import Tensor

from bitymi_ns.ops import Unlisted
from bitymi_ns.scene import Camera, Scene, SceneConfig
from bitymi_ns.scene.baked import BakedScene
from bitymi_ns.scene.field import TexelField
from tests.ops.golden import random_scene

BOUND = 0.03125  # exact in both precisions


def make(count: int = 40, most: int = 0, alpha: bool = False, **options: float) -> tuple[Scene, Camera, Tensor]:
    """Make a float64 scene, a view of it, and its atlas [1, 16, 8 N, 4]: tiles of 8 x 16 texels side by side."""
    case = random_scene(count, 3, **{"width": 60, "height": 40, **options})
    g = torch.Generator().manual_seed(0)
    atlas = torch.rand(1, 16, 8 * count, 4, generator=g) - 0.3
    size, extent = torch.tensor([[8, 16]]).expand(count, -1), torch.rand(count, generator=g) * 2 + 1
    texels = atlas[0, :, :, :3].view(16, count, 8, 3).transpose(0, 1).reshape(-1, 3)
    config = SceneConfig(weight_bound=BOUND, near=0.2, max_fragments=most)
    atlas[..., 3] = 2 * torch.rand(1, 16, 8 * count, generator=g)
    alphas = atlas[0, :, :, 3].view(16, count, 8).transpose(0, 1).reshape(-1).double() if alpha else None
    field = TexelField(size, extent.double(), texels.double(), alpha=alphas)
    scene = Scene(config, {name: value.double() for name, value in case.params.items()}, field)
    return scene, Camera(case.viewmat, case.K, case.width, case.height), atlas


@pytest.mark.parametrize("alpha", [False, True])
def test_it_is_what_the_baked_renderer_shows(alpha: bool) -> None:
    scene, camera, atlas = make(alpha=alpha)
    tiles = torch.tensor([[8 * i, 0, 0, 8, 16] for i in range(len(scene))], dtype=torch.int32)
    surfels = {name: value.detach() for name, value in scene.surfels.items()}
    extent = scene.field.tiles.extent
    how = {"extent": extent, "weight_bound": BOUND, "near": 0.2, "alpha_scale": float(alpha)}
    want = BakedScene(surfels, "sv", tiles, atlas, **how).render(camera).rgb
    with torch.no_grad():
        torch.testing.assert_close(scene.render(camera).rgb, want, rtol=1e-6, atol=1e-6)
        scene.field = None
        plain = scene.render(camera).rgb
    assert (plain - want).abs().max() > 0.1


@pytest.mark.parametrize("name", ["means", "quats", "log_scales", "opacity_logits", "sv_rgb", "texels", "alpha"])
def test_gradients_against_steps_in_a_direction(name: str) -> None:
    """The picture is piecewise smooth: a small step along the gradient changes it accordingly."""
    scene, camera, _ = make(count=12, width=24, height=18, alpha=name == "alpha")
    weights = torch.linspace(-1, 1, 24 * 18 * 3, dtype=torch.float64).view(18, 24, 3)
    parameter = getattr(scene.field, name) if name in ("texels", "alpha") else scene.surfels[name]

    def value() -> Tensor:
        return (scene.render(camera).rgb * weights).sum()

    value().backward()
    direction = parameter.grad / parameter.grad.norm()
    start, h = parameter.detach().clone(), 1e-7
    with torch.no_grad():
        ends = []
        for sign in (1.0, -1.0):
            parameter.copy_(start + sign * h * direction)
            ends.append(float(value()))
    assert (ends[0] - ends[1]) / (2 * h) == pytest.approx(float(parameter.grad.norm()), rel=1e-3)


def test_what_does_not_learn_gets_no_gradient() -> None:
    gradients = {}
    for mode in ("train", "frozen"):
        scene, camera, _ = make()
        scene.render(camera, field_mode=mode).rgb.square().sum().backward()
        gradients[mode] = scene.surfels["means"].grad
        assert (scene.field.texels.grad is None) == (mode == "frozen")
    assert not torch.allclose(gradients["train"], gradients["frozen"])


def test_bands_change_nothing() -> None:
    results, most = [], 0
    for _ in range(2):
        scene, camera, _ = make(most=most, height=120)
        output = scene.render(camera)
        most = int(0.8 * len(output.fragments))
        output.rgb.square().sum().backward()
        results.append([output.rgb.detach(), scene.field.texels.grad, scene.surfels["means"].grad])
    assert isinstance(output.fragments, Unlisted)
    for whole, parts in zip(*results, strict=True):
        torch.testing.assert_close(parts, whole, rtol=1e-9, atol=1e-9)
