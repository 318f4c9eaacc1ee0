"""Tile bounds lose no fragment: scenes are drawn with and without bounds and must agree."""

from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from bitymi_ns.measure.stability.scenes import quaternions
from bitymi_ns.ops import backend
from bitymi_ns.ops.parameters import GEOMETRY
from tests.ops.golden import crossing_scene, dense, far_floor, random_scene, reference, tiles_reached, traced


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
    seed: int, scale: float, ratio: float, opacity: float, beta: float, closer: float
) -> None:
    """One surfel per scene, so that nothing is occluded: sizes, axis ratios to 1e5, any tilt, near the camera."""
    case = random_scene(1, seed, width=70, height=50)
    p = case.params
    camera_position = -case.viewmat[:3, :3].T @ case.viewmat[:3, 3]
    p["means"] = camera_position + closer * (p["means"] - camera_position)
    p["log_scales"] = torch.tensor([[scale, scale - ratio]], dtype=torch.float64)
    p["opacity_logits"] = torch.tensor([opacity], dtype=torch.float64)
    p["beta_raw"] = torch.tensor([beta], dtype=torch.float64)
    values = [p[name] for name in GEOMETRY]
    fragments, _ = traced(case, values)
    want = reference(case, values)
    torch.testing.assert_close(dense(fragments, fragments.weight, 1), want.weight, rtol=1e-9, atol=1e-12)


def test_bounds_leave_most_tiles_out() -> None:
    case = random_scene(200, 1, width=320, height=240, scale=0.05)
    _, projection = traced(case, [case.params[name] for name in GEOMETRY])
    tracer = backend.module(torch.device("cpu")).Trace_f64()
    tracer.run(**projection.view(projection.geom), most=0)
    boxes = (2 * projection.radii / 16 + 1).clamp(max=20).prod(-1).sum()
    assert tracer.pairs < 0.9 * float(boxes)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])
@pytest.mark.parametrize("seed", range(4))
def test_discs_across_the_camera_plane_are_listed_where_they_show(seed: int, dtype: torch.dtype) -> None:
    """Discs without a box are culled beyond the borders and listed in tiles that they reach."""
    case = crossing_scene(120, seed)
    fragments, projection = traced(case, [case.params[name].to(dtype) for name in GEOMETRY])
    want = reference(case, [case.params[name] for name in GEOMETRY]).weight
    found = dense(fragments, fragments.weight, 120)
    assert ((found > 0) != (want > 0)).double().mean() < (1e-12 if dtype == torch.float64 else 1e-4)
    shown, seen = tiles_reached(want, case.width, case.height), projection.radii[:, 0] > 0
    assert (shown == 0).sum() > 40 and (shown > 0).sum() > 40
    assert not ((shown > 0) & ~seen).any()
    assert (seen & (shown == 0)).sum() <= 20  # not beyond a single border
    tracer = backend.kernel_class("Trace", projection.geom)()
    tracer.run(**projection.view(projection.geom.detach()), most=0)
    assert tracer.pairs <= 1.25 * int(shown.sum())


def test_a_disc_out_of_view_keeps_its_low_pass() -> None:
    """A disc parallel to the plane of the left border, a third of a pixel beyond it, across the camera's plane."""
    case = crossing_scene(1, 0, width=40, height=30)
    case = replace(case, viewmat=torch.eye(4, dtype=torch.float64))
    fx, cx = case.K[0, 0].item(), case.K[0, 2].item()
    along = torch.tensor([-(cx + 0.3) / fx, 0.0, 1.0], dtype=torch.float64)
    border = torch.tensor([-cx / fx, 0.0, 1.0], dtype=torch.float64)
    down = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    u = border / border.norm()
    case.params |= {
        "means": 0.5 * along[None],
        "quats": quaternions(torch.stack([u, down, torch.linalg.cross(u, down)], dim=1)[None]),
        "log_scales": torch.zeros(1, 2, dtype=torch.float64),
        "opacity_logits": torch.full((1,), 3.0, dtype=torch.float64),
    }
    values = [case.params[name] for name in GEOMETRY]
    fragments, projection = traced(case, values)
    want = reference(case, values).weight
    assert (want > 0).sum() == 7 and 2 < float(projection.radii.max()) < 3
    torch.testing.assert_close(dense(fragments, fragments.weight, 1), want, rtol=1e-9, atol=1e-12)


def test_a_disc_whose_centre_is_a_million_pixels_away() -> None:
    case = far_floor()
    values = [case.params[name] for name in GEOMETRY]
    fragments, projection = traced(case, values)
    want = reference(case, values).weight
    assert (want > 0).sum() > 300 and float(projection.geom[0, 0]) > 1e6
    torch.testing.assert_close(dense(fragments, fragments.weight, 1), want, rtol=1e-7, atol=1e-10)
