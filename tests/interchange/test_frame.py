"""From the scene's frame to the capture's: points, discs and colours are where they were."""

import json
import math

import pytest
import torch

from bitymi_ns.bundle import BundleError
from bitymi_ns.bundle.manifest import WorldFrame
from bitymi_ns.interchange.frame import to_capture
from bitymi_ns.interchange.gaussians import gaussians_of
from bitymi_ns.ops.reference.view_color import sh_basis
from bitymi_ns.train.init import tangents
from tests.interchange.conftest import TURN
from tests.interchange.test_surfel_colors import baked


def place(matrix: torch.Tensor, scale: float) -> WorldFrame:
    shift = torch.tensor([[0.5], [-2.0], [7.0]], dtype=torch.float64)
    transform = torch.cat([matrix, shift], 1).tolist()
    return WorldFrame.model_validate_json(json.dumps({"transform": transform, "scale": scale}))


def covariance(g) -> torch.Tensor:
    axes = tangents(g.quats.double())
    axes = torch.cat([axes, torch.linalg.cross(axes[..., :1], axes[..., 1:], dim=1)], 2)
    scaled = axes * g.log_scales.double().exp()[:, None]
    return scaled @ scaled.transpose(1, 2)


@pytest.mark.parametrize("mirrored", [1, -1])
@pytest.mark.parametrize("stretch", [1.0, 3.0])
def test_gaussians_go_back_to_the_capture(surfels, mirrored: int, stretch: float) -> None:
    turn = mirrored * TURN * torch.linalg.det(TURN)
    where = place(stretch * turn, 0.25)
    transform = torch.tensor(where.transform, dtype=torch.float64)
    g = gaussians_of(baked(surfels(30), "sv"), 0.3 * torch.randn(30, 16, 3))
    moved = g.moved(to_capture(where))
    again = 0.25 * (moved.means.double() @ transform[:, :3].T + transform[:, 3])
    assert torch.allclose(again, g.means.double(), atol=1e-5)
    size = 0.25 * stretch
    expected = turn.T @ covariance(g) @ turn / size**2
    assert torch.allclose(covariance(moved), expected, rtol=1e-5, atol=1e-6 * float(expected.max()))
    d = torch.nn.functional.normalize(torch.randn(50, 3, dtype=torch.float64), dim=1)
    old = torch.einsum("dk,nkc->ndc", sh_basis(3, d @ turn.T), g.harmonics.double())
    new = torch.einsum("dk,nkc->ndc", sh_basis(3, d), moved.harmonics.double())
    assert torch.allclose(old, new, atol=1e-6)
    assert torch.equal(moved.opacity_logits, g.opacity_logits)
    assert math.isclose(float(moved.log_scales[0, 0] - g.log_scales[0, 0]), -math.log(size), abs_tol=1e-5)


def test_a_frame_that_is_bent_or_far_away_is_refused() -> None:
    for matrix in (torch.diag(torch.tensor([1.0, 2.0, 1.0], dtype=torch.float64)), torch.zeros(3, 3)):
        with pytest.raises(BundleError, match=r"world\.transform"):
            to_capture(place(matrix.double(), 1.0))
    where = place(torch.eye(3, dtype=torch.float64), 0.1)  # coordinates of a map
    transform = torch.tensor(where.transform, dtype=torch.float64)
    transform[:, 3] = -torch.tensor([500123.0, 4649876.0, 312.0], dtype=torch.float64)
    with pytest.raises(BundleError, match="lies 4,676,694 of its units from the origin .* in the scene's frame"):
        to_capture(where.model_copy(update={"transform": transform.tolist()}))
