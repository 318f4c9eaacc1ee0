"""Integer codes of surfels: errors of at most half a step, in Morton order."""

import numpy as np
import pytest
import torch

from bitymi_ns.codec.limits import EXTENTS, LIMITS
from bitymi_ns.codec.surfel_codes import POSITION_BITS, REFERENCE, code_surfels, reordered
from bitymi_ns.ops.view_color import view_color
from bitymi_ns.ops.view_kinds import VIEW_COLORS, fibonacci_sphere
from tests.bundle.compact_scene import reduced_surfels

COUNT = 200


@pytest.mark.parametrize("kind", sorted(VIEW_COLORS))
def test_values_are_within_half_a_step(kind: str) -> None:
    assert 3 * POSITION_BITS <= 53  # exact in float64, as the page reads them
    params = reduced_surfels(kind, COUNT)
    fine = {name: step / 64 for name, step in REFERENCE.items()}
    sizes = torch.tensor([[8, 4]] * COUNT)
    extent = torch.linspace(*EXTENTS, COUNT)
    codes, order = code_surfels(params, kind, sizes, extent, fine)
    want, got = reordered(params, order), codes.surfels()
    assert sorted(order.tolist()) == list(range(COUNT)) and (np.diff(codes.codes["place"][:, 0]) >= 0).all()
    half = {name: step / 2 * 1.001 for name, step in codes.steps.items()}
    torch.testing.assert_close(got["log_scales"], want["log_scales"], rtol=1e-6, atol=half["log_scales"])
    torch.testing.assert_close(got["view_base"], want["view_base"], rtol=1e-6, atol=half["view_base"])
    assert torch.equal(got["view_span"], want["view_span"])
    turned = torch.nn.functional.normalize(want["quats"], dim=1)
    aligned = (got["quats"] * turned).sum(1).abs()
    assert float((2 * torch.arccos(aligned.clamp(max=1))).amax()) < 4 * fine["rotation"] + 1e-3
    for name, column in (("opacity_logits", "opacity"), ("beta_raw", "beta")):
        away = (torch.sigmoid(want[name]) - torch.sigmoid(got[name])).abs()
        assert float(away.amax()) < max(half[column], 1 / 255)
    scale, distance = codes.frame.scale, (want["means"] - torch.tensor(codes.frame.center)).abs()
    cell = codes.steps["place"] * (distance + scale)
    assert bool(((got["means"] - want["means"]).abs() <= 0.6 * cell + 1e-6).all())
    torch.testing.assert_close(codes.extent(3.0), extent[order], rtol=1e-6, atol=half["extent"])
    for direction in fibonacci_sphere(4):
        at, eye = direction.expand(COUNT, 3).contiguous(), torch.zeros(3)
        colors = [view_color(kind, each, at, eye) for each in (want, got)]
        assert float((colors[0] - colors[1]).abs().median()) < 0.01


def test_far_surfels_keep_their_limits_and_near_ones_their_places() -> None:
    params = reduced_surfels("sv", COUNT)
    params["means"][0] = torch.tensor([1e9, -1e9, 3.0])
    codes, order = code_surfels(params, "sv", np.zeros((COUNT, 2)), torch.ones(COUNT), REFERENCE)
    got, want = codes.surfels()["means"], params["means"][order]
    assert bool((got.abs() <= LIMITS["means"][0]).all())
    near = want.norm(dim=1) < 100
    assert float((got - want)[near].abs().max()) < 2 * codes.steps["place"] * (100 + codes.frame.scale)


def test_coarse_steps_still_make_surfels() -> None:
    surfels, steps = reduced_surfels("sv", COUNT), dict.fromkeys(REFERENCE, 1.0)
    codes, _ = code_surfels(surfels, "sv", np.zeros((COUNT, 2)), torch.ones(COUNT), steps)
    got = codes.surfels()
    assert all(bool(value.isfinite().all()) for value in got.values())
    torch.testing.assert_close(got["quats"].norm(dim=1), torch.ones(COUNT))
