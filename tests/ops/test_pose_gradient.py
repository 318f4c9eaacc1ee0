"""Gradients of a view with respect to the camera's pose, against finite differences."""

import pytest
import torch
from torch import Tensor

from bitymi_ns.scene import Camera, Scene, SceneConfig
from bitymi_ns.train.poses import moved
from tests.ops.golden import SceneCase, load_golden, random_scene, relative

SMOOTH = ["inside_the_scene", "many_layers", "soft_discs", "subpixel", "thin"]  # no threshold within a difference
STEP = 1e-7


def loss_of(case: SceneCase, dtype: torch.dtype = torch.float64, device: torch.device | str = "cpu"):
    """Return a function from a camera motion to a weighted sum of colours and depths."""
    params = {name: value.to(device, dtype) for name, value in case.params.items()}
    scene = Scene(SceneConfig(texture="none", rim=1e-12, near=0.2), params, None)
    shape = (case.height, case.width, 3)
    weights = torch.rand(shape, generator=torch.Generator().manual_seed(4), dtype=torch.float64).to(device, dtype)

    def loss(motion: Tensor) -> Tensor:
        viewmat = moved(case.viewmat.double(), motion).to(device, dtype)
        camera = Camera(viewmat, case.K.to(device, dtype), case.width, case.height)
        output = scene.render(camera, None, maps=True)
        return (output.rgb * weights).sum() + 0.1 * (output.depth * weights[..., :1]).sum()

    return loss


def gradient(loss) -> Tensor:
    motion = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    loss(motion).backward()
    return motion.grad


def differences(loss) -> Tensor:
    with torch.no_grad():
        steps = STEP * torch.eye(6, dtype=torch.float64)
        return torch.stack([(loss(step) - loss(-step)) / (2 * STEP) for step in steps]).double().cpu()


@pytest.mark.parametrize("name", SMOOTH)
def test_finite_differences(name: str) -> None:
    loss = loss_of(load_golden(name))
    assert relative(gradient(loss), differences(loss)) < 1e-4


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("length", [1e-15, 1.0, 1e15])
def test_random_surfels_and_quaternions_of_any_length(seed: int, length: float) -> None:
    case = random_scene(40, seed, width=24, height=20)
    case.params["quats"] *= length
    loss = loss_of(case)
    assert relative(gradient(loss), differences(loss)) < 2e-3  # rims cross pixels


def test_surfels_that_are_not_finite_or_behind_the_camera_count_for_nothing() -> None:
    case = load_golden("soft_discs")
    want = gradient(loss_of(case))
    bad = {name: value[:4].clone() for name, value in case.params.items()}
    bad["means"][0], bad["means"][1, 2] = float("nan"), float("inf")
    bad["quats"][2] = float("nan")
    bad["means"][3] = -(case.viewmat[:3, :3].T @ (case.viewmat[:3, 3] + torch.tensor([0.0, 0.0, 5.0])).double())
    case.params = {name: torch.cat([value, bad[name]]) for name, value in case.params.items()}
    torch.testing.assert_close(gradient(loss_of(case)), want)


def test_far_from_the_origin_the_turn_is_still_about_the_camera() -> None:
    case = load_golden("soft_discs")
    want = gradient(loss_of(case))
    shift = torch.tensor([3e4, -2e4, 1e4], dtype=torch.float64)
    case.params["means"] = case.params["means"].double() + shift
    case.viewmat = case.viewmat.double().clone()
    case.viewmat[:3, 3] -= case.viewmat[:3, :3] @ shift
    assert relative(gradient(loss_of(case)), want) < 1e-6


def test_in_single_precision() -> None:
    case = load_golden("soft_discs")
    assert relative(gradient(loss_of(case, torch.float32)), gradient(loss_of(case))) < 1e-3


def test_surfels_have_the_same_gradients_to_the_bit_whether_the_camera_has_one() -> None:
    case, found = load_golden("soft_discs"), []
    for asks in (False, True):
        params = {name: value.float() for name, value in case.params.items()}
        scene = Scene(SceneConfig(texture="none", near=0.2), params, None)
        viewmat = case.viewmat.float().clone().requires_grad_(asks)
        output = scene.render(Camera(viewmat, case.K.float(), case.width, case.height))
        output.rgb.square().sum().backward()
        assert (viewmat.grad is not None) == asks
        found.append({name: p.grad for name, p in scene.surfels.items()})
    assert all(torch.equal(found[0][name], found[1][name]) for name in found[0])
