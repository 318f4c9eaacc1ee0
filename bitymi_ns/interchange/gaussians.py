"""A baked scene as 3D Gaussians: a preview for the programs that draw Gaussian splats."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from bitymi_ns.bundle import ply
from bitymi_ns.interchange import harmonics
from bitymi_ns.interchange.frame import Similarity
from bitymi_ns.ops.constants import ALPHA_MAX, SUPPORT
from bitymi_ns.scene.baked import BakedScene
from bitymi_ns.scene.tile_sizes import kernel_parameters

FLAT_LOG_SCALE = -16.0
"""Third scale of the Gaussians in the scene's frame, whose cameras lie within a unit of the origin."""
_NAMES = {
    "means": ("x", "y", "z"),
    "normals": ("nx", "ny", "nz"),
    "dc": tuple(f"f_dc_{i}" for i in range(3)),
    "rest": tuple(f"f_rest_{i}" for i in range(3 * (harmonics.TERMS - 1))),
    "opacity_logits": ("opacity",),
    "log_scales": tuple(f"scale_{i}" for i in range(3)),
    "quats": tuple(f"rot_{i}" for i in range(4)),
}
"""Columns of the PLY file of 3DGS, in its order; f_rest has all of red, then green, then blue."""


@dataclass(frozen=True)
class Gaussians:
    """N Gaussians, float32."""

    means: Tensor  # [N, 3]
    quats: Tensor  # [N, 4] wxyz, unit
    log_scales: Tensor  # [N, 3] natural logarithms of the standard deviations along the axes
    opacity_logits: Tensor  # [N]
    harmonics: Tensor  # [N, 16, 3]; the colour is max(sum of harmonics Y(d) + 0.5, 0), d from the camera to the mean

    def __len__(self) -> int:
        return len(self.means)

    def moved(self, to: Similarity) -> Gaussians:
        """Transform to another frame."""
        coefficients = harmonics.turned(to.turn.T) @ self.harmonics.double()
        return replace(
            self,
            means=to.points(self.means),
            quats=to.rotations(self.quats).to(self.quats),
            log_scales=self.log_scales + float(np.log(to.scale)),
            harmonics=coefficients.to(self.harmonics),
        )


@torch.no_grad()
def gaussians_of(scene: BakedScene, coefficients: Tensor) -> Gaussians:
    """The Gaussians that stand for the surfels of a scene on the CPU, flat, with the colours [N, 16, 3] of
    `surfel_colors.fit_colors`.

    They have the surfels' opacities and the second moments of their kernels: of (1 - r^2 / R^2)^beta on the disc of
    radius R the mean of u^2 is R^2 / (2 (beta + 2)).
    """
    surfels = scene.surfels
    variance = SUPPORT**2 / (2.0 * (kernel_parameters(surfels)[1].double() + 2.0))
    tangent = surfels["log_scales"].double() + 0.5 * variance.log()[:, None]
    flat = tangent.new_full((len(tangent), 1), FLAT_LOG_SCALE)
    opacity = torch.sigmoid(surfels["opacity_logits"].double()).clamp(max=ALPHA_MAX)
    return Gaussians(
        surfels["means"].float(),
        torch.nn.functional.normalize(surfels["quats"].float(), dim=1),
        torch.cat([tangent, flat], dim=1).float(),
        torch.logit(opacity).float(),
        coefficients.float(),
    )


def write_gaussians(path: str | Path, gaussians: Gaussians) -> None:
    """Write the PLY file that 3DGS writes: f_rest has 15 coefficients of red, then of green, then of blue."""
    values = {
        "means": gaussians.means,
        "normals": torch.zeros_like(gaussians.means),
        "dc": gaussians.harmonics[:, 0],
        "rest": gaussians.harmonics[:, 1:].transpose(1, 2).flatten(1),
        "opacity_logits": gaussians.opacity_logits[:, None],
        "log_scales": gaussians.log_scales,
        "quats": gaussians.quats,
    }
    columns = {name: values[group][:, i].numpy() for group, names in _NAMES.items() for i, name in enumerate(names)}
    ply.write_ply(path, columns)
