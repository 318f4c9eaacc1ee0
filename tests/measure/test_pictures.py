"""Pictures of the contribution of each part of a scene."""

import torch

from bitymi_ns import ops
from bitymi_ns.measure.pictures import residual_parts
from tests.scene import bands
from tests.scene.test_texel_field import make


def test_the_residual_of_a_view_that_is_drawn_in_bands() -> None:
    parts = []
    for most in (0, 1500):
        scene, camera = bands.make(torch.device("cpu"), most)
        output = scene.render(camera, field_mode="frozen")
        assert isinstance(output.fragments, ops.Bands) == (most > 0)
        parts.append(dict(zip(("positive", "negative"), residual_parts(scene, output), strict=True)))
    assert (parts[0]["positive"] > 0).any()
    bands.assert_same(parts[1], parts[0])


@torch.no_grad()
def test_the_view_colour_and_the_residual_are_cut_alike() -> None:
    scene, camera, _ = make()
    g = torch.Generator().manual_seed(1)
    scene.surfels["sv_rgb"].abs_()  # avoids clipping at 0
    scene.field.texels.mul_(0.1)
    scene.field.alpha = torch.nn.Parameter(2 * torch.rand(len(scene.field.texels), generator=g, dtype=torch.float64))
    output, plain = scene.render(camera, field_mode="frozen"), scene.render(camera, field_mode="off")
    positive, negative = residual_parts(scene, output)
    torch.testing.assert_close(output.alpha, plain.alpha)
    torch.testing.assert_close(plain.rgb + positive - negative, output.rgb, atol=1e-3, rtol=0)
    scene.field.alpha = None
    assert float((scene.render(camera, field_mode="off").alpha - plain.alpha).abs().max()) > 0.1
