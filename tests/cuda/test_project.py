"""Projection on CUDA against the CPU kernels, which are checked against the float64 references."""

import pytest
import torch

from bitymi_ns.ops import project
from bitymi_ns.scene import Camera
from tests.ops.golden import GOLDEN_NAMES, camera_of, load_golden, values_of

RADII = 2  # index in the result of `run`


def run(case, dtype: torch.dtype, device: torch.device):
    """Compute geom, frames, radii and the parameters' gradients for a fixed random direction."""
    params = values_of(case, dtype, device, grad=True)
    p = project(*params, camera_of(case, dtype), 0.2)
    generator = torch.Generator().manual_seed(3)
    directions = [torch.randn(t.shape, generator=generator, dtype=torch.float64) for t in (p.geom, p.frames)]
    loss = sum((t * d.to(t)).sum() for t, d in zip((p.geom, p.frames), directions, strict=True))
    grads = torch.autograd.grad(loss, params)
    return [t.detach().cpu().double() for t in (p.geom, p.frames, p.radii, *grads)], p.not_finite


@pytest.mark.parametrize("name", GOLDEN_NAMES)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["double", "single"])
def test_projection_and_its_gradients(name: str, dtype: torch.dtype, device: torch.device, both) -> None:
    case = load_golden(name)
    case.params["means"][0, 0] = float("nan")
    (got, broken), (want, want_broken) = both(lambda where: run(case, dtype, where))
    assert broken == want_broken == 1
    tolerance = 1e-10 if dtype == torch.float64 else 1e-4
    for i, (a, b) in enumerate(zip(got, want, strict=True)):
        assert torch.isfinite(a).all()
        if i == RADII:  # from planes in single precision here, from a conic in double there
            # ends far outside the image, near the camera's plane, are sensitive to rounding
            a, b = (t.clamp(max=8.0 * max(case.width, case.height)) for t in (a, b))
            wider, narrower = (a - b - 1e-3 * b).max(), (b - a - 1e-3 * b).max()
            assert wider <= 0.1 and narrower <= (0.02 if device.type == "cuda" else 0.01), (wider, narrower)
        else:
            assert (a - b).abs().max() <= tolerance * b.abs().max()


def test_no_surfels(device: torch.device) -> None:
    empty = [torch.empty(0, *shape, device=device) for shape in ((3,), (4,), (2,), (), ())]
    camera = Camera(torch.eye(4), torch.tensor([[50.0, 0, 8], [0, 50, 8], [0, 0, 1]]), 16, 16)
    assert project(*empty, camera).geom.shape == (0, 16)
