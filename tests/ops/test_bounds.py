"""Tile bounds: no fragment is lost. Every scene is drawn with and without bounds and must come out the same."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from bitymi_ns.ops import backend
from tests.ops.golden import SURFEL_KEYS, dense, random_scene, reference, traced


@pytest.mark.parametrize("prefilter", [False, True], ids=["low pass", "prefilter"])
@settings(max_examples=60, deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 10_000),
    scale=st.floats(-8.0, 2.0),
    ratio=st.floats(0.0, 12.0),
    opacity=st.floats(-6.0, 8.0),
    beta=st.floats(-8.0, 6.0),
    closer=st.floats(0.15, 1.0),
)
def test_every_fragment_of_the_brute_force_is_found(
    prefilter: bool, seed: int, scale: float, ratio: float, opacity: float, beta: float, closer: float
) -> None:
    """One surfel a scene, so that transmittance ends nothing: sizes, axis ratios to 1e5, any tilt, near the camera."""
    case = random_scene(1, seed, width=70, height=50)
    p = case.params
    camera_position = -case.viewmat[:3, :3].T @ case.viewmat[:3, 3]
    p["means"] = camera_position + closer * (p["means"] - camera_position)
    p["log_scales"] = torch.tensor([[scale, scale - ratio]], dtype=torch.float64)
    p["opacity_logits"] = torch.tensor([opacity], dtype=torch.float64)
    p["beta_raw"] = torch.tensor([beta], dtype=torch.float64)
    values = [p[name] for name in SURFEL_KEYS]
    fragments, _ = traced(case, values, prefilter)
    want = reference(case, values, prefilter)
    tolerance = {"rtol": 1e-8, "atol": 1e-10} if prefilter else {"rtol": 1e-9, "atol": 1e-12}
    torch.testing.assert_close(dense(fragments, fragments.weight, 1), want.weight, **tolerance)


def test_bounds_leave_most_tiles_out() -> None:
    case = random_scene(200, 1, width=320, height=240, scale=0.05)
    _, projection = traced(case, [case.params[name] for name in SURFEL_KEYS])
    tracer = backend.module(torch.device("cpu")).Trace_f64()
    tracer.run(**projection.view(projection.geom), most=0)
    boxes = (2 * projection.radii / 16 + 1).clamp(max=20).prod(-1).sum()
    assert tracer.pairs < 0.9 * float(boxes)
