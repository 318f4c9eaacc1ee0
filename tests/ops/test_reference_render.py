"""The brute-force float64 renderer against golden renders, gsplat, and extreme numbers."""

from types import SimpleNamespace

import pytest
import torch
from torch import Tensor

from bitymi_ns.measure.stability.scenes import SV_KEYS, extreme_scenes
from bitymi_ns.ops.parameters import GEOMETRY
from bitymi_ns.ops.reference.project import project
from bitymi_ns.ops.reference.render import Render, render
from bitymi_ns.ops.reference.view_color import sv, view_directions
from tests.ops.golden import GOLDEN_NAMES, SceneCase, load_golden, random_scene

IMAGES = ("rgb", "alpha", "depth", "beta_map")
EXTREME = {case.name: case for case in extreme_scenes()}


def render_case(case: SceneCase, params: dict[str, Tensor], tiles: list[Tensor] | None) -> Render:
    colors = sv(*(params[key] for key in SV_KEYS), view_directions(params["means"], case.viewmat))
    return render([params[key] for key in GEOMETRY], colors, case, case.background, tiles)


def leaves(case: SceneCase) -> tuple[dict[str, Tensor], list[Tensor] | None]:
    params = {key: value.clone().requires_grad_() for key, value in case.params.items()}
    return params, None if case.tiles is None else [tile.clone().requires_grad_() for tile in case.tiles]


def assert_close(actual: Tensor, expected: Tensor, relative: float, what: str) -> None:
    error = float((actual - expected).abs().max())
    assert error <= relative * max(float(expected.abs().max()), 1e-12), f"{what}: error {error:.2e}"


@pytest.mark.parametrize("name", GOLDEN_NAMES)
def test_golden(name: str) -> None:
    golden = load_golden(name)
    params, tiles = leaves(golden)
    images = render_case(golden, params, tiles)
    assert torch.equal(images.overdraw.double(), golden.outputs["overdraw"])
    loss = torch.zeros((), dtype=torch.float64)
    for key in IMAGES:
        assert_close(getattr(images, key).detach(), golden.outputs[key], 1e-9, key)
        loss = loss + (golden.loss_weights[key] * getattr(images, key)).sum()
    assert loss.item() == pytest.approx(golden.loss, rel=1e-9, abs=1e-9)
    loss.backward()
    for key, expected in golden.grads.items():
        assert params[key].grad is not None, key
        assert_close(params[key].grad, expected, 1e-9, f"gradient of {key}")
    for i, tile in enumerate(tiles or []):
        actual = torch.zeros_like(tile) if tile.grad is None else tile.grad
        assert_close(actual, golden.tile_grads[i], 1e-9, f"gradient of tile {i}")


@pytest.mark.parametrize("name", sorted(EXTREME))
def test_extreme_scenes_stay_finite(name: str) -> None:
    case = EXTREME[name]
    params, _ = leaves(case)
    images = render_case(case, params, None)
    loss = sum(getattr(images, key).sum() for key in (*IMAGES, "normal"))
    assert all(bool(getattr(images, key).isfinite().all()) for key in (*IMAGES, "normal"))
    loss.backward()
    for key, value in params.items():
        assert value.grad is None or bool(value.grad.isfinite().all()), f"gradient of {key}"


def test_extreme_scenes_do_what_they_are_named_after() -> None:
    drawn = {name: int(render_case(case, case.params, None).overdraw.sum()) for name, case in EXTREME.items()}
    empty = {name for name, count in drawn.items() if count == 0}
    assert empty == {
        "behind_the_camera",
        "centre_on_the_near_plane",
        "surfel_on_the_camera_centre",
        "opacity_0",
        "opacity_1_255",
        "no_surfels",
    }


def test_homography_and_normal_agree_with_gsplat() -> None:
    impl = pytest.importorskip("gsplat.cuda._torch_impl_2dgs")
    case = random_scene(50, 3)
    means, quats, log_scales, opacity_logits, beta_raw = (case.params[key] for key in GEOMETRY)
    p = project(means, quats, log_scales, opacity_logits, beta_raw, case.viewmat, case.K)
    scales = torch.cat([log_scales.exp(), torch.ones_like(log_scales[:, :1])], dim=-1)
    _, _, depths, M, normals = impl._fully_fused_projection_2dgs(
        means, quats, scales, case.viewmat[None], case.K[None], case.width, case.height
    )
    assert_close(p.M, M[0].transpose(-1, -2), 1e-12, "homography")
    assert_close(p.depth, depths[0], 1e-12, "depth")
    assert_close(p.normal, normals[0], 1e-12, "normal")


def test_a_disc_facing_the_camera_has_a_normal_towards_it() -> None:
    """A disc in the plane z = 2 before a camera at the origin has the normal (0, 0, -1) everywhere."""
    one = torch.ones(1, dtype=torch.float64)
    K = torch.tensor([[10.0, 0, 8], [0, 10, 8], [0, 0, 1]], dtype=torch.float64)
    camera = SimpleNamespace(viewmat=torch.eye(4, dtype=torch.float64), K=K, width=16, height=16)
    for quat in ([1.0, 0, 0, 0], [0.0, 1, 0, 0]):
        geometry = (
            torch.tensor([[0.0, 0, 2]], dtype=torch.float64),
            torch.tensor([quat], dtype=torch.float64),
            torch.zeros(1, 2, dtype=torch.float64),
            100 * one,
            -100 * one,
        )
        images = render(geometry, torch.zeros(1, 3, dtype=torch.float64), camera)
        center = images.normal[8, 8] / images.alpha[8, 8]
        assert torch.allclose(center, torch.tensor([0.0, 0, -1], dtype=torch.float64))
        assert torch.allclose(images.alpha[8, 8], 0.99 * one[0])
        assert torch.allclose(images.depth[8, 8], 2 * 0.99 * one[0])


def test_a_residual_field_equal_to_a_tile_gives_the_same_picture() -> None:
    """A constant tile equals a constant field."""
    case = random_scene(10, 5)
    add = torch.tensor([0.2, -0.3, 0.1], dtype=torch.float64)
    colors = sv(*(case.params[key] for key in SV_KEYS), view_directions(case.params["means"], case.viewmat))
    arguments = ([case.params[key] for key in GEOMETRY], colors, case)
    tiled = render(*arguments, tiles=[add.expand(4, 4, 3)] * 10)
    with_field = render(*arguments, residual=lambda x: add.expand(x.shape[0], 3))
    assert torch.allclose(tiled.rgb, with_field.rgb, atol=1e-14)
    assert not torch.allclose(tiled.rgb, render(*arguments).rgb)
