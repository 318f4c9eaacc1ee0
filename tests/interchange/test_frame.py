"""Scene to capture frame: points, discs and colours keep their positions."""

import json
import math

import pytest
import torch
from scipy.spatial.transform import Rotation

from bitymi_ns.bundle import BundleError
from bitymi_ns.bundle.world import WorldEntry
from bitymi_ns.interchange.frame import to_capture, up_of
from bitymi_ns.interchange.gaussians import gaussians_of
from bitymi_ns.ops.reference.view_color import sh_basis
from bitymi_ns.train.init import tangents
from tests.interchange.conftest import TURN
from tests.interchange.test_surfel_colors import baked


def place(matrix: torch.Tensor, scale: float) -> WorldEntry:
    shift = torch.tensor([[0.5], [-2.0], [7.0]], dtype=torch.float64)
    transform = torch.cat([matrix, shift], 1).tolist()
    return WorldEntry.model_validate_json(json.dumps({"transform": transform, "scale": scale}))


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


def test_a_frame_that_is_bent_is_refused() -> None:
    for matrix in (torch.diag(torch.tensor([1.0, 2.0, 1.0], dtype=torch.float64)), torch.zeros(3, 3)):
        with pytest.raises(BundleError, match=r"no rotation with one scale, .* \(--frame scene\)"):
            to_capture(place(matrix.double(), 1.0))


@pytest.mark.parametrize("scale", [0.1, 30.0, 1e-5])
def test_far_away_positions_are_relative_to_an_origin(scale: float) -> None:
    where = place(TURN * torch.linalg.det(TURN), scale)
    offset = torch.tensor([500123.4, -4649876.0, 312.0], dtype=torch.float64) / min(1.0, 30 * scale)
    transform = torch.tensor(where.transform, dtype=torch.float64)
    transform[:, 3] = offset
    to = to_capture(where.model_copy(update={"transform": transform.tolist()}))
    points = torch.rand(100, 3)
    found = to.points(points)
    assert float(found.abs().max()) <= 1000 * to.scale and to.note == (
        "positions are relative to the origin " + " ".join(f"{value:.15g}" for value in to.origin.tolist())
    )
    again = scale * ((found.double() + to.origin) @ transform[:, :3].T + offset)
    assert torch.allclose(again, points.double(), atol=2e-4)
    near = to_capture(place(torch.eye(3, dtype=torch.float64), scale))
    assert not near.note and not near.origin.any()


def test_up_is_an_axis_of_the_captures_frame() -> None:
    tilted = Rotation.from_euler("xz", [80.0, 10.0], degrees=True).as_matrix()  # scene to capture
    where = place(torch.from_numpy(tilted.T.copy()), 1.0)
    assert up_of(where, None).tolist() == [0, 0, 1]
    up = up_of(where, to_capture(where))
    assert up.abs().tolist() == [0, 1, 0] and float(up @ tilted[:, 2]) > 0.9
    known = where.model_copy(update={"up": (0.0, 0.0, -1.0), "up_from": "gps"})
    assert torch.equal(up_of(known, to_capture(known)), -up)
