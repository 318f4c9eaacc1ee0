"""Optimisation during an export on the scene's device: coverage, rate-distortion search, polish, fine-tuning."""

from collections.abc import Iterator

import pytest
import torch

from bitymi_ns.bake import BakeOptions, Coded, PolishOptions, RefineOptions, TuneOptions, bake
from bitymi_ns.bake.compact import Compact
from bitymi_ns.ops import backend
from bitymi_ns.ops.backend import cuda_backend
from bitymi_ns.scene import Scene
from bitymi_ns.train.config import TrainConfig
from bitymi_ns.train.fit import Trainer
from bitymi_ns.train.views import View
from tests.cuda.test_texel_training import HERE, START, config, scene_and_views
from tests.train.part_of_a_run import advanced

pytestmark = pytest.mark.slow

BACKGROUND = torch.tensor([0.2, 0.4, 0.6])


@pytest.fixture
def learned_on() -> Iterator[set[bool]]:
    """Record the backends of kernels that move texels: True = CUDA or emulated."""
    found: set[bool] = set()
    plain = backend.function

    def noted(name: str, device: torch.device):
        if name.startswith("blend_backward"):
            found.add(cuda_backend(device))
        return plain(name, device)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(backend, "function", noted)
        yield found


def trained() -> tuple[Scene, list[View]]:
    """A scene with slightly trained texels (on the CPU), and four photographs."""
    scene, views = scene_and_views()
    trainer = advanced(Trainer(scene, views, config(), 12), START + 3)
    return trainer.scene, [*views, *views]


def exported(scene: Scene, views: list[View], device: torch.device, refine: RefineOptions) -> Coded:
    cameras = [view.camera for view in views]  # the scene's device does the work
    options = BakeOptions(tolerance=0.75, format="uint8")
    return bake(scene.to(device), cameras, views, BACKGROUND, options, refine)


def db(baked: Coded, views: list[View]) -> float:
    """Compute the PSNR against the photographs, masked."""
    errors = [(baked.scene.render(v.camera, BACKGROUND).rgb - v.image).square() for v in views]
    return -10 * float(torch.stack([e.mean() for e in errors]).mean().log10())


@pytest.mark.parametrize("compact", [None, Compact(share=0.05, views=2)], ids=["pages", "compact"])
def test_texels_are_tuned_as_on_the_cpu(
    compact: Compact | None, device: torch.device, cpu, learned_on: set[bool]
) -> None:
    with cpu():
        scene, views = trained()
    refine = RefineOptions(tune=TuneOptions.of_learned(12), compact=compact)
    learned_on.clear()
    got = exported(scene, views, device, refine)
    assert learned_on == {True}
    with cpu():
        want = exported(scene.to(HERE), views, HERE, refine)
        plain = exported(scene, views, HERE, RefineOptions(compact=compact))
        mine, cpus, untuned = (db(each, views) for each in (got, want, plain))
    assert got.statistics.finetune.steps == want.statistics.finetune.steps == 12
    assert all(value.device == HERE for value in got.scene.surfels.values())
    assert abs(mine - cpus) < 0.05 and cpus > untuned + 0.05
    if compact is None:
        torch.testing.assert_close(got.texels, want.texels, rtol=1e-3, atol=1e-3)


def test_texels_and_surfels_are_polished_as_on_the_cpu(device: torch.device, cpu, learned_on: set[bool]) -> None:
    with cpu():
        scene, views = trained()
    refine = RefineOptions(
        polish=PolishOptions(steps=6, val_every=2), tune=TuneOptions(steps=6, coded_steps=4), train=TrainConfig()
    )
    learned_on.clear()
    got = exported(scene, views, device, refine)
    assert learned_on == {True}
    with cpu():
        want = exported(scene.to(HERE), views, HERE, refine)
        mine, cpus = (db(each, views) for each in (got, want))
    assert got.statistics.polish.steps == want.statistics.polish.steps and got.statistics.finetune.steps > 4
    assert abs(mine - cpus) < 0.1
