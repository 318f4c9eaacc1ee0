"""A small scene with an analytic field, for which every step of the bake has an exact answer."""

from types import SimpleNamespace

import pytest
import torch

from bitymi_ns.scene.camera import Camera


class WaveField:
    """A smooth residual colour, with voxels of one size."""

    def __init__(self, voxel: float = 0.05) -> None:
        self.voxel = voxel

    def __call__(self, x: torch.Tensor) -> torch.Tensor:
        return 0.2 * torch.sin(x * torch.tensor([3.0, 5.0, 7.0])) + 0.05

    def voxel_size(self, x: torch.Tensor) -> torch.Tensor:
        return torch.full((len(x), 2), self.voxel)


def make_surfels(count: int, kind: str = "sv", seed: int = 0) -> dict[str, torch.Tensor]:
    g = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(count, *shape, generator=g)

    surfels = {
        "means": normal(3),
        "quats": normal(4),
        "log_scales": -3.0 + 0.7 * normal(2),
        "opacity_logits": normal().clamp(-3, 3),
        "beta_raw": normal(),
    }
    colors = {
        "sv": {"sv_sites": normal(7, 3), "sv_log_tau": normal(7), "sv_rgb": 0.2 * normal(7, 3)},
        "sh": {"sh_dc": normal(3), "sh_rest": 0.1 * normal(15, 3)},
        "sb": {"sb_base": normal(3), "sb_lobes": normal(2, 6)},
        "sg": {"sg_base": normal(3), "sg_lobes": normal(2, 7)},
    }
    return surfels | colors[kind]


def make_camera(distance: float = 6.0, width: int = 64, height: int = 48) -> Camera:
    viewmat = torch.eye(4)
    viewmat[2, 3] = distance
    K = torch.tensor([[60.0, 0.0, width / 2], [0.0, 50.0, height / 2], [0.0, 0.0, 1.0]])
    return Camera(viewmat, K, width, height)


@pytest.fixture(scope="session")
def surfels():
    return make_surfels


@pytest.fixture(scope="session")
def camera():
    return make_camera


@pytest.fixture(scope="session")
def truth(scene):
    """A reduced bake, as it is in the photographs."""
    from tests.bake.test_tune import waving_reduced

    return waving_reduced(scene(60))


@pytest.fixture(scope="session")
def scene():
    def make(count: int = 200, field: object = "wave", kind: str = "sv", seed: int = 0) -> SimpleNamespace:
        field = WaveField() if field == "wave" else field
        surfels = make_surfels(count, kind, seed)
        config = SimpleNamespace(weight_bound=0.0)
        return SimpleNamespace(surfels=surfels, field=field, near=0.25, config=config)

    return make
