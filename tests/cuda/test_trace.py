"""Visibility and compositing on CUDA against the CPU."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from bitymi_ns import ops
from bitymi_ns.measure.stability.scenes import SV_KEYS, extreme_scenes
from bitymi_ns.ops import bin_cuda, capacity, trace_cuda
from bitymi_ns.ops.backend import kernel, workspace
from bitymi_ns.ops.parameters import GEOMETRY
from bitymi_ns.ops.reference import view_color as reference_view_color
from bitymi_ns.ops.reference.view_color import view_directions
from bitymi_ns.scene import Camera
from tests.cuda.conftest import HERE, in_orders
from tests.ops.golden import (
    GOLDEN_NAMES,
    SceneCase,
    camera_of,
    crossing_scene,
    far_floor,
    load_golden,
    random_scene,
    reference,
    relative,
    tiles_reached,
    values_of,
)

EXACT_RIM = 1e-12  # the references bound nothing


@dataclass
class Rendered:
    """Results for comparison, on the CPU in double."""

    fragments: ops.Fragments
    image: Tensor
    leaves: dict[str, Tensor]
    mean2d: tuple[Tensor, Tensor]


def render(
    case: SceneCase,
    dtype: torch.dtype,
    device: torch.device,
    rim: float = EXACT_RIM,
    maps: bool = True,
) -> Rendered:
    """Render a view, and its gradients along fixed directions for the image and for uv and depth of fragments."""
    leaves = {key: value.to(device, dtype).clone().requires_grad_() for key, value in case.params.items()}
    camera = camera_of(case, dtype)
    projection = ops.project(*(leaves[key] for key in GEOMETRY), camera)
    fragments = ops.trace(projection, rim)
    directions = view_directions(leaves["means"], camera.viewmat.to(device))
    base = reference_view_color.sv(*(leaves[key] for key in SV_KEYS), directions)
    image = ops.blended_image(fragments, projection, base, maps=maps)
    # directions by pixel and surfel, independent of the list's order
    by_fragment = torch.sin(fragments.pixel.double() * 0.7 + fragments.surfel.double() * 1.3).to(dtype)
    by_pixel = torch.cos(torch.arange(image.numel(), device=device).double() * 1.7).to(dtype).view_as(image)
    total = (image * by_pixel).sum() + (fragments.uv * by_fragment).sum() + (fragments.depth * by_fragment).sum()
    total.backward()
    grads = {key: leaf.grad.cpu().double() for key, leaf in leaves.items()}
    found = (projection.mean2d_grad, projection.mean2d_absgrad)
    return Rendered(fragments, image.detach().cpu().double(), grads, tuple(t.cpu().double() for t in found))


def by_pixel_and_surfel(fragments: ops.Fragments) -> list[Tensor]:
    """Sort the list by pixel and surfel: key, weight, uv, depth, sigma, in double on the CPU."""
    key = fragments.pixel.cpu().long() * (1 << 32) + fragments.surfel.cpu().long()
    order = torch.argsort(key)
    values = (fragments.weight, *fragments.uv, fragments.depth, fragments.sigma)
    return [key[order], *(value.detach().cpu().double()[order] for value in values)]


def compare(got: Rendered, want: Rendered, image: float = 1e-12, gradient: float = 1e-10) -> None:
    """Check for equal fragments, images and gradients."""
    for a, b in zip(by_pixel_and_surfel(got.fragments), by_pixel_and_surfel(want.fragments), strict=True):
        assert a.shape == b.shape
        assert relative(a.double(), b.double()) <= image
    assert relative(got.image, want.image) <= image
    for key, value in want.leaves.items():
        assert relative(got.leaves[key], value) <= gradient, key
    for a, b in zip(got.mean2d, want.mean2d, strict=True):
        assert relative(a, b) <= gradient


def check_order(fragments: ops.Fragments) -> None:
    """Check the order by tile, one run per surfel in a tile, and the tiles' offsets."""
    x, y = fragments.pixel.cpu() % fragments.width, fragments.pixel.cpu() // fragments.width
    across = -(-fragments.width // 16)
    tile = (y // 16) * across + x // 16
    assert (tile.diff() >= 0).all()
    tiles = across * -(-fragments.height // 16)
    starts = torch.searchsorted(tile.contiguous(), torch.arange(tiles + 1))
    arrays = fragments.layout.arrays
    assert torch.equal(arrays["offsets"][arrays["tile_pairs"]].cpu(), starts)
    run = torch.stack([tile, fragments.surfel.cpu().long()])
    assert torch.unique_consecutive(run, dim=1).shape[1] == torch.unique(run, dim=1).shape[1]


def scenes() -> Iterator[Any]:
    """Yield scenes, options of `render`, and bounds of `compare`."""
    for name in GOLDEN_NAMES:
        if name != "textured":
            yield pytest.param(load_golden(name), {}, {}, id=name)
    for seed, width, height in ((0, 70, 50), (1, 16, 16), (2, 33, 17), (3, 8, 40)):
        yield pytest.param(random_scene(60, seed, width, height), {"maps": seed != 1}, {}, id=f"{width}x{height}")
    # a surfel on 95 tiles, listed by its warp and summed by its block
    yield pytest.param(random_scene(3, 0, 300, 80, scale=30.0), {}, {}, id="whole screen")
    for case in extreme_scenes():
        case = replace(
            case, params={key: value[:400] for key, value in case.params.items()}
        )  # to limit the emulation's time
        # for edge-on discs, rounding decides which side faces the camera
        options = {"rim": 1e-3, "maps": case.name != "edge_on"}
        yield pytest.param(case, options, {"image": 1e-9, "gradient": 1e-7}, id=case.name)


@pytest.mark.parametrize("case, options, bounds", scenes())
def test_fragments_images_and_gradients_equal_those_of_the_cpu(
    case: SceneCase, options: dict[str, Any], bounds: dict[str, float], both
) -> None:
    """Against the CPU, which tests/ops checks against golden renders and references."""
    got, want = both(lambda where: render(case, torch.float64, where, **options))
    assert got.image.isfinite().all() and all(value.isfinite().all() for value in got.leaves.values())
    compare(got, want, **bounds)
    check_order(got.fragments)


def test_single_precision(device: torch.device, cpu) -> None:
    case = random_scene(60, 5, 70, 50)
    got = render(case, torch.float32, device, rim=1e-3)
    with cpu():
        want = render(case, torch.float64, HERE, rim=1e-3)
    assert got.fragments.weight.dtype == torch.float32
    error = (got.image - want.image).abs() / want.image.abs().max()
    assert (error < 1e-5).double().mean() > 0.999  # the thresholds of alpha and transmittance may flip
    for key, value in want.leaves.items():
        error = (got.leaves[key] - value).abs() / value.abs().max()
        assert (error < 1e-4).double().mean() >= 0.97 and error.max() < 1e-2, key


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["double", "single"])
@pytest.mark.parametrize("seed", range(3))
def test_no_fragment_of_thin_small_and_large_surfels_is_lost(
    seed: int, dtype: torch.dtype, device: torch.device
) -> None:
    """Single-precision bounds (core/footprint.h) against the reference, which tries every pixel."""
    case = random_scene(100, 100 + seed, width=72, height=56)
    g = torch.Generator().manual_seed(seed)
    case.params["log_scales"] += 2.0 * torch.randn(100, 2, generator=g, dtype=torch.float64)
    case.params["opacity_logits"] -= 2.0  # so that few pixels end before the last surfel
    fragments = ops.trace(ops.project(*values_of(case, dtype, device), camera_of(case, dtype)))
    want = reference(case, [case.params[name] for name in GEOMETRY]).weight
    found = torch.zeros_like(want)
    found[fragments.pixel.cpu().long(), fragments.surfel.cpu().long()] = fragments.weight.detach().cpu().double()
    assert (want > 0).sum() > 1000
    assert ((found > 0) != (want > 0)).double().mean() <= (0 if dtype == torch.float64 else 1e-4)


def test_more_surfels_in_a_tile_than_a_warp_has_lanes_and_pixels_that_close(both) -> None:
    """Opaque layers end every pixel long before the tile's list ends; translucent ones use all of it."""
    case = random_scene(150, 7, 20, 20, scale=1.0)
    for logit, closes in ((3.0, True), (-4.0, False)):
        case.params["opacity_logits"] = torch.full((150,), logit, dtype=torch.float64)
        got, want = both(lambda where: render(case, torch.float64, where))
        compare(got, want)
        assert got.fragments.layout.handle.pairs > 3 * 64
        alpha = got.image[:, 3]
        assert alpha.min() > 0.99 if closes else alpha.max() < 0.9


def test_equal_depths_keep_the_order_of_the_surfels(device: torch.device) -> None:
    case = random_scene(70, 3, 20, 20, scale=2.0)
    same = {key: value[:1].expand_as(value).clone() for key, value in case.params.items()}
    same["opacity_logits"][:] = -5.0
    fragments = render(replace(case, params=same), torch.float64, device).fragments
    runs = torch.unique_consecutive(fragments.surfel.cpu())
    assert len(runs) > 70
    step = runs.diff()
    assert ((step == 1) | (runs[1:] == 0)).all()  # 0, 1, 2, ... again in every tile


@pytest.mark.parametrize("fewer", ["listed", "counted"])
def test_lists_that_differ_from_the_counts_stay_in_their_slots(fewer: str, device: torch.device) -> None:
    """As if a surfel's tiles were counted for a wider or narrower image than listed."""
    case = random_scene(30, 4, 160, 160)
    case.params["log_scales"][:4] += 3.0  # more tiles than a thread lists by itself
    case.params["opacity_logits"] -= 3.0
    large, small = (Camera(case.viewmat, case.K, size, size) for size in (160, 145))
    projection = ops.project(*values_of(case, device=device), large)  # rows for both
    geom, views = projection.geom, [projection, replace(projection, camera=small)]
    counted, listed = views if fewer == "listed" else reversed(views)
    bins, want = bin_cuda.tile_lists(geom, counted), bin_cuda.tile_lists(geom, listed)
    size = {"pairs": len(bins.slot), "width": listed.camera.width, "height": listed.camera.height}
    kernel("bin_fill", geom)(**listed.view(geom), **vars(bins), workspace=workspace("bin_fill", geom, **size))
    slots = bins.slot.cpu().long()
    assert torch.equal(slots.sort().values, torch.arange(len(slots)))
    rank = torch.searchsorted(bins.slot_start.cpu(), slots, right=True) - 1
    assert torch.equal(bins.surfel.cpu(), bins.order.cpu()[rank])
    if fewer == "listed":
        assert torch.equal(bins.tile_pairs, want.tile_pairs)
        pairs = int(want.tile_pairs[-1])
        assert pairs < len(slots) and torch.equal(bins.surfel[:pairs], want.surfel)
        layouts = [trace_cuda.blended(geom, listed, each) for each in (bins, want)]
        assert layouts[0].handle.fragments == layouts[1].handle.fragments > 0
        got, fragments = (trace_cuda.fill(geom, listed, layout) | layout.ids() for layout in layouts)
        assert all(torch.equal(got[name], value) for name, value in fragments.items())


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["double", "single"])
def test_every_order_of_the_threads_gives_the_same_bits(dtype: torch.dtype, device: torch.device) -> None:
    case = random_scene(50, 11, 40, 30)
    first, *others = in_orders(device, lambda: render(case, dtype, device), 3)
    for other in others:
        for name, array in first.fragments.arrays.items():
            assert torch.equal(array, other.fragments.arrays[name])
        assert torch.equal(first.image, other.image)
        for key, value in first.leaves.items():
            assert torch.equal(value, other.leaves[key]), key
        assert all(torch.equal(a, b) for a, b in zip(first.mean2d, other.mean2d, strict=True))


def test_gradients_of_weight_uv_and_depth_alone(device: torch.device, both) -> None:
    case = random_scene(30, 12, 24, 20)

    def run(where: torch.device) -> list[Tensor]:
        result = []
        for part in ("weight", "uv", "depth"):
            leaves = values_of(case, device=where, grad=True)
            fragments = ops.trace(ops.project(*leaves, camera_of(case)))
            direction = torch.sin(fragments.pixel.double() * 0.7 + fragments.surfel.double() * 1.3).double()
            (getattr(fragments, part) * direction).sum().backward()
            result += [leaf.grad.cpu() for leaf in leaves]
        return result

    got, want = both(run)
    for a, b in zip(got, want, strict=True):
        assert relative(a, b) < 1e-10


def test_wrong_arrays_are_refused(device: torch.device) -> None:
    case = random_scene(10, 0, 20, 20)
    leaves = values_of(case, device=device)
    projection = ops.project(*leaves, camera_of(case))
    fragments = ops.trace(projection)
    far = torch.zeros(len(fragments), 3, device="meta")
    moved = [leaf.to("meta") if i == 2 else leaf for i, leaf in enumerate(leaves)]
    sites = {key: case.params[key].to("meta" if key == "sv_rgb" else device) for key in SV_KEYS}
    shifted = torch.zeros(10 * 16 + 1, device=device, dtype=torch.float64)[1:].view(10, 16)
    few, mask = torch.zeros(3, 3, device=device).double(), torch.ones(400, dtype=torch.bool, device="meta")
    camera, frames = projection.camera, projection.frames
    grid = ops.FieldGeometry(4, False, (0.0, 0.0, 0.0), 1.0)
    for match, call in {
        "residual must have shape": lambda: ops.blended_image(fragments, projection, frames[:, :3], residual=few),
        "residual is on device 'meta'": lambda: ops.blended_image(fragments, projection, frames[:, :3], residual=far),
        "mask is on device 'meta'": lambda: fragments.masked_counts(mask),
        "log_scales is on device 'meta', it must be on": lambda: ops.project(*moved, camera),
        "frames is on device 'meta'": lambda: ops.fragment_residual(fragments, frames.to("meta"), grid, ()),
        "sv_rgb is on device 'meta'": lambda: ops.view_color("sv", sites, leaves[0], camera.exact_center),
        "16 bytes": lambda: ops.trace(replace(projection, geom=shifted)),
    }.items():
        with pytest.raises(ValueError, match=match):
            call()
    with pytest.raises(TypeError, match="float32 or float64 tensors, not torch.float16"):
        ops.project(*(leaf.half() for leaf in leaves), camera)


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("seed", range(2))
def test_discs_across_the_camera_plane_are_listed_where_they_show(
    seed: int, dtype: torch.dtype, device: torch.device, cpu
) -> None:
    case = crossing_scene(60, seed, 300, 200)
    projection = ops.project(*values_of(case, dtype, device), camera_of(case, dtype))
    fragments = ops.trace(projection, EXACT_RIM)
    weights = reference(case, values_of(case)).weight
    shown = tiles_reached(weights, case.width, case.height)
    seen = projection.radii[:, 0].cpu() > 0
    assert not ((shown > 0) & ~seen).any() and (seen & (shown == 0)).sum() <= 10
    assert fragments.layout.handle.pairs <= 1.25 * int(shown.sum())
    count = int((weights > 0).sum())
    assert abs(fragments.surfel.shape[0] - count) <= (0 if dtype == torch.float64 else 1e-4 * count)


def test_free_memory_is_looked_up_for_longer_lists_and_now_and_then(monkeypatch: pytest.MonkeyPatch) -> None:
    card = SimpleNamespace(device=torch.device("cuda", 7), element_size=lambda: 4)
    view = SimpleNamespace(camera=SimpleNamespace(width=10, height=10))
    capacities = iter([3 * capacity.FEW, 4 * capacity.FEW, capacity.FEW])
    asked = []
    monkeypatch.setattr(capacity, "_rooms", {})
    monkeypatch.setattr(capacity, "fragment_capacity", lambda geom: asked.append(1) or next(capacities))
    few = capacity.FEW
    for count in (few, 2 * few, 2 * few - 1, few + 1):
        capacity.check_capacity(card, view, count, 0)
    assert len(asked) == 1
    capacity.check_capacity(card, view, 3 * few + 1, 0)  # the longest yet, and free memory has grown
    assert len(asked) == 2
    for _ in range(capacity.LISTS_PER_CHECK - 1):
        capacity.check_capacity(card, view, 2 * few, 0)
    with pytest.raises(ops.TooManyFragments, match=f"there is room for {few:,}"):
        capacity.check_capacity(card, view, 2 * few, 0)
    assert len(asked) == 3


def test_a_disc_whose_centre_is_a_million_pixels_away(device: torch.device) -> None:
    case = far_floor()
    fragments = ops.trace(ops.project(*values_of(case, device=device), camera_of(case)), EXACT_RIM)
    want = reference(case, values_of(case)).weight
    assert fragments.surfel.shape[0] == int((want > 0).sum()) > 300
