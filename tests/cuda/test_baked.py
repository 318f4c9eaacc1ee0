"""The baked renderer on CUDA against the CPU.

The texture unit's 8-bit weights change colours of textured fragments by up to 1.2e-3, with alpha by 6.3e-3.
"""

import warnings
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from bitymi_ns.bake import bake_field, export
from bitymi_ns.bundle import read as bundle_read
from bitymi_ns.bundle import read_bundle
from bitymi_ns.bundle.bake_options import BakeOptions
from bitymi_ns.measure.stability.scenes import extreme_scenes
from bitymi_ns.ops import baked_cuda, baked_renderer
from bitymi_ns.ops.backend import module
from bitymi_ns.ops.baked import draw
from bitymi_ns.ops.baked_cuda import Sheet, draws_blocks
from bitymi_ns.ops.baked_renderer import BakedRenderer
from bitymi_ns.ops.view_kinds import VIEW_COLORS
from bitymi_ns.scene import Camera
from bitymi_ns.scene.baked import FAST, BakedScene
from bitymi_ns.scene.scene_renderer import SceneRenderer
from tests.bake.conftest import make_surfels
from tests.bake.test_real_scene import real_scene
from tests.bundle.compact_scene import make_codes, write_compact
from tests.cuda.baked_scenes import (
    FAR,
    FLIP,
    camera_of,
    cut_out,
    front,
    layered,
    most,
    scene_of,
    textured,
    to_average,
)
from tests.cuda.conftest import in_orders
from tests.ops.golden import SceneCase, atlas_of, load_golden, random_scene
from tests.ops.test_view_color import reduced_parameters

FIELDS = ("rgb", "alpha", "beta", "depth", "normal", "overdraw")
STEP = 1 / 255
TEXEL = 2 / 256
"""Bound of texel differences on a GPU, relative to their range: texture weights have 8 fractional bits along each axis,
with unspecified rounding."""
EXTREME = extreme_scenes()


def check(
    scene: BakedScene, camera: Camera, device: torch.device, cpu, background: Tensor | None = None, close: float = STEP
) -> float:
    """Compare a view on the device with the CPU's: colours to `close`, except one pixel in a thousand; returns the
    largest colour difference."""
    got = scene.to(device).render(camera, None if background is None else background.to(device), maps=True)
    with cpu():
        want = scene.render(camera, background, maps=True)
    for name in FIELDS:
        a, b = getattr(got, name).cpu(), getattr(want, name)
        assert a.shape == b.shape and a.dtype == b.dtype and a.isfinite().all(), name
        step = close if name == "rgb" else 0.5 if name == "overdraw" else 1e-4 * max(1.0, float(b.abs().max()))
        assert ((a - b).abs() <= step).double().mean() >= 0.999, name
    return float((got.rgb.cpu() - want.rgb).abs().max())


def check_drawn(
    scene: BakedScene, photo_pixel: float, device: torch.device, cpu, steps: dict[str, float], furthest: float
) -> None:
    """Compare a view of another size with the CPU's: images to `steps` of their largest value, except two pixels in a
    thousand, and colours to `furthest`."""
    background = torch.tensor([0.2, 0.4, 0.6])
    got = draw(scene.to(device), [front()], background.to(device), list(steps), photo_pixel)
    with cpu():
        want = draw(scene, [front()], background, list(steps), photo_pixel)
    for name, step in steps.items():
        a, b = got[name].cpu().double(), want[name].double()
        step = step if name in ("rgb", "overdraw") else step * max(1.0, float(b.abs().max()))
        assert ((a - b).abs() <= step).double().mean() >= 0.998, name
    assert (got["rgb"].cpu() - want["rgb"]).abs().max() < furthest


def test_golden_textured_scene(device: torch.device, cpu) -> None:
    golden = load_golden("textured")
    params = {name: value.float() for name, value in golden.params.items()}
    scene = BakedScene(params, "sv", *atlas_of(golden))
    check(scene, camera_of(golden), device, cpu, golden.background.float())
    got = scene.to(device).render(camera_of(golden), golden.background.float().to(device), maps=True)
    assert (got.rgb.cpu().double() - golden.outputs["rgb"]).abs().max() < most(device, STEP, STEP + TEXEL + FLIP)
    differs = got.overdraw[..., 0].cpu().double() != golden.outputs["overdraw"].double()
    assert differs.double().mean() <= most(device, 0, 1e-3)


def test_the_low_pass_stays_where_the_near_plane_cuts_the_kernel(device: torch.device, cpu) -> None:
    """Surfels right before the camera, clipped by the near plane within the reach of their low passes."""
    golden = load_golden("inside_the_scene")
    check(scene_of(golden), camera_of(golden), device, cpu, golden.background.float())


@pytest.mark.parametrize("seed", range(2))
def test_random_scenes(seed: int, device: torch.device, cpu) -> None:
    case = random_scene(120, seed, width=61, height=45)
    off = check(scene_of(case), camera_of(case), device, cpu, case.background.float(), close=1e-4)
    assert off < most(device, 1e-4, FLIP)


@pytest.mark.parametrize("case", EXTREME, ids=[case.name for case in EXTREME])
def test_numbers_that_misbehave(case: SceneCase, device: torch.device, cpu) -> None:
    case = replace(case, width=min(case.width, 600), height=min(case.height, 600))  # longer ones: test_sizes
    check(scene_of(case), camera_of(case), device, cpu, case.background.float())


@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32], ids=["uint8", "half"])
def test_textures_extents_and_constant_residuals(dtype: torch.dtype, device: torch.device, cpu) -> None:
    off = check(textured(60, 0, dtype), front(), device, cpu, torch.tensor([0.2, 0.4, 0.6]))
    assert off < most(device, 3e-3, TEXEL + FLIP)


@pytest.mark.parametrize("photo_pixel", [1.0, 0.2])
@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32], ids=["uint8", "half"])
def test_alpha_texels(dtype: torch.dtype, photo_pixel: float, device: torch.device, cpu) -> None:
    """The texture unit's weights change sigma, and so what is behind: more than colours."""
    steps = {"rgb": STEP, "alpha": STEP, "beta": STEP, "depth": STEP, "overdraw": 0.5}
    no_constants = {"mean_alpha": None, "mean_residual": None}
    for changed in ({}, {"weight_bound": 0.0}, {"alpha_scale": 0.0}, no_constants):
        scene = replace(cut_out(60, 0, dtype), **changed)
        check_drawn(scene, photo_pixel, device, cpu, steps, most(device, 8e-3, 2 * TEXEL + FLIP))


@pytest.mark.parametrize("alpha, share, least", FAR)
def test_far_views_are_averages_of_near_ones(alpha: bool, share: float, least: float, device: torch.device) -> None:
    scene, camera = layered(alpha)
    assert to_average(scene.to(device), camera, share) > least


def test_opaque_alpha_texels_change_nothing(device: torch.device) -> None:
    scene = textured(60, 0)
    assert scene.atlas is not None
    scene.atlas[..., 3] = 128
    ones = replace(scene, alpha_scale=255 / 128, mean_alpha=torch.ones(60))
    plain, cut = (s.to(device).render(front(), maps=True) for s in (scene, ones))
    for name in FIELDS:
        torch.testing.assert_close(getattr(cut, name), getattr(plain, name), rtol=0, atol=2e-6, msg=name)


@pytest.mark.parametrize("kind", VIEW_COLORS)
def test_view_colours_full_and_reduced(kind: str, device: torch.device, cpu) -> None:
    scene = textured(40, 1, kind=kind)
    check(scene, front(), device, cpu)
    geometry = {k: v for k, v in scene.surfels.items() if k not in VIEW_COLORS[kind].names}
    scene.surfels = geometry | reduced_parameters(kind, 40, torch.float32)
    check(scene, front(), device, cpu)
    scene.surfels["view_span"][7, 1] = 33
    with pytest.raises(ValueError, match="surfel 7"):
        scene.to(device).render(front(8, 8))


@pytest.mark.parametrize(
    "kind, trim",
    [("sv", {"sv_sites": 3, "sv_log_tau": 3, "sv_rgb": 3}), ("sh", {"sh_rest": 3}), ("sh", {"sh_rest": 0})],
)
def test_other_numbers_of_sites_and_coefficients(kind: str, trim: dict[str, int], device: torch.device, cpu) -> None:
    scene = textured(20, 2, kind=kind)
    scene.surfels = {name: v[:, : trim[name]] if name in trim else v for name, v in scene.surfels.items()}
    with cpu():
        plain = {name: value.contiguous() for name, value in scene.surfels.items()}
    scene.surfels = plain
    check(scene, front(32, 32), device, cpu)


@pytest.mark.parametrize("format", ["bc7", "uint8", "fp16"])
def test_bundles(format: str, device: torch.device, cpu, tmp_path) -> None:
    with cpu():
        made = real_scene(make_surfels, count=60)
        export(bake_field(made, options=BakeOptions(format=format)), tmp_path / "b")
        bundle = read_bundle(tmp_path / "b")
        undecoded = read_bundle(tmp_path / "b", decode=False)
    assert check(bundle.scene, front(48, 40), device, cpu) < most(device, 3e-3, TEXEL + FLIP)
    if format != "bc7":
        assert bundle.scene.blocks is None and torch.equal(undecoded.scene.atlas, bundle.scene.atlas)
        return
    assert undecoded.scene.atlas is None and torch.equal(undecoded.scene.blocks, bundle.scene.blocks)
    layers, height, width = bundle.scene.atlas.shape[:3]
    assert bundle.scene.blocks.shape == (layers, height // 4, width // 4, 16)
    scene = undecoded.scene
    with cpu(), pytest.raises(ValueError, match="decode=True"):
        scene.render(front(8, 8))
    check_blocks(scene, bundle.scene, device, cpu)


def check_blocks(scene: BakedScene, want: BakedScene, device: torch.device, cpu) -> None:
    """Check that BC7 blocks are drawn like their decoded texels: by the texture unit, or decoded with a warning."""
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        got = scene.to(device).render(front(48, 40)).rgb.cpu()
    with cpu():
        rgb = want.render(front(48, 40)).rgb
    assert (got - rgb).abs().max() < most(device, 3e-3, TEXEL + FLIP)
    unit = draws_blocks(device)
    assert unit == (device.type == "cuda"), "a card's texture unit decodes BC7"
    assert [str(each.message) for each in told if "BC7" in str(each.message)] == (
        []
        if unit
        else [f"the device '{device}' draws no BC7 textures: the atlas was decoded, at four times the memory"]
    )


def test_a_compact_bundle_of_many_texels(device: torch.device, cpu, tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bundle_read, "LARGE_ATLAS", 0)
    with cpu():
        scene = read_bundle(write_compact(tmp_path / "b", make_codes(count=60)), decode=False).scene
        want = replace(scene, atlas=baked_cuda.decoded(scene.blocks))
    check_blocks(scene, want, device, cpu)


def test_the_order_of_threads_changes_nothing(device: torch.device) -> None:
    if device.type == "cuda":
        pytest.skip("the emulation sets the order")
    scene, camera = textured(50, 3), front(40, 40)
    first, *others = in_orders(device, lambda: scene.render(camera, maps=True), 5)
    for other in others:
        for name in FIELDS:
            assert torch.equal(getattr(other, name), getattr(first, name)), name


def test_views_drawn_together(device: torch.device) -> None:
    scene = textured(50, 4).to(device)
    cameras = [front(50, 30, distance) for distance in (3.0, 4.0, 60.0)]
    background = torch.tensor([0.1, 0.2, 0.3], device=device)
    together = scene.render_views(cameras, background, FIELDS)
    for i, camera in enumerate(cameras):
        alone = scene.render(camera, background, maps=True)
        for name in FIELDS:
            assert torch.equal(together[name][i], getattr(alone, name)), name


@pytest.mark.parametrize("least, share", [(0.0, (1.5, 1e9)), (FAST, (0.0, 1.0))])
def test_pixels_end_at_the_least_transmittance(least: float, share: tuple, device: torch.device, cpu) -> None:
    """All surfels are blended with 0; with a large one pixels end early."""
    case = random_scene(200, 10, width=20, height=16)
    case.params["opacity_logits"] += 4.0
    scene, camera = scene_of(case, transmittance_min=least), camera_of(case)
    check(scene, camera, device, cpu)
    blended, usual = (each.to(device).render(camera, maps=True).overdraw.sum() for each in (scene, scene_of(case)))
    assert share[0] * usual < blended < share[1] * usual


@pytest.mark.parametrize("views", [1, 2])
def test_recorded_graph(views: int, device: torch.device) -> None:
    if device.type != "cuda":
        with pytest.raises(ValueError, match="GPU"):
            BakedRenderer(textured(4, 0), 8, 8, graph=True)
        return
    scene = textured(50, 7).to(device)
    renderer = BakedRenderer(scene, 40, 30, views, graph=True)
    for distance in (3.0, 5.0):
        cameras = [front(40, 30, distance + i) for i in range(views)]
        assert torch.equal(renderer.draw(cameras)["rgb"], scene.render_views(cameras)["rgb"])


def test_the_default_dtype_does_not_matter(device: torch.device) -> None:
    scene, camera = textured(50, 7).to(device), front()
    want = scene.render(camera).rgb
    torch.set_default_dtype(torch.float64)
    try:
        got = scene.render(camera).rgb
    finally:
        torch.set_default_dtype(torch.float32)
    assert torch.equal(got, want)


@pytest.mark.parametrize("maps", [False, True])
def test_the_renderer_of_any_camera(maps: bool, device: torch.device) -> None:
    scene = textured(50, 7).to(device)
    renderer, white = SceneRenderer(scene, kept=2), torch.ones(3, device=device)
    drawn = []
    for width, distance, background in [
        *((40, d, white) for d in (3.0, 4.0, 5.0, 3.0)),
        *((40, 3.0, background) for background in (0.5 * white, None, None)),
        *((w, 4.0, None) for w in (30, 30, 20, 20, 40, 40)),
    ]:
        camera = front(width, 30, distance)
        drawn.append((renderer.render(camera, background, maps), scene.render(camera, background, maps)))
        assert len(renderer._renderers) <= 2
    for got, want in drawn:  # no frame overwrote an earlier one
        for name in FIELDS:
            a, b = getattr(got, name), getattr(want, name)
            assert (a is b is None) or torch.equal(a, b), name
    near = replace(scene, photographed=torch.tensor([[0.0, 0.0, 0.0, 1e-3]]))  # a view far larger than the photographs
    only = SceneRenderer(near)
    for _ in range(3):
        assert torch.equal(only.render(front(40, 30)).rgb, near.render(front(40, 30)).rgb)
    assert not only._renderers


def test_threads_share_a_renderer(device: torch.device) -> None:
    scene = textured(50, 7).to(device)
    renderer, cameras = SceneRenderer(scene), [front(40, 30, 3.0 + i) for i in range(3)]
    with ThreadPoolExecutor(3) as threads:
        drawn = list(threads.map(renderer.render, 3 * cameras))
    for got, camera in zip(drawn, 3 * cameras, strict=True):
        assert torch.equal(got.rgb, scene.render(camera).rgb)


@pytest.mark.parametrize("width, height", [(1, 1), (17, 3), (3, 33), (8200, 2), (2, 8200)])
def test_sizes(width: int, height: int, device: torch.device, cpu) -> None:
    case = random_scene(40, 8, width, height)
    case.K[0, 0] = case.K[1, 1] = float(max(width, height))  # avoids grazing rays, where float32 is inaccurate
    check(scene_of(case), camera_of(case), device, cpu)


def test_nothing_to_see(device: torch.device) -> None:
    background = torch.tensor([0.2, 0.4, 0.6], device=device)
    empty = BakedScene(make_surfels(0), "sv", torch.zeros(0, 5, dtype=torch.int32), None).to(device)
    behind = textured(30, 0).to(device)
    for scene, camera in ((empty, front(20, 20)), (behind, front(20, 20, -50.0))):
        output = scene.render(camera, background, maps=True)
        assert torch.equal(output.rgb, background.expand_as(output.rgb)) and not output.overdraw.any()


def test_errors(device: torch.device, cpu) -> None:
    scene = textured(4, 0).to(device)
    double = BakedScene({name: v.double() for name, v in scene.surfels.items()}, "sv", scene.tiles, None)
    with pytest.raises(TypeError, match="float32 surfels, but means is torch.float64"):
        double.render(front(8, 8))
    skewed, memory = front(8, 8), module(device).baked_memory
    skewed.K[0, 1] = 1.0
    wide = torch.zeros(1, 4, 131076, 4, dtype=torch.uint8)
    for match, call in {
        "one size, not .*8.*9": lambda: scene.render_views([front(8, 8), front(8, 9)]),
        "one size, not ..$": lambda: scene.render_views([]),
        "skew": lambda: scene.render(skewed),
        "no image 'colour'": lambda: scene.render_views([front(8, 8)], None, ("colour",)),
        "draws .1, 8, 8.": lambda: BakedRenderer(scene, 8, 8).draw([front(8, 9)]),
        "16777217, at most 16777216": lambda: memory(2**24 + 1, 1, 8, 8, 32, 1, False),
        "has 33 slots, it needs a multiple of 32": lambda: memory(1, 1, 8, 8, 33, 1, False),
        "too many views, pixels or pairs": lambda: memory(1, 1, 2**20, 2**20, 32, 1, False),
        "come to 131076 x 4 texels, a texture has 131072 x 65536 at most: bake fewer": lambda: baked_cuda.Atlas.of(
            wide, False, device
        ),
        "a frame can have": lambda: BakedRenderer(scene, 8, 8)._resize(2**40),
    }.items():
        with pytest.raises(ValueError, match=match):
            call()
    assert Sheet.of(9, 8192, 4096) == (2, 4096, 8192)
    if device.type == "cpu":
        with cpu():
            with pytest.raises(RuntimeError, match="move the scene"):
                scene.render_views([front(8, 8)])
            with pytest.raises(RuntimeError, match="on the CPU"):
                BakedRenderer(scene, 8, 8)


@pytest.mark.parametrize("photo_pixel", [0.2, 0.45, 2.5])
@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32], ids=["uint8", "half"])
def test_views_of_another_size(photo_pixel: float, dtype: torch.dtype, device: torch.device, cpu) -> None:
    """Widened surfels and texels of their level; half floats round differently."""
    steps = {"rgb": STEP, "alpha": 1e-4, "beta": 1e-4, "depth": 1e-4, "overdraw": 0.5}
    check_drawn(textured(80, 4, dtype), photo_pixel, device, cpu, steps, most(device, 6e-3, 2 * TEXEL + FLIP))


def test_a_small_view_has_samples(device: torch.device, cpu) -> None:
    scene = textured(60, 0)
    scene.photographed = torch.cat([scene.surfels["means"], torch.full((60, 1), (60 * 55) ** 0.5 / 4)], 1)
    camera = front(120, 88).scaled(0.25)
    check(scene, camera, device, cpu)
    views = scene.to(device).render_views([camera, camera], None, ("packed", "rgb"))
    assert views["packed"].shape == (2, 22, 30, 1) and torch.equal(views["rgb"][0], views["rgb"][1])
    red = views["packed"][0, ..., 0] & 255
    assert (red.float() - views["rgb"][0, ..., 0].clamp(0, 1) * 255).abs().max() <= 0.51


def test_frames_are_begun_on_the_device_of_the_scene(device: torch.device, monkeypatch: pytest.MonkeyPatch) -> None:
    """torch records a graph on a stream of the current device, which may be another one."""
    entered = []

    @contextmanager
    def on_device(of: torch.device) -> Iterator[None]:
        entered.append(of)
        yield

    renderer = BakedRenderer(textured(4, 0).to(device), 8, 9)
    monkeypatch.setattr(baked_renderer, "on_device", on_device)
    renderer.draw([front(8, 9)])
    assert [of.type for of in entered] == [device.type]
