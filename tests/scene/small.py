"""A small textured scene for comparing renderers."""

import torch

from bitymi_ns.scene import Camera, HashField, Scene, SceneConfig
from tests.ops.golden import SceneCase


def scene_of(case: SceneCase, device: torch.device, texture: bool = True, **options: object) -> tuple[Scene, Camera]:
    """Build the case in float64, with a random field."""
    config = SceneConfig(texture="hash" if texture else "none", min_resolution=8, near=0.2, **options)
    field = None
    if texture:
        g = torch.Generator().manual_seed(0)
        field = HashField(config, (0.1, -0.2, 0.3), 3.0, True, 8, g)
        with torch.no_grad():
            for parameter in field.parameters():
                parameter.copy_(torch.randn(parameter.shape, generator=g) * 0.5)
    scene = Scene(config, case.params, field).to(device, torch.float64)
    return scene, Camera(case.viewmat, case.K, case.width, case.height).to(device)
