import torch

from bitymi_ns.bake import BakeOptions
from bitymi_ns.bake.field.tiles import field_tiles
from bitymi_ns.bake.pipeline import trained_texels
from bitymi_ns.train.init import tangents
from tests.bake.conftest import WaveField


class Positions(WaveField):
    """Positions as colours, not finite for negative x."""

    def __call__(self, x: torch.Tensor) -> torch.Tensor:
        return torch.where(x[:, :1] < 0, torch.nan, x)


def test_tiles_without_a_tolerance_hold_the_field_at_every_texel_centre(scene) -> None:
    made, options = scene(40), BakeOptions(tolerance=0.0, r_max=16, chunk=100)
    baked = field_tiles(trained_texels(made, options), Positions(), ())
    params, done = made.surfels, 0
    axes, scales = tangents(params["quats"]), params["log_scales"].exp()
    bad = baked.texel_counts["not_finite"]
    assert bad > 0 and baked.extent.tolist() == [3.0] * 40
    for i, (r_u, r_v) in enumerate(baked.sizes.tolist()):
        found = baked.texels[done : done + r_u * r_v].view(r_v, r_u, 3)
        done += r_u * r_v
        u, v = ((torch.arange(r) + 0.5) / r * 6 - 3 for r in (r_u, r_v))
        across, down = (at[:, None] * scales[i, k] * axes[i, :, k] for k, at in enumerate((u, v)))
        want = params["means"][i] + across[None] + down[:, None]
        outside = want[..., :1].abs() < 1e-5  # either side of 0
        want = torch.where(want[..., :1] < 0, 0.0, want)
        torch.testing.assert_close(torch.where(outside, 0.0, found), torch.where(outside, 0.0, want))
        bad -= int((found == 0).all(2).sum())
    assert bad == 0 and done == len(baked.texels)
