"""Crops hide surfels by their centres, and leave the others as they are."""

from pathlib import Path

import pytest
import torch

from bitymi_ns.bundle import read_bundle
from bitymi_ns.scene.crop import Box, Crop
from tests.bundle.made import make


def test_floor_box_and_hidden_boxes_hide_together() -> None:
    points = torch.tensor([[0.0, 0, -1], [0, 0, 0], [0.5, 0, 0], [0, 0, 1], [5, 0, 0]])
    still = ((1, 0, 0), (0, 1, 0), (0, 0, 1))
    box, hidden = Box.of((0, 0, 0), (2, 2, 2), still), Box.of((0.5, 0, 0), (0.1, 0.1, 0.1), still)
    floor = ((0.0, 0.0, 1.0), 0.0)
    assert Crop().keeps(points).all()
    assert Crop(box=box).keeps(points).tolist() == [True, True, True, True, False]
    assert Crop(floor=floor).keeps(points).tolist() == [False, True, True, True, True]
    assert Crop(box, floor, (hidden,)).keeps(points).tolist() == [False, True, False, True, False]


@pytest.mark.parametrize(("reduced", "alpha"), [(False, False), (True, False), (False, True)])
def test_surfels_that_are_left_out_are_not_drawn(surfels, camera, tmp_path: Path, reduced: bool, alpha: bool) -> None:
    more = {"mean_residual": torch.rand(12, 3)}
    make(surfels, tmp_path / "b", count=12, reduced=reduced, alpha=alpha, **more)
    scene = read_bundle(tmp_path / "b").scene
    kept = torch.arange(12) % 3 > 0
    some = scene.only(kept)
    assert len(some) == 8
    logits = scene.surfels["opacity_logits"].masked_fill(~kept, -1e4)
    hidden = read_bundle(tmp_path / "b").scene
    hidden.surfels = {**hidden.surfels, "opacity_logits": logits}
    whole, a, b = (each.render(camera(6.0), maps=True) for each in (scene, some, hidden))
    assert not torch.allclose(whole.rgb, a.rgb, atol=1e-3)
    for name in ("rgb", "alpha", "depth", "normal", "overdraw"):
        assert torch.allclose(getattr(a, name).float(), getattr(b, name).float(), atol=1e-6), name
