"""Losses and statistics of a training step on CUDA, against torch."""

import math
from types import SimpleNamespace

import pytest
import torch
from torch import Tensor

from bitymi_ns.ops.picture_cuda import PhotographTarget, accumulate_statistics, picture_losses
from bitymi_ns.ops.project import Projection
from bitymi_ns.scene.camera import Camera
from bitymi_ns.scene.scene import RenderOutput
from bitymi_ns.train.config import LossConfig
from bitymi_ns.train.losses import error_weight, mean_where_right, objective, photometric
from tests.ops.test_kernels import relative

DTYPES = pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["double", "single"])


def picture(height: int, width: int, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    g = torch.Generator().manual_seed(height)
    image = torch.rand(height, width, 5, generator=g, dtype=torch.float64).to(dtype)
    target = (image[..., :3] + 0.1 * torch.randn(height, width, 3, generator=g, dtype=torch.float64)).to(dtype)
    target[0, :, :] = image[0, :, :3]  # right already: no slope
    return image, target


def photograph(target: Tensor, mask: Tensor | None = None) -> PhotographTarget:
    return PhotographTarget(target, mask, None, 0.2, 0.5, 4.0)


@DTYPES
@pytest.mark.parametrize("size", [(11, 11), (37, 70)])
def test_losses_and_gradient(size: tuple[int, int], dtype: torch.dtype, device: torch.device, cpu) -> None:
    image, target = picture(*size, dtype)

    def gradient(image: Tensor, both: tuple[Tensor, Tensor]) -> list[Tensor]:
        (found,) = torch.autograd.grad(2.0 * both[0] + 3.0 * both[1], image)
        return [value.detach().cpu().double() for value in (*both, found)]

    drawn = image.to(device).requires_grad_()
    got = gradient(drawn, picture_losses(drawn, photograph(target.to(device))))
    with cpu():
        image = image.double().requires_grad_()
        target = target.double()
        omega = error_weight(image[..., :3], target, 4.0)
        falloff = 0.5 * mean_where_right(omega, image[..., 4:5])
        want = gradient(image, (photometric(image[..., :3], target, 0.2), falloff))
    for a, b in zip(got, want, strict=True):
        assert relative(a, b) < (1e-12 if dtype == torch.float64 else 3e-5)
    assert not got[2][..., 3].any()


@DTYPES
@pytest.mark.parametrize("share", [0.6, 0.0], ids=["some", "none"])
def test_losses_and_gradient_where_a_mask_counts(share: float, dtype: torch.dtype, device: torch.device, cpu) -> None:
    image, target = picture(37, 300, dtype)  # more pixels than a block sums
    view = SimpleNamespace(camera=SimpleNamespace(height=37, width=300))
    mask = torch.rand(37, 300, generator=torch.Generator().manual_seed(3)) < share
    target[~mask] = math.nan

    def losses(device: torch.device, dtype: torch.dtype) -> list[Tensor]:
        drawn = image.to(device, dtype, copy=True).requires_grad_()
        output = RenderOutput.of_image(drawn.view(-1, 5), view, None, None, maps=False)
        config = LossConfig(ssim_weight=0.2, falloff_weight=0.5, falloff_gamma=4.0)
        terms = objective(output, target.to(device, dtype), config, mask.to(device))
        (found,) = torch.autograd.grad(2.0 * terms["photometric"] + 3.0 * terms["falloff"], drawn)
        return [value.detach().cpu().double() for value in (*terms.values(), found)]

    got = losses(device, dtype)
    with cpu():
        want = losses(torch.device("cpu"), torch.float64)
    for a, b in zip(got, want, strict=True):
        assert a.isfinite().all() and relative(a, b) < (1e-12 if dtype == torch.float64 else 3e-5)
    assert not got[2][~mask].any()


def test_one_loss_alone_has_a_gradient(device: torch.device) -> None:
    image, target = (value.to(device) for value in picture(12, 13, torch.float32))
    image.requires_grad_()
    only, _ = picture_losses(image, photograph(target))
    (found,) = torch.autograd.grad(only, image)
    assert found[..., :3].any() and not found[..., 3:].any()


def test_shapes_are_checked(device: torch.device) -> None:
    image, target = (value.to(device) for value in picture(12, 13, torch.float32))
    with pytest.raises(ValueError, match="the photograph"):
        picture_losses(image, photograph(target[1:]))
    with pytest.raises(ValueError, match="the picture is"):
        picture_losses(image[..., :4], photograph(target))
    for mask in (target[..., 0], target[1:, :, 0] > 0.5):
        with pytest.raises(ValueError, match="its mask"):
            picture_losses(image, photograph(target, mask))


@DTYPES
def test_statistics(dtype: torch.dtype, device: torch.device) -> None:
    n, width, height = 300, 40, 30
    g = torch.Generator().manual_seed(2)
    radii = (torch.rand(n, 2, generator=g) * 9).to(dtype)
    radii[::3] = 0
    geom = torch.randn(n, 16, generator=g).to(dtype)
    absgrad = torch.rand(n, 2, generator=g).to(dtype)
    geom[1, 0], geom[2, 1], absgrad[4, 0] = math.nan, math.inf, -math.inf
    before = [torch.rand(n, generator=g) * 5 for _ in range(4)]
    camera = Camera(torch.eye(4), torch.eye(3), width, height)
    projection = Projection(geom, geom[:, :9], radii.to(device), camera, 0.1, False, torch.zeros(1, dtype=torch.int32))
    projection.mean2d_grad, projection.mean2d_absgrad = geom.to(device)[:, :2], absgrad.to(device)

    got = [value.clone().to(device) for value in before]
    accumulate_statistics(projection, width, height, *got)
    seen = radii[:, 0] > 0
    scale = torch.tensor([0.5 * width, 0.5 * height], dtype=dtype)
    for value, old, grad in zip(got[:2], before[:2], (geom[:, :2], absgrad), strict=True):
        size = torch.hypot(*(scale * grad).unbind(1)).nan_to_num(0.0, 0.0, 0.0)
        torch.testing.assert_close(value.cpu(), old + torch.where(seen, size, 0.0).float(), rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(got[2].cpu(), before[2] + seen)
    radius = torch.maximum(before[3], radii.amax(-1).float())
    torch.testing.assert_close(got[3].cpu(), torch.where(seen, radius, before[3]), rtol=0, atol=0)

    projection.mean2d_grad = projection.mean2d_absgrad = None  # no fragment at all
    accumulate_statistics(projection, width, height, *got)
    torch.testing.assert_close(got[2].cpu(), before[2] + 2.0 * seen)
