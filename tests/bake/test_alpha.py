"""Alpha texels of a trained scene through the stages of the bake."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from bitymi_ns.bake import BakeOptions, export
from bitymi_ns.bake.compact import Compact
from bitymi_ns.bake.pipeline import RefineOptions, bake, trained_texels
from bitymi_ns.bake.prune import prune_and_resample
from bitymi_ns.bake.tune import TuneOptions
from bitymi_ns.bundle import read_bundle
from bitymi_ns.bundle.verify import check_files
from bitymi_ns.scene import Camera, Scene, SceneConfig
from bitymi_ns.scene.field import TexelField
from bitymi_ns.train.losses import psnr
from bitymi_ns.train.views import View
from tests.ops.golden import random_scene

COUNT, SIDE = 60, 8


@pytest.fixture
def trained() -> tuple[Scene, Camera]:
    """Surfels with transparent left halves, and one without a tile."""
    case = random_scene(COUNT, 3, width=60, height=40)
    size = torch.full((COUNT, 2), SIDE)
    size[0] = 1
    g = torch.Generator().manual_seed(0)
    areas = size.prod(1)
    texels = 0.3 * torch.rand(int(areas.sum()), 3, generator=g) - 0.15
    column = torch.arange(len(texels) - 1) % SIDE
    alpha = torch.cat([torch.tensor([0.5]), torch.where(column < SIDE // 2, 0.0, 1.25)])
    field = TexelField(size, torch.full((COUNT,), 2.0), texels, alpha=alpha)
    params = {name: value.float() for name, value in case.params.items()}
    return Scene(SceneConfig(near=0.2), params, field), Camera(case.viewmat, case.K, case.width, case.height)


@torch.no_grad()
def rgb(scene, camera: Camera) -> Tensor:
    return scene.render(camera).rgb


def test_bakes_show_what_was_trained(trained) -> None:
    scene, camera = trained
    want = rgb(scene, camera)
    baked = trained_texels(scene, BakeOptions())
    assert baked.texels.shape[1] == 4 and baked.scene.mean_alpha[0] == 0.5
    torch.testing.assert_close(rgb(baked.unquantised(), camera), want, rtol=1e-5, atol=1e-5)
    opaque = replace(baked.unquantised(), alpha_scale=0.0, mean_alpha=None)
    assert psnr(rgb(opaque, camera), want) < 25  # alpha decides the picture
    smaller = prune_and_resample(baked, [camera])
    assert psnr(rgb(smaller.unquantised(), camera), want) > 45
    assert psnr(rgb(smaller.encoded().scene, camera), want) > 35


def test_a_compact_bundle_keeps_the_alphas_that_its_colours_were_tuned_over(trained, tmp_path: Path) -> None:
    scene, camera = trained
    want = rgb(scene, camera).clamp(0, 1)
    views = [View(camera, want)]
    tune = replace(TuneOptions.of_learned(20), coded_every=5)
    compact = Compact(share=0.5, views=1)
    baked = bake(scene, [camera], views, torch.zeros(3), BakeOptions(), RefineOptions(tune=tune, compact=compact))
    assert torch.equal(baked.codes.texels.alphas(), baked.texels[:, 3])
    export(baked, folder := tmp_path / "b")
    bundle, checks = check_files(folder)
    assert all(check.ok for check in checks), checks
    assert bundle.info.version == "6.0"
    shown = read_bundle(folder).scene
    torch.testing.assert_close(rgb(shown, camera), rgb(baked.scene, camera), rtol=0, atol=1e-6)
    assert psnr(rgb(shown, camera), want) > 38
