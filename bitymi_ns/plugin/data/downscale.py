"""Large photographs: reduced as they are read, their cameras with them."""

from __future__ import annotations

import copy
import dataclasses
from typing import NamedTuple

import torch
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs

from bitymi_ns.plugin.console import fail, say
from bitymi_ns.plugin.data.lens import Lens

LONGEST_SIDE = 1600
"""Pixels along the longer side of a photograph that is trained on; what papers on such captures use."""

Size = tuple[int, int]


class Reduction(NamedTuple):
    """What becomes of a large photograph.

    Attributes:
        stored: width and height in its file.
        size: width and height that it is reduced to.
    """

    stored: Size
    size: Size


def reduced_size(size: Size, longest: int) -> Size:
    """Width and height of a photograph of which the longer side is at most `longest` pixels, in the same proportion."""
    factor = min(1.0, longest / max(size))
    return max(1, round(size[0] * factor)), max(1, round(size[1] * factor))


def reduce_views(outputs: DataparserOutputs, longest: int, announce: bool) -> DataparserOutputs:
    """The views with cameras of photographs that are no longer than that.

    `metadata["reductions"]` has the `Reduction` of each view, None = it is not reduced; views with a lens have a
    smaller lens instead.

    Args:
        outputs: of a parser.
        longest: side in pixels; 0 = photographs are used as they are.
        announce: say it where photographs are reduced.

    Raises:
        InputError: `longest` is negative.
    """
    if longest < 0:
        fail(
            f"--pipeline.datamanager.longest-side is {longest}: give a number of pixels, or 0 to use photographs as "
            "they are."
        )
    cameras = outputs.cameras
    sizes = [(int(w), int(h)) for w, h in zip(cameras.width.flatten(), cameras.height.flatten(), strict=True)]
    large = [i for i, size in enumerate(sizes) if longest and max(size) > longest]
    if not large:
        return outputs
    cameras, metadata = copy.deepcopy(cameras), dict(outputs.metadata)
    lenses: list[Lens] | None = metadata.get("lenses")
    lenses = None if lenses is None else list(lenses)
    reductions: list[Reduction | None] = [None] * len(sizes)
    smaller: dict[Lens, Lens] = {}
    for i in large:
        if lenses is not None:
            if lenses[i] not in smaller:
                smaller[lenses[i]] = lenses[i].reduced(longest / max(sizes[i]))
            lenses[i] = smaller[lenses[i]]
            new = lenses[i].pinhole
            values = (new.fx, new.fy, new.cx, new.cy, new.width, new.height)
        else:
            width, height = reduced_size(sizes[i], longest)
            reductions[i] = Reduction(sizes[i], (width, height))
            x, y = width / sizes[i][0], height / sizes[i][1]
            values = (cameras.fx[i] * x, cameras.fy[i] * y, cameras.cx[i] * x, cameras.cy[i] * y, width, height)
        names = ("fx", "fy", "cx", "cy", "width", "height")
        for name, value in zip(names, values, strict=True):
            column = getattr(cameras, name)
            column[i] = torch.as_tensor(value, dtype=column.dtype)
    metadata |= {"reductions": reductions} if lenses is None else {"lenses": lenses}
    if announce:
        width, height = max((sizes[i] for i in large), key=max)
        say(
            f"{len(large)} of {len(sizes)} training photographs have more than {longest} pixels along a side (up to "
            f"{width} x {height}): they are reduced to that as they are read. --pipeline.datamanager.longest-side 0 "
            "uses them as they are."
        )
    return dataclasses.replace(outputs, cameras=cameras, metadata=metadata)
