"""From the scene's frame to the capture's own."""

from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from bitymi_ns.bundle.manifest import BundleError, WorldFrame

FARTHEST = 10_000.0
"""Units of the scene, whose cameras fit into a box from -1 to 1; so far from the origin float32 is off by 1/1,000."""
_SLACK = 1e-4  # of a rotation that was stored with rounding


@dataclass(frozen=True)
class Similarity:
    """x_new = scale * (turn @ x) + shift."""

    turn: Tensor  # [3, 3] float64, orthogonal; it may mirror
    scale: float  # of lengths
    shift: Tensor  # [3] float64

    def points(self, points: Tensor) -> Tensor:
        """[..., 3] points in the new frame, of their type."""
        return (self.scale * (points.double() @ self.turn.T) + self.shift).to(points)

    def rotations(self, quats: Tensor) -> Tensor:
        """[N, 4] float64 unit quaternions wxyz in the new frame. Where it is mirrored, the third axis is turned round:
        a disc's or a Gaussian's own mirror image."""
        old = Rotation.from_quat(quats.detach().double().numpy()[:, [1, 2, 3, 0]]).as_matrix()
        new = self.turn.numpy() @ old
        new[:, :, 2] *= np.linalg.det(self.turn.numpy())
        return torch.from_numpy(Rotation.from_matrix(new).as_quat()[:, [3, 0, 1, 2]])


def to_capture(place: WorldFrame) -> Similarity:
    """Inverse of x_scene = scale * (transform @ [x_capture, 1]).

    Raises:
        BundleError: the transform is no similarity, so that discs would not stay discs; or it leads so far from the
            origin that float32 cannot tell positions.
    """
    transform = torch.tensor(place.transform, dtype=torch.float64)
    matrix, offset = transform[:, :3], transform[:, 3]
    stretch = float(torch.linalg.det(matrix).abs()) ** (1 / 3)
    turn = matrix / stretch if stretch > 0 else matrix
    if not bool(((turn @ turn.T - torch.eye(3, dtype=torch.float64)).abs() <= _SLACK).all()):
        raise BundleError(
            "world.transform of the bundle is no rotation, so that nothing can be moved into the capture's own frame: "
            "leave it in the scene's"
        )
    u, _, v = torch.linalg.svd(turn)
    turn = u @ v  # the nearest orthogonal one
    scale = 1 / (stretch * place.scale)
    shift = -(turn.T @ offset) / stretch
    if float(shift.norm()) > FARTHEST * scale:
        raise BundleError(
            f"the capture lies {float(shift.norm()):,.0f} of its units from the origin of its own frame, as "
            "coordinates of a map do, and the numbers of such files have seven digits: the scene would be blurred. "
            "Leave it in the scene's frame; world.transform and world.scale of bundle.json say where that lies"
        )
    return Similarity(turn.T, scale, shift)
