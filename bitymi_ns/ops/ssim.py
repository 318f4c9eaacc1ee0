"""Structural similarity."""

import torch
from torch import Tensor

from .backend import cuda_backend, dense, kernel, workspace


class _Ssim(torch.autograd.Function):
    @staticmethod
    def forward(ctx, a, b):
        height, width, channels = a.shape
        x, y = dense(a, a), dense(b, a)
        ctx.grad = torch.empty_like(x) if ctx.needs_input_grad[0] else None
        value = x.new_empty(())  # the host does not wait for it
        size = {"height": height, "width": width, "channels": channels}
        work = {}
        if cuda_backend(x.device):
            work["workspace"] = workspace("ssim", x, **size, gradient=ctx.grad is not None)
        kernel("ssim", x)(a=x, b=y, **size, value=value, da=ctx.grad, **work)
        return value

    @staticmethod
    def backward(ctx, dvalue):
        return dvalue * ctx.grad, None


def ssim(a: Tensor, b: Tensor) -> Tensor:
    """Compute the mean SSIM, a scalar tensor, of images [H, W, C] in [0, 1] over the valid 11 x 11 Gaussian windows
    (sigma 1.5), K1 = 0.01, K2 = 0.03; 1 for images smaller than a window. Differentiable in `a`."""
    if a.shape != b.shape or a.dim() != 3:
        raise ValueError(f"ssim compares two [H, W, C] images of one size, not {list(a.shape)} and {list(b.shape)}")
    return _Ssim.apply(a, b)
