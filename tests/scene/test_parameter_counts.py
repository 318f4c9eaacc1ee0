"""How many numbers a surfel is made of, for each view colour."""

import pytest
import torch

from bitymi_ns.scene import Scene, SceneConfig

GEOMETRY = {"means": (3,), "quats": (4,), "log_scales": (2,), "opacity_logits": (), "beta_raw": ()}
COLORS = {
    "sv": {"sv_sites": (7, 3), "sv_log_tau": (7,), "sv_rgb": (7, 3)},
    "sh": {"sh_dc": (3,), "sh_rest": (15, 3)},
    "sb": {"sb_base": (3,), "sb_lobes": (2, 6)},
    "sg": {"sg_base": (3,), "sg_lobes": (2, 7)},
}


@pytest.mark.parametrize("kind, expected", [("sv", 60), ("sh", 59), ("sb", 26), ("sg", 28)])
def test_parameters_per_surfel(kind: str, expected: int) -> None:
    """The paper's totals over its surfel counts: 6.765 M / 112,748, 6.908 M / 117,082 and 2.908 M / 111,859."""
    n = 5
    surfels = {name: torch.zeros(n, *shape) for name, shape in (GEOMETRY | COLORS[kind]).items()}
    scene = Scene(SceneConfig(view_color=kind, texture="none"), surfels, None)
    assert sum(p.numel() for p in scene.parameters()) == expected * n
