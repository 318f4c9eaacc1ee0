import torch

from bitymi_ns.bake.field.plan import make_plan, references
from bitymi_ns.bake.inputs import BakeInput
from bitymi_ns.bundle.bake_options import BakeOptions
from bitymi_ns.train.init import tangents
from tests.bake.conftest import WaveField


class Positions(WaveField):
    """Positions as colours, not finite for negative x."""

    def __call__(self, x: torch.Tensor) -> torch.Tensor:
        return torch.where(x[:, :1] < 0, torch.nan, x)


def test_a_whole_plan_holds_the_field_at_every_texel_centre(surfels) -> None:
    params, options = surfels(40), BakeOptions(tolerance=0.0, r_max=16)
    plan = make_plan(BakeInput(params, (), 0.2, 0.0, "low_pass"), Positions(), options, whole=True)
    axes, scales = tangents(params["quats"]), params["log_scales"].exp()
    found, bad = {}, 0
    for part in references(Positions(), plan, chunk=100):
        found |= {int(row): values.permute(1, 2, 0) for row, values in zip(part.rows, part.values, strict=True)}
        bad += part.nonfinite
    assert sorted(found) == list(range(40)) and bad > 0
    for i, (r_u, r_v) in enumerate(plan.limit.tolist()):
        u, v = ((torch.arange(r) + 0.5) / r * 6 - 3 for r in (r_u, r_v))
        across, down = (at[:, None] * scales[i, k] * axes[i, :, k] for k, at in enumerate((u, v)))
        want = params["means"][i] + across[None] + down[:, None]
        outside = want[..., :1].abs() < 1e-5  # either side of 0
        want = torch.where(want[..., :1] < 0, 0.0, want)
        torch.testing.assert_close(torch.where(outside, 0.0, found[i]), torch.where(outside, 0.0, want))
        bad -= int((found[i] == 0).all(2).sum())
    assert bad == 0
