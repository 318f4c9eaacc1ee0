"""Memory that is left for surfels and texels to grow into."""

from __future__ import annotations

import psutil
import torch

from bitymi_ns.bundle.sizes import memory_limit
from bitymi_ns.ops.capacity import free_memory
from .processes import Processes

FILLED = 0.75
"""Fraction of the memory beyond which nothing grows; the rest is for copies while surfels are replaced, cached blocks
and other programs."""
# bytes of
PER_SURFEL = 3000  # parameters, gradients, Adam's averages, two states to go back to, copies of a densification
PER_TEXEL = 44  # colour, alpha and its gradient, share, and two states with colours in half precision
PER_TEXEL_SUM = 12  # gradients of colours on a GPU; the CPU adds them tile by tile
PER_PIXEL = 400  # pictures, gradients and maps of a view, and the ten views of multi-view scores
PER_FRAGMENT = 36  # list, gradients of weights and coordinates, order of the backward pass
FRAGMENTS = 45  # fragments per pixel of a view; 28 to 45 were measured


def available_memory(used: float) -> float:
    """Return the bytes that processes which use `used` may have in all, within the limit of a control group."""
    return min(psutil.virtual_memory().available + used, memory_limit())


def room_to_grow(device: torch.device, processes: Processes) -> float:
    """Return the bytes that a process may still take, below 0 if too many are in use; the same in all processes of a
    run, each of which calls it."""
    if device.type == "cuda":
        left = free_memory(device) - (1.0 - FILLED) * torch.cuda.mem_get_info(device)[1]
    else:
        used = torch.tensor(psutil.Process().memory_info().rss, dtype=torch.float64)
        processes.sum(used)
        left = (FILLED * available_memory(float(used)) - float(used)) / processes.count
    least = torch.tensor(-left, dtype=torch.float64)
    processes.maximum(least)
    return -float(least)


def view_bytes(pixels: float) -> float:
    """Estimate the bytes of a training view's lists and pictures."""
    return (PER_PIXEL + PER_FRAGMENT * FRAGMENTS) * pixels
