"""The SSIM float64 reference against torchmetrics."""

import pytest
import torch

from bitymi_ns.ops.reference.ssim import ssim


def images(seed: int, height: int = 23, width: int = 31) -> tuple[torch.Tensor, torch.Tensor]:
    g = torch.Generator().manual_seed(seed)
    a = torch.rand(height, width, 3, generator=g, dtype=torch.float64)
    noise = torch.randn(height, width, 3, generator=g, dtype=torch.float64)
    return a, (a + 0.2 * noise).clamp(0, 1)


@pytest.mark.parametrize("seed", range(3))
def test_agrees_with_torchmetrics_inside_the_border(seed: int) -> None:
    module = pytest.importorskip("torchmetrics.functional.image.ssim")
    a, b = images(seed)
    _, full = module._ssim_update(
        a.permute(2, 0, 1)[None], b.permute(2, 0, 1)[None], data_range=1.0, return_full_image=True
    )
    if full.shape[-2:] == a.shape[:2]:
        full = full[..., 5:-5, 5:-5]
    assert float(ssim(a, b)) == pytest.approx(float(full.mean()), abs=1e-6)


def test_equal_images_one_window_and_small_images() -> None:
    a, b = images(3, 11, 11)
    assert float(ssim(a, a)) == pytest.approx(1.0, abs=1e-12)
    assert float(ssim(a, b)) < 1
    with pytest.raises(ValueError, match="at least 11"):
        ssim(a[:10], b[:10])
    with pytest.raises(ValueError, match="one shape"):
        ssim(a, b[:, :5])


def test_gradients() -> None:
    a, b = images(4, 12, 13)
    assert torch.autograd.gradcheck(ssim, (a[..., :1].requires_grad_(), b[..., :1].requires_grad_()))
