"""Directions over the sphere."""

import math

import torch
from torch import Tensor


def fibonacci_sphere(n: int) -> Tensor:
    """[n, 3] float32 unit vectors spread evenly over the sphere along a Fibonacci spiral."""
    i = torch.arange(n, dtype=torch.float64)
    z = 1.0 - (2.0 * i + 1.0) / n
    phi = i * math.pi * (3.0 - math.sqrt(5.0))
    r = torch.sqrt(1.0 - z * z)
    return torch.stack([r * torch.cos(phi), r * torch.sin(phi), z], -1).float()
