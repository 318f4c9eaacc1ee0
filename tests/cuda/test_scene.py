"""Views and their gradients on CUDA against the CPU: every operation of a training step."""

import pytest
import torch
from torch import Tensor

from bitymi_ns import ops
from tests.cuda.test_training_view import Operations
from tests.ops.golden import SceneCase, load_golden, random_scene
from tests.scene.small import scene_of


def step(case: SceneCase, device: torch.device, texture: bool, mode: str) -> dict[str, Tensor]:
    """Compute images and the gradients of 0.8 L1 + 0.2 (1 - SSIM) and of the maps."""
    scene, camera = scene_of(case, device, texture)
    output = scene.render(camera, case.background.to(device), field_mode=mode, maps=True)
    photo = torch.rand(output.rgb.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64).to(device)
    loss = 0.8 * (output.rgb - photo).abs().mean() + 0.2 * (1 - ops.ssim(output.rgb, photo))
    loss = loss + output.beta.mean() + 0.1 * output.depth.mean() + (output.normal * photo).mean()
    loss.backward()
    result = {name: getattr(output, name).detach() for name in ("rgb", "alpha", "beta", "depth", "normal", "overdraw")}
    for name, parameter in scene.named_parameters():
        if parameter.grad is not None:
            result[f"gradient of {name}"] = parameter.grad
    return {name: value.cpu().double() for name, value in result.items()}


@pytest.mark.parametrize(("texture", "mode"), [(False, "train"), (True, "frozen"), (True, "train")])
@pytest.mark.parametrize("name", ["random", "inside_the_scene", "seed 5"])
def test_a_training_step_equals_that_of_the_cpu(name: str, texture: bool, mode: str, both) -> None:
    case = random_scene(40, 5, 33, 21) if name == "seed 5" else load_golden(name)
    got, want = both(lambda where: step(case, where, texture, mode))
    assert got.keys() == want.keys()
    assert any("field" in key for key in got) == (texture and mode == "train")
    for key, value in want.items():
        assert (got[key] - value).abs().max() <= 1e-9 * value.abs().max(), key


def test_masked_counts_equal_those_of_the_cpu(both) -> None:
    case = random_scene(40, 5, 33, 21)
    mask = torch.rand(33 * 21, generator=torch.Generator().manual_seed(0)) < 0.5

    def counts(device: torch.device) -> Tensor:
        scene, camera = scene_of(case, device, False)
        return scene.render(camera).fragments.masked_counts(mask.to(device)).cpu()

    got, want = both(counts)
    assert torch.equal(got, want) and got.any()


@pytest.mark.parametrize(
    ("texture", "what", "waits"),
    [(False, {"maps": True}, 1), (False, {"overdraw_half": 0.005}, 2), (True, {"maps": True}, 3)],
    ids=["no list", "a list", "the field"],
)
def test_a_step_waits_for_no_more_than_the_lengths_of_lists(
    texture: bool, what: dict, waits: int, device: torch.device
) -> None:
    scene, camera = scene_of(random_scene(40, 5, 33, 21), device, texture)
    scene.render(camera, **what)  # warm-up, for cached values
    with Operations() as counted:
        scene.render(camera, **what).rgb.mean().backward()
    assert counted.waits == waits
