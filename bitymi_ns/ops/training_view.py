"""A training view with its losses by CUDA kernels, as one differentiable function (csrc/cuda/training_view.h).

The results are those of `project`, `view_color`, `rasterize_image`, `train.views.shown` and
`train.losses.objective`. Called one by one, these take the host several times as long as the GPU.
"""

from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from .backend import dense, kernel, kernel_class, module, on_device, on_same_device, stream_of, workspace
from .bin_cuda import check_pair_count
from .blend import checked_texels
from .constants import FRAME, GEOM
from .parameters import GEOMETRY, Tensors
from .project import CameraLike, Projection, checked_geometry, geometry_of, rigid_gradient
from .texel import TexelAlpha, TexelDescent, TexelTiles, gradient_or_step
from .view_color import check_view_color, lettered
from .view_kinds import entry_of


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


@dataclass(frozen=True)
class ComparedView:
    """A drawn view, compared with its photograph.

    Attributes:
        photometric, falloff: the weighted losses, scalars.
        projection: projected surfels.
    """

    photometric: Tensor
    falloff: Tensor
    projection: Projection


@dataclass
class _Drawing:
    """Arguments of `_TrainingView` without gradients, and the projection that it makes."""

    camera: CameraLike
    photograph: PhotographTarget
    kind: str
    near: float
    rim: float
    tiles: TexelTiles
    bound: float
    moves: bool
    descent: TexelDescent | None
    projection: Projection = field(init=False)


class _TrainingView(torch.autograd.Function):
    @staticmethod
    def forward(ctx, drawing, viewmat, center, correction, texels, alpha, *surfels):
        camera, means = drawing.camera, dense(surfels[0], surfels[0])
        n, device, entry = len(means), means.device, entry_of(drawing.kind)
        inputs = {name: dense(t, means) for name, t in zip(GEOMETRY, surfels, strict=False)}
        colors = [dense(t, means) for t in surfels[len(GEOMETRY) :]]
        textured = {**drawing.tiles.arrays, "texels": dense(texels, means)}
        if alpha is not None:
            textured |= {"texel_alpha": dense(alpha, means), "alpha_bound": drawing.bound}
        size = {"width": camera.width, "height": camera.height}
        geom, frames, radii = (means.new_empty(n, k) for k in (GEOM, FRAME, 2))
        broken = torch.empty(1, dtype=torch.int32, device=device)
        photometric, falloff = means.new_empty(2).unbind()
        view = kernel_class("TrainingView", means)(
            **inputs,
            **lettered(colors),
            **textured,
            **drawing.photograph.arguments(means, correction),
            **size,
            viewmat=dense(viewmat, means),
            K=dense(camera.K, means),
            center=dense(center, center.double()).to(device),
            near=drawing.near,
            rim=drawing.rim,
            bound=drawing.bound,
            moves=int(drawing.moves),
            kind=drawing.kind,
            terms=entry.terms(dict(zip(entry.names, colors, strict=True))),
            geom=geom,
            frames=frames,
            radii=radii,
            broken=broken,
            photometric=photometric,
            falloff=falloff,
            memory=workspace("training_view", means, n=n, **size),
        )
        with on_device(device):
            pairs = view.count(stream=stream_of(device))
            check_pair_count(pairs, camera)
            wide = means.dtype == torch.float64
            needed = module(device).training_pairs_workspace(pairs, **size, alpha=alpha is not None, wide=wide)
        ctx.drawn = {"view": view, "pairs": pairs}
        ctx.drawn["pair_memory"] = torch.empty(needed, dtype=torch.uint8, device=device)
        kernel("draw_view", means)(**ctx.drawn)
        ctx.save_for_backward(viewmat, correction, texels, alpha, *inputs.values(), *colors)
        drawing.projection = Projection(geom, frames, radii, camera, drawing.near, broken)
        ctx.drawing = drawing
        return photometric, falloff

    @staticmethod
    def backward(ctx, dphotometric, dfalloff):
        viewmat, correction, texels, alpha, *surfels = ctx.saved_tensors
        drawn = ctx.drawn
        del ctx.drawn  # frees its memory, as losses may outlive the step
        moves_camera, _, corrects, has_texels, has_alpha = ctx.needs_input_grad[1:6]
        means, gradients = surfels[0], [torch.empty_like(t) for t in surfels]
        geometry, colors = gradients[: len(GEOMETRY)], gradients[len(GEOMETRY) :]
        dtexels, step = gradient_or_step(texels, has_texels, ctx.drawing.descent)
        dalpha = torch.empty_like(alpha) if has_alpha else None
        if "moved" in step or dalpha is not None:
            step["texel_work"] = means.new_empty(4 * len(texels))
        dcorrection = means.new_empty(correction.shape) if corrects else None
        dgeom, absgrad = means.new_empty(len(means), GEOM), means.new_empty(len(means), 2)
        dmeans_color = torch.empty_like(means)
        kernel("differentiate_view", means)(
            **drawn,
            **step,
            **{f"d{name}": gradient for name, gradient in zip(GEOMETRY, geometry, strict=True)},
            **lettered(colors, "d"),
            dphotometric=dense(dphotometric, means),
            dfalloff=dense(dfalloff, means),
            dtexel_alpha=dalpha,
            dcorrection=dcorrection,
            dgeom=dgeom,
            absgrad=absgrad,
            dmeans_color=dmeans_color,
        )
        ctx.drawing.projection.take_mean2d(dgeom[:, :2], absgrad)
        dviewmat = dcenter = None
        if moves_camera:
            dviewmat = rigid_gradient(means, surfels[1], geometry[0], geometry[1], viewmat)
            dcenter = -dmeans_color.sum(0, dtype=torch.float64)
        geometry[0] += dmeans_color
        return None, dviewmat, dcenter, dcorrection, dtexels, dalpha, *gradients


def training_view(
    kind: str,
    surfels: Tensors,
    camera: CameraLike,
    photograph: PhotographTarget,
    correction: Tensor | None = None,
    texels: Tensor | None = None,
    tiles: TexelTiles | None = None,
    bound: float = 0.0,
    move_surfels: bool = True,
    descent: TexelDescent | None = None,
    alpha: TexelAlpha | None = None,
    near: float = 0.2,
    rim: float = 1e-3,
) -> ComparedView:
    """Draw a view over the photograph's background, correct its exposure, and compute the losses.

    Differentiable in the surfels, the camera's pose (see `project`), the correction, texels and alpha texels. The
    backward pass fills `mean2d_grad` and `mean2d_absgrad` of the projection. Only sums over texels depend on the
    thread order.

    Args:
        kind: of the view colours, see `view_color`.
        surfels: parameters by name: `GEOMETRY` and those of the view colours.
        photograph: of the camera's size, at least as large as a window of SSIM.
        correction: of the photograph, [3] or [3, 4], see `train.views.View`; None: none.
        texels, tiles, bound, move_surfels, descent: as in `blended_image`.
        alpha: alpha texels, of the same tiles; None: opaque.
        camera, near: as in `project`.
        rim: as in `trace`.

    Raises:
        RuntimeError: 2^31 pairs of surfel and tile or more, or not a CUDA device.
        ValueError: as `project`, `view_color`, `PhotographTarget.check` and `blended_image`.
    """
    geometry = checked_geometry(geometry_of(surfels), camera)
    means = geometry[0]
    check_view_color(kind, surfels, len(means))
    photograph.check(means, (camera.height, camera.width))
    texels, tiles, moves, descent = checked_texels(
        means, len(means), means, texels, tiles, move_surfels, descent, alpha
    )
    surfel_inputs = (*geometry, *entry_of(kind).of(surfels))
    if descent is not None and not means.requires_grad:
        surfel_inputs = (means.detach().requires_grad_(), *surfel_inputs[1:])  # see `rasterize_image`
    drawing = _Drawing(camera, photograph, kind, near, rim, tiles, bound, moves, descent)
    values = None if alpha is None else alpha.values
    losses = _TrainingView.apply(
        drawing, camera.viewmat, camera.exact_center, correction, texels, values, *surfel_inputs
    )
    return ComparedView(*losses, projection=drawing.projection)
