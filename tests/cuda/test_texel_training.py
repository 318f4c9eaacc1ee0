"""Texel scenes on the device: pictures, tiles and whole runs as on the CPU, and their changes in number."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from bitymi_ns.bake.pipeline import trained_texels
from bitymi_ns.bake.prune import prune_and_resample
from bitymi_ns.bundle.bake_options import BakeOptions
from bitymi_ns.scene import Camera, Scene, SceneConfig
from bitymi_ns.train.config import DensifyConfig, TexelConfig, TrainConfig
from bitymi_ns.train.fit import Trainer
from bitymi_ns.train.texels import blank_texels
from bitymi_ns.train.views import View
from tests.cuda.conftest import HERE
from tests.ops.golden import random_scene
from tests.train import part_of_a_run
from tests.train.part_of_a_run import advanced

STEPS, START = 12, 6


def scene_and_views() -> tuple[Scene, list[View]]:
    """Make a few discs that will have texels, and photographs of other colours, one with a mask."""
    case = random_scene(20, 5, width=24, height=20, scale=0.5)
    config = SceneConfig(texture="texels", near=0.2)
    scene = Scene(config, {key: value.float() for key, value in case.params.items()}, None)
    g = torch.Generator().manual_seed(2)
    camera = Camera(case.viewmat.float(), case.K.float(), case.width, case.height)
    mask = (torch.arange(20 * 24) % 5 > 0).view(20, 24, 1)
    return scene, [View(camera, torch.rand(20, 24, 3, generator=g), each) for each in (None, mask)]


def config(alpha_rate: float = 0.0) -> TrainConfig:
    """Configure texels in the second half of the run, including the final prunes."""
    prunes = {
        "min_surfels": 5,
        "final_prune_steps": (20_000, 22_500),
        "final_prune_opacity": 0.6,
        "final_prune_error": 0.2,
    }
    densify = DensifyConfig(max_surfels=20, min_interval=1, min_reset_interval=1000, pixels_per_surfel=0, **prunes)
    texels = TexelConfig(start=30_000 * START // STEPS, pixels_per_texel=0.5, alpha_rate=alpha_rate)
    return TrainConfig(background="black", resolution_schedule=0, densify=densify, texels=texels)


def trainer_on(device: torch.device, alpha_rate: float = 0.0) -> Trainer:
    scene, views = scene_and_views()
    return Trainer(scene.to(device), views, config(alpha_rate), STEPS)


def state_of(scene: Scene) -> dict[str, Tensor]:
    return {name: value.detach().cpu().clone() for name, value in scene.state_dict().items()}


def test_tiles_and_coverage_are_those_of_the_cpu(device: torch.device, both) -> None:
    scene, views = scene_and_views()
    got, want = both(lambda where: blank_texels(scene.to(where), views, 4, config().texels)[0])
    assert got.texels.device.type == device.type and len(got.texels) == len(want.texels) > 200
    assert torch.equal(got.size.cpu(), want.size) and want.size.max() > 4
    torch.testing.assert_close(got.extent.cpu(), want.extent, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(got.share.cpu(), want.share, rtol=1e-3, atol=1e-5)
    assert want.share.max() > 2 * want.share.min()


@pytest.mark.parametrize("alpha_rate", [0.0, 0.5])
def test_a_run_is_that_of_the_cpu(alpha_rate: float, device: torch.device, both) -> None:
    def losses(where: torch.device) -> tuple[list[float], list[int], dict[str, Tensor]]:
        trainer, seen, surfels = trainer_on(where, alpha_rate), [], []
        for _ in range(STEPS):
            trainer.advance()
            seen.append(trainer.loss)
            surfels.append(len(trainer.scene))
        return seen, surfels, state_of(trainer.scene)

    (got, surfels, state), (want, cpu_surfels, cpu_state) = both(losses)
    assert got == pytest.approx(want, rel=2e-3)
    assert surfels == cpu_surfels and surfels[-1] < surfels[START]  # pruned while texels learned
    assert state.keys() == cpu_state.keys() and torch.equal(state["field.size"], cpu_state["field.size"])
    assert cpu_state["field.texels"].abs().max() > 0.1
    assert not alpha_rate or (cpu_state["field.alpha"] - 1).abs().max() > 0.1
    for name, value in cpu_state.items():
        # Adam's first steps have the length of the rate: where a gradient is nearly 0 their sign may differ
        close = torch.isclose(state[name].double(), value.double(), rtol=1e-2, atol=2e-3)
        assert close.double().mean() > 0.95, name


def test_a_run_resumes_before_and_after_its_texels_came(device: torch.device) -> None:
    torch.use_deterministic_algorithms(True, warn_only=True)  # not all torch operations support it
    try:
        straight, states = trainer_on(device), []
        for done in range(STEPS):
            if done in (START - 1, START + 3):
                states.append(part_of_a_run.state_of(straight))
            straight.advance()
        want = state_of(straight.scene)
        for state in states:
            resumed = trainer_on(device)
            part_of_a_run.resume(resumed, state)
            advanced(resumed, STEPS - resumed.step)
            got = state_of(resumed.scene)
            assert got.keys() == want.keys()
            for name, value in want.items():
                if device.type == "cpu":  # emulated
                    assert torch.equal(got[name], value), name
                else:
                    torch.testing.assert_close(got[name], value, rtol=1e-3, atol=1e-3)
    finally:
        torch.use_deterministic_algorithms(False)


def test_what_is_left_out_of_a_bake_is_that_of_the_cpu(device: torch.device, cpu) -> None:
    """Tiles and view colours are reduced on the device of the scene."""
    trainer = advanced(trainer_on(device), START + 3)
    baked, cameras = trained_texels(trainer.scene, BakeOptions(tolerance=4.0)), [v.camera for v in scene_and_views()[1]]

    got = prune_and_resample(baked, cameras)
    with cpu():
        want = prune_and_resample(replace(baked, device=HERE), cameras)
    assert len(want.rows) > 5 and want.packing.texels < baked.packing.texels
    torch.testing.assert_close(got.rows, want.rows)
    torch.testing.assert_close(torch.from_numpy(got.packing.tiles), torch.from_numpy(want.packing.tiles))
    torch.testing.assert_close(got.texels, want.texels, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(got.in_front, want.in_front, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(got.scene.surfels["view_span"], want.scene.surfels["view_span"])
    torch.testing.assert_close(got.scene.photographed, want.scene.photographed)
    assert all(value.device == HERE for value in got.scene.surfels.values())
    assert got.colors is not None and want.colors is not None
    assert got.colors.error.device == HERE and got.colors.error.isfinite().any()
    torch.testing.assert_close(got.colors.error, want.colors.error, rtol=1e-2, atol=1e-4)
