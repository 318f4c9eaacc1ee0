"""Extreme numbers: finite inputs give finite results and gradients, with errors as stated."""

import pytest
import torch

from bitymi_ns import ops
from bitymi_ns.measure.stability.errors import Backend, measure
from bitymi_ns.measure.stability.page import ACCURATE, ALLOWANCE
from bitymi_ns.measure.stability.scenes import PLAIN, SWEEPS, WAYS, SceneCase, Sweep, random_scene
from bitymi_ns.ops.parameters import GEOMETRY
from bitymi_ns.scene import Camera, HashField, Scene, SceneConfig
from tests.stress.limits import Case, cases

pytestmark = pytest.mark.slow

CASES = cases()
LONG = "thousands_on_one_pixel"
"""Measured with one colouring only: it takes as long as all others together, and lists are the same."""
EVERY = [case for way in (PLAIN, *WAYS) for case in cases(way) if way is PLAIN or case.scene.name != LONG]


def scene_and_camera(case: SceneCase, backend: Backend, dtype: torch.dtype, **options) -> tuple[Scene, Camera]:
    place = {"device": backend.device, "dtype": dtype}
    config = SceneConfig(**options)
    field = None
    if config.texture == "hash":
        field = HashField(config, (0.0, 0.0, 0.0), 2.0, True, 10, torch.Generator().manual_seed(0))
    scene = Scene(config, {key: value.to(**place) for key, value in case.params.items()}, field).to(**place)
    return scene, Camera(case.viewmat.to(**place), case.K.to(**place), case.width, case.height)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["double", "single"])
@pytest.mark.parametrize("case", CASES, ids=[case.scene.name for case in CASES])
def test_finite_in_finite_out(case: Case, dtype: torch.dtype, backend: Backend) -> None:
    scene, camera = scene_and_camera(case.scene, backend, dtype, texture_moves_surfels=True)
    output = scene.render(camera, case.scene.background.to(backend.device, dtype), maps=True)
    images = [output.rgb, output.alpha, output.beta, output.depth, output.normal]
    for image in images:
        assert image.isfinite().all()
    assert (output.alpha >= 0).all() and (output.alpha <= 1 + 1e-5).all()
    sum(image.sum() for image in images).backward()
    for name, parameter in scene.named_parameters():
        assert parameter.grad is None or parameter.grad.isfinite().all(), name


@pytest.mark.parametrize("case", EVERY, ids=[f"{case.way.name}-{case.scene.name}" for case in EVERY])
def test_errors_are_within_the_stated_figures(case: Case, backend: Backend) -> None:
    errors = measure(case.scene, backend, way=case.way)
    assert errors.finite
    assert (errors.drawn > 0) == (case.forward > 0)
    assert errors.forward <= case.forward, errors
    assert errors.gradient <= case.gradient, errors
    assert errors.flipped <= case.flipped, errors
    # otherwise the stated error is explained by the inputs' rounding
    assert case.forward <= max(ACCURATE, 12 * errors.input_forward)
    assert case.gradient <= max(ACCURATE, 12 * errors.input_gradient)


@pytest.mark.parametrize("sweep", SWEEPS, ids=[sweep.name.replace(" ", "_") for sweep in SWEEPS])
def test_errors_grow_no_faster_than_those_of_rounded_inputs(sweep: Sweep, backend: Backend) -> None:
    for value in (sweep.values[0], sweep.values[len(sweep.values) // 2], sweep.values[-2], sweep.values[-1]):
        errors = measure(sweep.make(value), backend, near=sweep.near(value))
        assert errors.finite and errors.drawn > 0
        assert errors.forward <= max(ACCURATE, ALLOWANCE * errors.input_forward), (value, errors)
        assert errors.gradient <= max(ACCURATE, ALLOWANCE * errors.input_gradient), (value, errors)


def test_far_from_the_origin_only_the_rounding_of_positions_shows(backend: Backend) -> None:
    """At 10^6 units, compared with equally rounded numbers, the error is that at the origin."""
    sweep = next(sweep for sweep in SWEEPS if sweep.name == "world size")
    errors = measure(sweep.make(1e6), backend)
    assert errors.forward < 1e-5 and errors.gradient < 2e-5 and errors.flipped == 0


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("name", GEOMETRY)
def test_a_row_that_is_not_finite_is_dropped_and_counted(name: str, value: float, backend: Backend) -> None:
    case = random_scene(20, 0)
    case.params[name][3] = value
    scene, camera = scene_and_camera(case, backend, torch.float32, texture="none")
    output = scene.render(camera, maps=True)
    assert output.projection.not_finite == 1
    everywhere = torch.ones(camera.width * camera.height, dtype=torch.bool, device=backend.device)
    counts = output.fragments.masked_counts(everywhere)
    assert counts[3] == 0 and counts.any()
    assert output.rgb.isfinite().all()
    output.rgb.sum().backward()
    for key, parameter in scene.surfels.items():
        assert parameter.grad.isfinite().all(), key


def test_view_colors_at_extreme_temperatures_and_directions(backend: Backend) -> None:
    n = 6
    params = {
        "sv_sites": torch.zeros(n, 7, 3),
        "sv_log_tau": torch.full((n, 7), 80.0),
        "sv_rgb": torch.rand(n, 7, 3),
    }
    params["sv_sites"][1:] = torch.randn(n - 1, 7, 3) * torch.tensor([1e-20, 1e-10, 1.0, 1e10, 1e18]).view(-1, 1, 1)
    leaves = {name: value.to(backend.device).requires_grad_() for name, value in params.items()}
    center = torch.zeros(3)
    means = torch.cat([torch.zeros(1, 3), torch.randn(n - 1, 3)]).to(backend.device).requires_grad_()
    color = ops.view_color("sv", leaves, means, center)
    color.sum().backward()
    assert color.isfinite().all() and means.grad.isfinite().all()
    assert all(leaf.grad.isfinite().all() for leaf in leaves.values())
