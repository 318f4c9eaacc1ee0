"""Measure the memory that is left for a scene to grow into, near whose end surfels and texels stop growing."""

from __future__ import annotations

import psutil
import torch

from bitymi_ns.bundle.sizes import memory_limit
from bitymi_ns.ops.capacity import free_memory
from .processes import Processes

FILLED = 0.75
"""Fraction of the memory beyond which nothing grows. Copies while surfels are replaced, freed blocks that are kept for
the next view, and other programs have the rest."""
PER_SURFEL = 3000  # bytes: parameters, gradients, Adam's averages, two states to go back to, copies of a densification
PER_TEXEL = 44  # bytes: colour, alpha and its gradient, share, and two states with colours in half precision
PER_TEXEL_SUM = 12  # bytes more on a GPU: the gradient of colours, which the CPU adds tile by tile
PER_PIXEL = 400  # bytes of a view: pictures, gradients and maps, and the ten views of multi-view scores
PER_FRAGMENT = 36  # bytes: list, gradients of weights and coordinates, order of the backward pass
FRAGMENTS = 45  # fragments per pixel of a view; 28 to 45 were measured


def available_memory(used: float) -> float:
    """Return the bytes that processes which use `used` bytes may have in all, within the limit of a control group."""
    return min(psutil.virtual_memory().available + used, memory_limit())


def room_to_grow(device: torch.device, processes: Processes) -> float:
    """Return the bytes that a process may take beyond those in use, the same in all processes of a run; below 0 if too
    many are in use. Every process calls it."""
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
