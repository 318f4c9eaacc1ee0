"""Visibility: fragments of a view and their blending weights."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from . import trace_cpu, trace_cuda
from .backend import check_shapes, cuda_backend, dense, function, kernel, on_same_device
from .capacity import TooManyFragments
from .constants import GEOM
from .fragment_list import Layout
from .project import Projection

__all__ = ["Fragments", "TooManyFragments", "select", "trace"]


@dataclass
class Fragments:
    """Blended (pixel, surfel) pairs of a view: by tile of 16 x 16 pixels, front to back within a tile.

    Attributes:
        weight: [F] blending weight w = sigma T, differentiable.
        uv: [2, F] surfel coordinates in scale units, |u|, |v| <= 3, differentiable.
        depth: [F] camera z of the hit (of the centre in the low-pass branch), differentiable.
        sigma: [F] effective opacity, negative in the low-pass branch.
        width, height: of the image, pixels.
        layout: index of the list.
        surfels: number N of rows of the projection.
    """

    weight: Tensor
    uv: Tensor
    depth: Tensor
    sigma: Tensor
    width: int
    height: int
    layout: Layout
    surfels: int

    def __len__(self) -> int:
        return self.weight.shape[0]

    @property
    def surfel(self) -> Tensor:
        """[F] int32 row of the surfel."""
        return self.layout.ids()["surfel"]

    @property
    def pixel(self) -> Tensor:
        """[F] int32, y * width + x."""
        return self.layout.ids()["pixel"]

    @property
    def arrays(self) -> dict[str, Tensor]:
        """The list without graph, by the names of `FragmentArrays` (csrc/ops/arguments.h); CPU kernels get surfels and
        pixels from the layout."""
        return _for_layout(self._numbers, self.layout)

    @property
    def view(self) -> dict[str, Any]:
        """Layout and image size, as keyword arguments of the kernels."""
        return {"layout": self.layout.handle, "width": self.width, "height": self.height}

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays."""
        return sum(array.nbytes for array in self._numbers.values()) + self.layout.nbytes

    @property
    def _numbers(self) -> dict[str, Tensor]:
        w, uv, depth = self.weight.detach(), self.uv.detach(), self.depth.detach()
        return {"weight": w, "uv": uv, "depth": depth, "sigma": self.sigma}

    def overdraw(self) -> Tensor:
        """Count the blended surfels per pixel: [H, W, 1] int32."""
        count = torch.bincount(self.pixel, minlength=self.width * self.height)
        return count.to(torch.int32).view(self.height, self.width, 1)

    def masked_counts(self, mask: Tensor) -> Tensor:
        """Count the fragments of each surfel on the pixels of a mask [H * W] bool (FastGS's per-view importance): [N]
        int32. Raises ValueError: the mask has another number of pixels or lies on another device."""
        check_mask(mask, self.weight, self.width, self.height)
        return count_masked(self.view, mask, self.surfels)


def check_mask(mask: Tensor, like: Tensor, width: int, height: int) -> None:
    """Raise a ValueError unless a mask has a view's number of pixels and lies on the device of `like`."""
    on_same_device(like, mask=mask)
    if mask.numel() != width * height:
        raise ValueError(f"the mask has {mask.numel()} pixels, the view {width * height}")


def count_masked(view: dict[str, Any], mask: Tensor, n: int) -> Tensor:
    """Count as `Fragments.masked_counts`, for the list with the arguments `view` (`Fragments.view`): [n] int32."""
    counts = torch.zeros(n, dtype=torch.int32, device=mask.device)
    flat = mask.reshape(-1).to(torch.uint8).contiguous()
    function("masked_counts", mask.device)(**view, mask=flat, counts=counts)
    return counts


def _for_layout(numbers: dict[str, Tensor], layout: Layout) -> dict[str, Tensor]:
    return numbers | layout.ids() if cuda_backend(numbers["weight"].device) else numbers


class _Trace(torch.autograd.Function):
    @staticmethod
    def forward(ctx, geom, texel_alpha, projection, rim, most):
        find_fragments = trace_cuda.find_fragments if cuda_backend(geom.device) else trace_cpu.find_fragments
        layout, listed = find_fragments(geom.detach(), projection, most)
        weight, uv, depth, sigma = (listed[name] for name in ("weight", "uv", "depth", "sigma"))
        arrays = _for_layout(listed, layout)
        ctx.save_for_backward(geom, *arrays.values())
        ctx.projection, ctx.rim, ctx.layout, ctx.names = projection, rim, layout, tuple(arrays)
        ctx.mark_non_differentiable(sigma)
        ctx.set_materialize_grads(False)
        return weight, uv, depth, sigma, layout

    @staticmethod
    def backward(ctx, dweight, duv, ddepth, *_):
        geom, *arrays = ctx.saved_tensors
        projection, geom = ctx.projection, geom.detach()
        grads = {"dweight": dweight, "duv": duv, "ddepth": ddepth}
        grads = {name: None if g is None else dense(g, geom) for name, g in grads.items()}
        dgeom, absgrad = torch.empty_like(geom), geom.new_empty(geom.shape[0], 2)
        of_alpha = projection.alpha_arrays
        if of_alpha and ctx.needs_input_grad[1]:
            of_alpha["dtexel_alpha"] = torch.empty_like(of_alpha["texel_alpha"])
        dalpha = of_alpha.get("dtexel_alpha")
        work = trace_cuda.backward_memory(geom, ctx.layout, dalpha) if cuda_backend(geom.device) else {}
        kernel("trace_backward", geom)(
            **projection.view(geom),
            **dict(zip(ctx.names, arrays, strict=True)),
            **grads,
            **of_alpha,
            **work,
            rim=ctx.rim,
            layout=ctx.layout.handle,
            dgeom=dgeom,
            absgrad=absgrad,
        )
        projection.take_mean2d(dgeom[:, :2], absgrad)
        return dgeom, dalpha, None, None, None


def trace(projection: Projection, rim: float = 1e-3, most: int | None = None) -> Fragments:
    """Find the fragments of a view: for each pixel the blended surfels, front to back by centre depth.

    sigma = min(0.99, o max((1 - (u^2 + v^2)/9)+^beta, exp(-d^2))) >= 1/255. A pixel ends before the surfel that would
    reduce its transmittance below 1e-4. Alpha texels of the projection multiply sigma (`TexelAlpha`); the last bit of v
    marks these fragments.

    The backward pass fills `projection.mean2d_grad` and `projection.mean2d_absgrad`.

    Args:
        projection: from `project`; geom [N, 16].
        rim: lower bound of 1 - x in the derivative of the Beta kernel, which diverges at the rim for beta < 1.
        most: largest number of fragments; None: no limit; 0: `trace_cpu.MOST` on the CPU, on a CUDA device the number
            whose list, shading, blending and backward pass fit into free memory.

    Raises:
        ValueError: the projection has wrong rows or a photo_pixel other than 1, or its alpha tiles are of other
            surfels.
        TooManyFragments: there are more, or their list does not fit into the memory of the CUDA device.
    """
    if projection.photo_pixel != 1.0:
        raise ValueError("surfels in a view of another size than the photographs are drawn by the baked renderer alone")
    if projection.geom.shape[1] != GEOM:
        raise ValueError(f"geom must have {GEOM} columns, not {projection.geom.shape[1]}")
    texel_alpha = None if projection.alpha is None else projection.alpha.values
    weight, uv, depth, sigma, layout = _Trace.apply(projection.geom, texel_alpha, projection, rim, most)
    camera, n = projection.camera, len(projection.geom)
    return Fragments(weight, uv, depth, sigma, camera.width, camera.height, layout, n)


def select(fragments: Fragments, keep: Tensor) -> Fragments:
    """Select fragments of a view as a new list, without the graph.

    Args:
        fragments: F fragments.
        keep: [F] bool.

    Raises:
        ValueError: `keep` has another length or lies on another device.
    """
    on_same_device(fragments.weight, keep=keep)
    check_shapes(keep=(keep, fragments.weight.shape))
    by = trace_cuda if cuda_backend(keep.device) else trace_cpu
    width, height = fragments.width, fragments.height
    layout, listed = by.select(fragments.layout, fragments._numbers, keep, width, height)
    return Fragments(**listed, width=width, height=height, layout=layout, surfels=fragments.surfels)
