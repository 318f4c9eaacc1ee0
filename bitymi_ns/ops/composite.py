"""Weighted sums of any values of the fragments per pixel."""

from torch import Tensor

from .backend import on_same_device
from .trace import Fragments


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
