"""Tile bounds: no fragment is lost. Every scene is drawn with and without bounds and must come out the same."""

from __future__ import annotations

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from bitymi_ns import ops
from bitymi_ns.ops.reference import project as reference_project
from bitymi_ns.ops.reference import trace as reference_trace
from bitymi_ns.scene import Camera
from tests.ops.golden import random_scene

NAMES = ("means", "quats", "log_scales", "opacity_logits", "beta_raw")


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    scale=st.floats(-6.0, 2.0),
    ratio=st.floats(0.0, 12.0),
    opacity=st.floats(-6.0, 8.0),
    beta=st.floats(-8.0, 6.0),
    closer=st.floats(0.15, 1.0),
)
def test_every_fragment_of_the_brute_force_is_found(
    seed: int, scale: float, ratio: float, opacity: float, beta: float, closer: float
) -> None:
    """One surfel a scene, so that transmittance ends nothing: sizes, axis ratios to 1e5, any tilt, near the camera."""
    case = random_scene(1, seed, width=70, height=50)
    p = case.params
    camera_position = -case.viewmat[:3, :3].T @ case.viewmat[:3, 3]
    p["means"] = camera_position + closer * (p["means"] - camera_position)
    p["log_scales"] = torch.tensor([[scale, scale - ratio]], dtype=torch.float64)
    p["opacity_logits"] = torch.tensor([opacity], dtype=torch.float64)
    p["beta_raw"] = torch.tensor([beta], dtype=torch.float64)
    camera = Camera(case.viewmat, case.K, case.width, case.height)
    fragments = ops.trace(ops.project(*(p[name] for name in NAMES), camera))
    projected = reference_project.project(*(p[name] for name in NAMES), case.viewmat, case.K)
    want = reference_trace.trace(projected, case.width, case.height)
    weight = torch.zeros(case.width * case.height, dtype=torch.float64)
    weight[fragments.pixel.long()] = fragments.weight
    torch.testing.assert_close(weight, want.weight[:, 0], rtol=1e-9, atol=1e-12)


def test_bounds_leave_most_tiles_out() -> None:
    case = random_scene(200, 1, width=320, height=240, scale=0.05)
    camera = Camera(case.viewmat, case.K, case.width, case.height)
    projection = ops.project(*(case.params[name] for name in NAMES), camera)
    from bitymi_ns import _cpu

    tracer = _cpu.Trace_f64()
    tracer.run(projection.geom, projection.radii, case.width, case.height, 0.2)
    boxes = (2 * projection.radii / 16 + 1).clamp(max=20).prod(-1).sum()
    assert tracer.pairs < 0.9 * float(boxes)
