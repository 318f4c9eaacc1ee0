"""Pixels that end at a transmittance of half an 8-bit step."""

from dataclasses import replace

import pytest
import torch

from bitymi_ns.scene.baked import FAST, BakedScene
from tests.cuda.baked_scenes import camera_of, front, scene_of
from tests.ops.golden import random_scene


@pytest.mark.parametrize("seed", range(2))
def test_a_pixel_changes_by_no_more_than_what_is_left(seed: int) -> None:
    case = random_scene(400, seed, width=60, height=44)
    case.params["opacity_logits"] += 3.0
    exact, camera = scene_of(case), camera_of(case)
    before, after = exact.render(camera, maps=True), replace(exact, transmittance_min=FAST).render(camera, maps=True)
    assert after.overdraw.sum() < 0.95 * before.overdraw.sum()
    assert (after.overdraw <= before.overdraw).all()
    largest = float(before.rgb.max() / before.alpha.max())
    assert (after.rgb <= before.rgb + 1e-6).all()
    assert (before.rgb - after.rgb).max() <= 4 * FAST * largest
    ended = after.overdraw < before.overdraw
    assert (1 - after.alpha[ended] < FAST).all()  # the surfel that ends a pixel is blended
    torch.testing.assert_close(after.rgb[~ended[..., 0]], before.rgb[~ended[..., 0]], rtol=0, atol=0)


def test_a_surfel_that_ends_a_pixel_is_blended() -> None:
    """0.85, then 0.99: transmittance 0.15 in front of the second, 0.0015 behind it."""
    surfels = {
        "means": torch.tensor([[0.0, 0, -0.2], [0, 0, 0], [0, 0, 0.2]]),
        "quats": torch.tensor([[1.0, 0, 0, 0]] * 3),
        "log_scales": torch.zeros(3, 2),
        "opacity_logits": torch.logit(torch.tensor([0.85, 0.995, 0.5])),
        "beta_raw": torch.full((3,), -20.0),
        "sh_dc": torch.rand(3, 3),
        "sh_rest": torch.zeros(3, 15, 3),
    }
    scene = BakedScene(surfels, "sh", torch.zeros(3, 5, dtype=torch.int32), None, transmittance_min=FAST)
    drawn = scene.render(front(), maps=True)
    assert int(drawn.overdraw[20, 30]) == 2
    assert float(1 - drawn.alpha[20, 30]) == pytest.approx(0.15 * 0.01, abs=1e-5)
