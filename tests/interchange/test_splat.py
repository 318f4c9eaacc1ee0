"""The Gaussian renderer against the published formulas, per pixel, in float64."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from bitymi_ns.interchange import splat
from bitymi_ns.interchange.gaussians import Gaussians
from bitymi_ns.interchange.splat import draw_gaussians
from bitymi_ns.ops.reference.view_color import sh_basis


def gaussians(count: int) -> Gaussians:
    g = torch.Generator().manual_seed(3)
    quats = torch.nn.functional.normalize(torch.randn(count, 4, generator=g), dim=1)
    scales = torch.cat([-2.0 + 0.7 * torch.randn(count, 2, generator=g), torch.full((count, 1), -16.0)], 1)
    opacity = 2 * torch.randn(count, generator=g)
    return Gaussians(
        1.2 * torch.randn(count, 3, generator=g),
        quats,
        scales,
        opacity,
        0.3 * torch.randn(count, 16, 3, generator=g),
        torch.arange(count) % 2 == 0,
    )


def expected(gs: Gaussians, camera, background: np.ndarray, near: float, discs: bool) -> np.ndarray:
    view, K = camera.viewmat.double().numpy(), camera.K.double().numpy()
    found = []
    for i in range(len(gs)):
        mean = gs.means[i].double().numpy()
        x, y, z = view[:3, :3] @ mean + view[:3, 3]
        if z <= near:
            continue
        turn = Rotation.from_quat(gs.quats[i].double().numpy()[[1, 2, 3, 0]]).as_matrix()
        S = turn @ np.diag(np.exp(2 * gs.log_scales[i].double().numpy())) @ turn.T
        a, b = (
            np.clip(c / z, -1.3 * s / (2 * f), 1.3 * s / (2 * f))
            for c, s, f in ((x, camera.width, K[0, 0]), (y, camera.height, K[1, 1]))
        )
        J = np.array([[K[0, 0] / z, 0, -K[0, 0] * a / z], [0, K[1, 1] / z, -K[1, 1] * b / z]])
        C = J @ view[:3, :3] @ S @ view[:3, :3].T @ J.T + 0.3 * np.eye(2)
        center = np.array([K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]])
        d = torch.from_numpy(mean + view[:3, :3].T @ view[:3, 3])
        color = (sh_basis(3, d[None] / d.norm())[0] @ gs.harmonics[i].double() + 0.5).clamp(min=0).numpy()
        found.append(
            (z, center, np.linalg.inv(C), float(torch.sigmoid(gs.opacity_logits[i].double())), color, bool(gs.hard[i]))
        )
    image = np.zeros((camera.height, camera.width, 3))
    for row in range(camera.height):
        for column in range(camera.width):
            left = 1.0
            for _, center, inverse, opacity, color, hard in sorted(found, key=lambda each: each[0]):
                d = np.array([column + 0.5, row + 0.5]) - center
                q = d @ inverse @ d
                alpha = min(0.99, opacity * (float(q <= 4) if hard and discs else np.exp(-0.5 * q)))
                if alpha < 1 / 255:
                    continue
                if left * (1 - alpha) < 1e-4:
                    break
                image[row, column] += left * alpha * color
                left *= 1 - alpha
            image[row, column] += left * background
    return image


@pytest.mark.parametrize("discs", [False, True])
def test_pictures_are_those_of_the_formulas(camera, discs: bool) -> None:
    gs, view = gaussians(12), camera(4.0, 24, 20)
    background = torch.tensor([0.1, 0.5, 0.9])
    found = draw_gaussians(gs, view, background, discs=discs).double().numpy()
    difference = np.abs(found - expected(gs, view, background.double().numpy(), 0.2, discs))
    # footprints end at three standard deviations of the longer axis, where alpha may be up to 0.011
    assert difference.max() < 0.03 and np.median(difference) < 1e-5


def test_many_gaussians_in_a_pixel_are_blended_as_few(camera, monkeypatch) -> None:
    """More Gaussians than one batch blends."""
    gs, view = gaussians(1200), camera(4.0, 20, 18)
    at_once = draw_gaussians(gs, view)
    monkeypatch.setattr(splat, "_AT_ONCE", 7)
    assert torch.allclose(draw_gaussians(gs, view), at_once, atol=2e-5)
    background = torch.tensor([0.25, 0.5, 0.75])
    assert draw_gaussians(gaussians(0), view, background)[3, 4].tolist() == background.tolist()
