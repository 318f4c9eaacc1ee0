"""Pictures of what each part of a scene contributes."""

import torch

from bitymi_ns import ops
from bitymi_ns.measure.pictures import residual_parts
from tests.scene import bands


def test_the_residual_of_a_view_that_is_drawn_in_bands() -> None:
    parts = []
    for most in (0, 1500):
        scene, camera = bands.make(torch.device("cpu"), most)
        output = scene.render(camera, field_mode="frozen")
        assert isinstance(output.fragments, ops.Bands) == (most > 0)
        parts.append(dict(zip(("positive", "negative"), residual_parts(scene, output), strict=True)))
    assert (parts[0]["positive"] > 0).any()
    bands.assert_same(parts[1], parts[0])
