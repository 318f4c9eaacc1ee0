"""Image losses and densification statistics of a training step, by CUDA kernels.

In torch they are about fifty small operations, whose launches take the host longer than the GPU takes to run them.
"""

import torch
from torch import Tensor

from .backend import dense, kernel, module, on_same_device, require
from .constants import IMAGE_CHANNELS
from .project import Projection
from .ssim import similarity


class _PictureLosses(torch.autograd.Function):
    @staticmethod
    def forward(ctx, image, target, mask, share, weight, gamma):
        pixels, wanted, rgb, flat = dense(image, image), dense(target, image), image[..., :3].detach(), None
        if mask is not None:  # masked-out pixels are made equal in both pictures
            flat, counts = mask.reshape(-1).contiguous().view(torch.uint8), mask.reshape(*image.shape[:2], 1)
            rgb, wanted = torch.where(counts, rgb, 0.0), torch.where(counts, wanted, 0.0)
        alike, dalike = similarity(rgb, wanted, ctx.needs_input_grad[0])
        photometric, falloff, counted = (image.new_empty(()) for _ in range(3))
        sums = torch.empty(module(image.device).LOSS_SUMS, dtype=torch.float64, device=image.device)
        ctx.arguments = {"gamma": gamma, "share": share, "weight": weight}
        kernel("picture_loss", image)(
            image=pixels,
            target=wanted,
            mask=flat,
            similarity=alike,
            sums=sums,
            photometric=photometric,
            falloff=falloff,
            counted=counted,
            **ctx.arguments,
        )
        ctx.save_for_backward(pixels, wanted, flat, counted)
        ctx.dalike = dalike
        return photometric, falloff

    @staticmethod
    def backward(ctx, dphotometric, dfalloff):
        image, target, mask, counted = ctx.saved_tensors
        dimage = torch.empty_like(image)
        kernel("picture_loss_backward", image)(
            image=image,
            target=target,
            mask=mask,
            counted=counted,
            dsimilarity=ctx.dalike,
            dphotometric=dense(dphotometric, image),
            dfalloff=dense(dfalloff, image),
            dimage=dimage,
            **ctx.arguments,
        )
        return dimage, None, None, None, None, None


def picture_losses(
    image: Tensor,
    target: Tensor,
    ssim_weight: float,
    falloff_weight: float,
    gamma: float,
    mask: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Compute the photometric and the weighted falloff loss of a picture (`train.losses.objective`), two scalars.

    Args:
        image: [H, W, 5] rgb, alpha and beta on a CUDA device, at least as large as a window of SSIM.
        target: [H, W, 3] photograph.
        ssim_weight: w of (1 - w) L1 + w (1 - SSIM).
        falloff_weight: weight of the mean of omega beta, omega = exp(-gamma e).
        gamma: decay of omega with the error e, the sum of absolute differences over rgb.
        mask: [H, W] or [H, W, 1] bool, True for pixels that count; None: all.

    Raises:
        ValueError: shapes or devices do not agree.
        RuntimeError: the tensors are not on a CUDA device.
    """
    require("picture_losses", "cuda", image.device, "call `train.losses.objective`")
    if image.dim() != 3 or image.shape[-1] != IMAGE_CHANNELS or tuple(target.shape) != (*image.shape[:2], 3):
        raise ValueError(f"the picture is {list(image.shape)} and the photograph {list(target.shape)}")
    on_same_device(image, target=target)
    if mask is not None:
        on_same_device(image, mask=mask)
        if mask.dtype != torch.bool or mask.numel() != image.shape[0] * image.shape[1]:
            raise ValueError(f"the picture is {list(image.shape)}, its mask {list(mask.shape)} {mask.dtype}, not bool")
    return _PictureLosses.apply(image, target, mask, ssim_weight, falloff_weight, gamma)


@torch.no_grad()
def note_centers(
    projection: Projection,
    width: int,
    height: int,
    grad_sum: Tensor,
    abs_grad_sum: Tensor,
    visible_count: Tensor,
    max_radius: Tensor,
) -> None:
    """Add a view to the statistics of densification in place; see `train.strategy.Strategy.accumulate`.

    Args:
        projection: of the view, after its backward pass.
        width, height: of the picture, pixels.
        grad_sum, abs_grad_sum, visible_count, max_radius: [N] float32.

    Raises:
        RuntimeError: the tensors are not on a CUDA device.
    """
    radii = projection.radii
    require("note_centers", "cuda", radii.device, "call `Strategy.accumulate`")
    grads = {"grad": projection.mean2d_grad, "absgrad": projection.mean2d_absgrad}
    kernel("note_centers", radii)(
        radii=radii,
        **{name: None if grad is None else dense(grad, radii) for name, grad in grads.items()},
        width=width,
        height=height,
        grad_sum=grad_sum,
        abs_grad_sum=abs_grad_sum,
        visible_count=visible_count,
        max_radius=max_radius,
    )
