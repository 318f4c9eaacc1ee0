"""Baked scene as 3D Gaussians."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from bitymi_ns import ply
from bitymi_ns.ops.constants import ALPHA_MAX, SUPPORT
from bitymi_ns.scene.baked import BakedScene
from bitymi_ns.scene.tile_sizes import kernel_parameters
from bitymi_ns.train.init import rotate_in_plane, tangents
from . import harmonics
from .frame import Similarity
from .quads import fetch_texels

FLAT_LOG_SCALE = -16.0
"""Log of the Gaussians' third scale, in the scene's frame."""
GRID = 24  # grid points per axis of a kernel, to sum moments under alpha texels
LEAST_OPACITY = 1e-4  # of a surfel that alpha texels cut away
HARD_BETA = 0.5658
"""Exponent below which a disc approximates the kernel better than a Gaussian, in squared error."""
FLAT = "SplatRenderMode: 2dgs"  # comment of a PLY file whose Gaussians have two scales, as Brush writes it
_NAMES = {
    "means": ("x", "y", "z"),
    "normals": ("nx", "ny", "nz"),
    "dc": tuple(f"f_dc_{i}" for i in range(3)),
    "rest": tuple(f"f_rest_{i}" for i in range(3 * (harmonics.TERMS - 1))),
    "opacity_logits": ("opacity",),
    "log_scales": tuple(f"scale_{i}" for i in range(3)),
    "quats": tuple(f"rot_{i}" for i in range(4)),
}
"""Columns of 3DGS's PLY file in order; f_rest has all of red, then green, then blue."""


@dataclass(frozen=True)
class Gaussians:
    """N Gaussians, float32."""

    means: Tensor  # [N, 3]
    quats: Tensor  # [N, 4] wxyz, unit
    log_scales: Tensor  # [N, 3] natural logarithms of the standard deviations along the axes
    opacity_logits: Tensor  # [N]
    harmonics: Tensor  # [N, 16, 3]; the colour is max(sum of harmonics Y(d) + 0.5, 0), d from the camera to the mean
    hard: Tensor  # [N] bool, better approximated by a disc of constant opacity and radius two standard deviations

    def __len__(self) -> int:
        return len(self.means)

    def __getitem__(self, rows: Tensor) -> Gaussians:
        return Gaussians(**{name: value[rows] for name, value in vars(self).items()})

    def moved(self, to: Similarity) -> Gaussians:
        coefficients = harmonics.rotation_of(to.turn.T) @ self.harmonics.double()
        return replace(
            self,
            means=to.points(self.means),
            quats=to.rotations(self.quats).to(self.quats),
            log_scales=self.log_scales + float(np.log(to.scale)),
            harmonics=coefficients.to(self.harmonics),
        )


@torch.no_grad()
def gaussians_of(scene: BakedScene, coefficients: Tensor) -> Gaussians:
    """Convert the surfels of a scene on the CPU to flat Gaussians. `coefficients`: [N, 16, 3] of `fit_colors`.

    Gaussians have the opacities and second moments of the surfels' kernels: under (1 - r^2 / R^2)^beta on the disc of
    radius R the mean of u^2 is R^2 / (2 (beta + 2)). With alpha texels m they have centre and covariance of
    f = min(0.99, o k m), and their opacity is multiplied by (f-weighted mean of f) / ((o k)-weighted mean of o k).
    """
    surfels = scene.surfels
    means = surfels["means"].float()
    quats = torch.nn.functional.normalize(surfels["quats"].float(), dim=1)
    variance = SUPPORT**2 / (2.0 * (kernel_parameters(surfels)[1].double() + 2.0))
    tangent = surfels["log_scales"].double() + 0.5 * variance.log()[:, None]
    flat = tangent.new_full((len(tangent), 1), FLAT_LOG_SCALE)
    opacity = torch.sigmoid(surfels["opacity_logits"].double()).clamp(max=ALPHA_MAX)
    if scene.alpha_scale or scene.mean_alpha is not None:
        strength, center, covariance = _moments(scene)
        scales = surfels["log_scales"].double().exp()
        means = means + (tangents(quats).double() @ (scales * center)[..., None])[..., 0].float()
        spread = tangent.exp()
        values, axes = torch.linalg.eigh(spread[:, :, None] * covariance * spread[:, None])
        tangent = 0.5 * values.clamp(min=torch.finfo(torch.float64).tiny).log()
        quats = rotate_in_plane(quats, torch.atan2(axes[:, 1, 0], axes[:, 0, 0]).float())
        opacity = (opacity * strength).clamp(LEAST_OPACITY, ALPHA_MAX)
    return Gaussians(
        means,
        quats,
        torch.cat([tangent, flat], dim=1).float(),
        torch.logit(opacity).float(),
        coefficients.float(),
        kernel_parameters(surfels)[1] < HARD_BETA,
    )


def _moments(scene: BakedScene, chunk: int = 1 << 20) -> tuple[Tensor, Tensor, Tensor]:
    """Compute the moments of f = min(0.99, o k m), float64: its f-weighted mean [N], relative to the (o k)-weighted
    mean of o k; its centre [N, 2] in scale units; and its covariance [N, 2, 2], relative to the variance of k."""
    n, step = len(scene), 2.0 * SUPPORT / GRID
    opacity, beta = kernel_parameters(scene.surfels)
    constant = torch.ones(n) if scene.mean_alpha is None else scene.mean_alpha
    extent = torch.full((n,), float(SUPPORT)) if scene.extent is None else scene.extent
    axis = step * (torch.arange(GRID) + 0.5) - SUPPORT
    at = torch.stack(torch.meshgrid(axis, axis, indexing="xy"), -1).view(-1, 2).double()  # v, then u
    rest = (1.0 - at.square().sum(1) / SUPPORT**2).clamp(min=0.0)
    strength, center = at.new_zeros(n), at.new_zeros(n, 2)
    covariance = at.new_zeros(n, 2, 2)
    for rows in torch.arange(n).split(max(1, chunk // GRID**2)):
        m = constant[rows, None].double().expand(-1, len(at)).clone()
        tiled = torch.nonzero(scene.tiles[rows, 3] > 0).squeeze(1)
        if scene.atlas is not None and scene.alpha_scale and len(tiled):
            own = rows[tiled]
            of_tile = axis / extent[own, None]
            m[tiled] = fetch_texels(scene, scene.tiles[own].long(), of_tile, of_tile)[..., 3].flatten(1).double()
        kernel = opacity[rows, None].double() * torch.where(rest > 0, rest ** beta[rows, None].double(), 0.0)
        cut = (kernel * m).clamp(max=ALPHA_MAX)
        mass, uncut = (f / f.sum(1, keepdim=True).clamp(min=1e-12) for f in (cut, kernel))
        strength[rows] = (mass * cut).sum(1) / (uncut * kernel).sum(1).clamp(min=1e-12)
        center[rows] = mass @ at
        least = step**2 / 12.0 * torch.eye(2, dtype=torch.float64)  # covariance within a grid cell
        second = torch.einsum("np,pi,pj->nij", mass, at, at) - center[rows, :, None] * center[rows, None] + least
        whole = uncut @ at[:, 0].square() + step**2 / 12.0
        covariance[rows] = second / whole[:, None, None]
    return strength, center, covariance


def write_gaussians(path: str | Path, gaussians: Gaussians, comments: Sequence[str] = (), flat: bool = False) -> None:
    """Write a 3DGS PLY file; `flat`: without the third scales, and with the comment `FLAT`."""
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
    if flat:
        del columns["scale_2"]
    ply.write_ply(path, columns, [*([FLAT] if flat else []), *comments])
