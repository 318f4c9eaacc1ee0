"""Compositing: weighted sums of the fragments per pixel."""

import torch
from torch import Tensor

from .backend import check_shapes, cuda_backend, dense, kernel, on_same_device
from .constants import IMAGE_CHANNELS, MAP_CHANNELS
from .project import Projection
from .trace import Fragments


class _CompositeImage(torch.autograd.Function):
    @staticmethod
    def forward(ctx, weight, depth, geom, colors, fragments, maps):
        arrays = fragments.arrays_for_layout
        g, c = dense(geom, geom), dense(colors, geom)
        image = geom.new_empty(fragments.width * fragments.height, MAP_CHANNELS if maps else IMAGE_CHANNELS)
        ctx.view = {"maps": maps, **fragments.view}
        kernel("composite_forward", geom)(**ctx.view, **arrays, geom=g, colors=c, image=image)
        ctx.save_for_backward(g, c, *arrays.values())
        ctx.names = tuple(arrays)
        return image

    @staticmethod
    def backward(ctx, dimage):
        geom, colors, *rest = ctx.saved_tensors
        arrays, maps = dict(zip(ctx.names, rest, strict=True)), ctx.view["maps"]
        out = {"dweight": torch.empty_like(arrays["weight"])}
        out |= {"dcolors": torch.empty_like(colors), "dgeom": torch.empty_like(geom)}
        ddepth = torch.empty_like(arrays["depth"]) if maps else None
        work = {}
        if cuda_backend(geom.device):  # what a pair of surfel and tile adds to its surfel
            work["partial"] = geom.new_empty(ctx.view["layout"].pairs, 4 if maps else 1)
        inputs = {"geom": geom, "colors": colors, "dimage": dense(dimage, geom)}
        kernel("composite_backward", geom)(**ctx.view, **arrays, **inputs, **work, **out, ddepth=ddepth)
        return out["dweight"], ddepth, out["dgeom"], out["dcolors"], None, None


def check_projection(fragments: Fragments, projection: Projection) -> None:
    """Refuses a projection of other surfels than the fragments', or on another device.

    Raises:
        ValueError: says what it is.
    """
    on_same_device(fragments.weight, geom=projection.geom)
    if len(projection.geom) != fragments.surfels:
        raise ValueError(f"the fragments are those of {fragments.surfels} surfels, not of {len(projection.geom)}")


def composite_image(fragments: Fragments, projection: Projection, colors: Tensor, maps: bool = False) -> Tensor:
    """Sums of w times colour, 1 and beta, and with maps also depth and normal, per pixel.

    Args:
        fragments: F fragments of an H x W view.
        colors: [F, 3].
        maps: add depth and normal.

    Returns:
        [H * W, 5] rgb, alpha, sum w beta; with maps [H * W, 9]: also sum w z (camera z) and sum w n (unit normals in
        the camera frame, OpenCV axes, facing the camera). Nothing is divided by alpha; the background is not included.

    Raises:
        ValueError: tensors on different devices, or colours of a wrong shape.
    """
    on_same_device(fragments.weight, colors=colors)
    check_projection(fragments, projection)
    check_shapes(colors=(colors, (len(fragments), 3)))
    return _CompositeImage.apply(fragments.weight, fragments.depth, projection.geom, colors, fragments, maps)


def soft_overdraw(fragments: Fragments, half: float) -> Tensor:
    """A count of a pixel's fragments with a gradient: sum of w / (w + half), [H * W].

    Args:
        fragments: of an H x W view.
        half: the weight that counts one half, above 0. A fragment far heavier counts 1, one far lighter w / half.

    Raises:
        ValueError: half is not above 0.
    """
    if not half > 0.0:
        raise ValueError(f"the weight that counts one half must be above 0, not {half}")
    count = fragments.weight / (fragments.weight + half)
    return count.new_zeros(fragments.width * fragments.height).index_add(0, fragments.pixel, count)


def composite(fragments: Fragments, values: Tensor) -> Tensor:
    """Sums of w times any values [F, C] per pixel: [H * W, C]."""
    if values.dim() != 2 or len(values) != len(fragments):
        raise ValueError(f"values must have a row for each of the {len(fragments)} fragments, not {list(values.shape)}")
    on_same_device(fragments.weight, values=values)
    out = values.new_zeros(fragments.width * fragments.height, values.shape[1])
    return out.index_add(0, fragments.pixel, fragments.weight[:, None] * values)
