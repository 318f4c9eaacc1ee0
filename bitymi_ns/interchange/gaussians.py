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

_REST = tuple(3 * (n * n - 1) for n in range(1, 5))
"""How many columns f_rest has, with harmonics up to degree 0, 1, 2 and 3."""
_UNIT_LENGTH = 1e-6
"""Rotations that differ by no more from it are left as they are."""

_OPAQUE = 30.0
"""In place of an infinite logit; its sigmoid is 1 in single precision."""


@dataclass(frozen=True)
class Gaussians:
    """N Gaussians, float32.

    Attributes:
        means: [N, 3].
        quats: [N, 4] wxyz, unit.
        log_scales: [N, 3] natural logarithms of the standard deviations along the axes.
        opacity_logits: [N].
        harmonics: [N, 16, 3]; the colour is max(sum of harmonics Y(d) + 0.5, 0), d from the camera to the mean.
    """

    means: Tensor
    quats: Tensor
    log_scales: Tensor
    opacity_logits: Tensor
    harmonics: Tensor

    def __len__(self) -> int:
        return len(self.means)

    def moved(self, to: Similarity) -> Gaussians:
        """The same in another frame."""
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
    `looks.fit_looks`.

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
    """Writes the PLY file that 3DGS writes: f_rest has 15 coefficients of red, then of green, then of blue."""
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


def read_gaussians(path: str | Path) -> Gaussians:
    """Reads a PLY file of 3DGS, of `write_gaussians` or of other programs: its harmonics may end at any degree, normals
    may be left out, and rotations may have any length but 0. Opacities of 0 and 1 have infinite logits, which programs
    that store opacities in bytes do write; they become -30 and 30.

    Raises:
        ply.PlyError: it is another kind of PLY, a column is missing, or another value is not finite.
    """
    columns = ply.parse_ply(Path(path).read_bytes(), unbounded=_NAMES["opacity_logits"])["vertex"]
    of_file = {**_NAMES, "rest": tuple(name for name in _NAMES["rest"] if name in columns)}
    del of_file["normals"]
    missing = [name for names in of_file.values() for name in names if name not in columns]
    if len(of_file["rest"]) not in _REST:
        missing.append(_NAMES["rest"][len(of_file["rest"])])
    if missing:
        raise ply.PlyError(f"the column {missing[0]} is missing")
    count = len(columns["x"])
    found = {
        group: torch.from_numpy(np.stack([columns[n] for n in names], 1)) if names else torch.zeros(count, 0)
        for group, names in of_file.items()
    }
    coefficients = torch.zeros(count, harmonics.TERMS, 3)
    coefficients[:, 0] = found["dc"]
    rest = found["rest"].unflatten(1, (3, len(of_file["rest"]) // 3)).transpose(1, 2)
    coefficients[:, 1 : 1 + rest.shape[1]] = rest
    length = found["quats"].norm(dim=1, keepdim=True)
    quats = torch.where((length - 1).abs() > _UNIT_LENGTH, found["quats"] / length, found["quats"])
    logits = found["opacity_logits"][:, 0].nan_to_num(posinf=_OPAQUE, neginf=-_OPAQUE)
    return Gaussians(found["means"], quats, found["log_scales"], logits, coefficients)
