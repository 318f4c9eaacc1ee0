"""Image losses and densification statistics of a training step, by CUDA kernels.

In torch they are about fifty small operations, whose launches take the host longer than the GPU takes to run them.
"""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from .backend import dense, kernel, on_same_device, workspace
from .constants import IMAGE_CHANNELS
from .project import Projection


@dataclass(frozen=True)
class PhotographTarget:
    """A photograph to compare a picture with, and the weights of the losses.

    Attributes:
        target: [H, W, 3].
        mask: [H, W] or [H, W, 1] bool, True for pixels that count; None: all.
        background: [3] colour behind the picture; None: black, or the picture contains it.
        ssim_weight: w of (1 - w) L1 + w (1 - SSIM).
        falloff_weight: weight of the mean of omega beta, omega = exp(-falloff_gamma e).
        falloff_gamma: decay of omega with the error e, the sum of absolute differences over rgb.
    """

    target: Tensor
    mask: Tensor | None
    background: Tensor | None
    ssim_weight: float
    falloff_weight: float
    falloff_gamma: float

    def check(self, like: Tensor, size: tuple[int, ...]) -> None:
        """Raise a ValueError unless shapes fit a picture [H, W] = `size`, the mask is bool and devices are `like`'s."""
        if tuple(self.target.shape) != (*size, 3):
            raise ValueError(f"the picture is {list(size)} and the photograph {list(self.target.shape)}")
        on_same_device(like, target=self.target)
        if self.mask is not None:
            on_same_device(like, mask=self.mask)
            if self.mask.dtype != torch.bool or self.mask.numel() != size[0] * size[1]:
                mask = f"{list(self.mask.shape)} {self.mask.dtype}"
                raise ValueError(f"the picture is {list(size)}, its mask {mask}, not bool")

    def arguments(self, like: Tensor, correction: Tensor | None = None) -> dict[str, Any]:
        """Build the kernels' arguments for a picture (`Picture` of csrc/cuda/training.h). `like`: of the picture's
        dtype and device. `correction`: of the photograph, [3] or [3, 4], see `train.views.View`; None: none."""
        return {
            "target": dense(self.target, like),
            "mask": None if self.mask is None else self.mask.reshape(-1).contiguous().view(torch.uint8),
            "background": None if self.background is None else dense(self.background, like),
            "correction": None if correction is None else dense(correction, like),
            "corrected": 0 if correction is None else correction.numel(),
            "ssim_weight": self.ssim_weight,
            "falloff_weight": self.falloff_weight,
            "falloff_gamma": self.falloff_gamma,
        }


class _PictureLosses(torch.autograd.Function):
    @staticmethod
    def forward(ctx, image, photograph):
        pixels, size = dense(image, image), {"height": image.shape[0], "width": image.shape[1]}
        photometric, falloff = image.new_empty(2).unbind()
        memory = workspace("picture_loss", image, **size)
        ctx.arguments = {**photograph.arguments(pixels), **size}
        written = {"photometric": photometric, "falloff": falloff, "picture_work": memory}
        kernel("picture_loss", image)(**ctx.arguments, **written, image=pixels)
        ctx.save_for_backward(pixels, memory)
        return photometric, falloff

    @staticmethod
    def backward(ctx, dphotometric, dfalloff):
        image, memory = ctx.saved_tensors
        dimage = torch.empty_like(image)
        kernel("picture_loss_backward", image)(
            **ctx.arguments,
            image=image,
            picture_work=memory,
            dphotometric=dense(dphotometric, image),
            dfalloff=dense(dfalloff, image),
            dimage=dimage,
        )
        return dimage, None


def picture_losses(image: Tensor, photograph: PhotographTarget) -> tuple[Tensor, Tensor]:
    """Compute the photometric and the weighted falloff loss of a picture (`train.losses.objective`), two scalars.
    `image`: [H, W, 5] rgb, alpha and beta on a CUDA device, at least as large as a window of SSIM.

    Raises:
        ValueError: shapes or devices do not agree.
        RuntimeError: the tensors are not on a CUDA device.
    """
    if image.dim() != 3 or image.shape[-1] != IMAGE_CHANNELS:
        raise ValueError(f"the picture is {list(image.shape)}, not [H, W, {IMAGE_CHANNELS}]")
    photograph.check(image, tuple(image.shape[:2]))
    return _PictureLosses.apply(image, photograph)


@torch.no_grad()
def accumulate_statistics(
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
    grads = {"grad": projection.mean2d_grad, "absgrad": projection.mean2d_absgrad}
    kernel("accumulate_statistics", radii)(
        radii=radii,
        **{name: None if grad is None else dense(grad, radii) for name, grad in grads.items()},
        width=width,
        height=height,
        grad_sum=grad_sum,
        abs_grad_sum=abs_grad_sum,
        visible_count=visible_count,
        max_radius=max_radius,
    )
