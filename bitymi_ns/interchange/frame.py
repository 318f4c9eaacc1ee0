"""Transforms from the scene's frame to the capture's."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from bitymi_ns.bundle.manifest import BundleError
from bitymi_ns.bundle.world import WorldEntry

FARTHEST = 1_000.0
"""Distance in scene units beyond which positions get an origin: float32 is off by 1/30,000."""
_UP = (0.0, 0.0, 1.0)  # nerfstudio's, if the bundle states none
_TOLERANCE = 1e-4  # tolerance of a stored rotation's orthogonality


@dataclass(frozen=True)
class Similarity:
    """Similarity x_new = scale * (turn @ x) + shift + origin. Positions are stored relative to the origin."""

    turn: Tensor  # [3, 3] float64, orthogonal; may be a reflection
    scale: float
    shift: Tensor  # [3] float64
    origin: Tensor  # [3] float64; 0 unless float32 is too coarse at the scene's distance

    @property
    def note(self) -> str:
        """Statement of the origin; empty if it is 0."""
        if not bool(self.origin.any()):
            return ""
        return "positions are relative to the origin " + " ".join(f"{value:.15g}" for value in self.origin.tolist())

    def points(self, points: Tensor) -> Tensor:
        """Transform points [..., 3], in their dtype, relative to the origin."""
        return (self.scale * (points.double() @ self.turn.T) + self.shift).to(points)

    def rotations(self, quats: Tensor) -> Tensor:
        """Transform rotations to [N, 4] float64 unit quaternions wxyz; a reflection inverts the third axis."""
        old = Rotation.from_quat(quats.detach().double().numpy()[:, [1, 2, 3, 0]]).as_matrix()
        new = self.turn.numpy() @ old
        new[:, :, 2] *= np.linalg.det(self.turn.numpy())
        return torch.from_numpy(Rotation.from_matrix(new).as_quat()[:, [3, 0, 1, 2]])


def to_capture(place: WorldEntry) -> Similarity:
    """Invert x_scene = scale * (transform @ [x_capture, 1]). Raises BundleError: discs would not remain discs."""
    transform = torch.tensor(place.transform, dtype=torch.float64)
    matrix, offset = transform[:, :3], transform[:, 3]
    stretch = float(torch.linalg.det(matrix).abs()) ** (1 / 3)
    turn = matrix / stretch if stretch > 0 else matrix
    if not bool(((turn @ turn.T - torch.eye(3, dtype=torch.float64)).abs() <= _TOLERANCE).all()):
        wrong = "the transform from the capture's frame to the scene's is no rotation with one scale"
        raise BundleError(f"{wrong}, so that nothing can be moved back: choose the scene's frame (--frame scene)")
    u, _, v = torch.linalg.svd(turn)
    turn = u @ v  # nearest orthogonal matrix
    scale = 1 / (stretch * place.scale)
    shift = -torch.linalg.solve(matrix, offset)
    step = 10.0 ** math.floor(math.log10(FARTHEST * scale))
    far = float(shift.norm()) > FARTHEST * scale
    origin = (shift / step).round() * step if far else torch.zeros_like(shift)
    return Similarity(turn.T, scale, shift - origin, origin)


def up_of(place: WorldEntry, to: Similarity | None) -> Tensor:
    """Compute the up direction [3] in the scene's frame; with `to`, the nearest axis of the new frame, whose rotation
    to +y only permutes and negates coordinates."""
    up = torch.tensor(place.up or _UP, dtype=torch.float64)
    if to is None:
        return up
    turned = to.turn @ up
    largest = torch.nn.functional.one_hot(turned.abs().argmax(), 3)
    return largest * turned.sign()
