"""Rendering through WebGPU against the CPU.

On the golden scenes, with single-precision targets, images agreed to 2.5e-5 on llvmpipe; the bounds allow for a GPU's
exponentials. With a weight bound, weights are estimated from above (shaders/draw.wgsl), which adds residuals that the
CPU does not: at most the bound times the residual.
"""

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from bitymi_ns.codec.bc7_encode import bc7_encoder
from bitymi_ns.measure.stability.scenes import extreme_scenes
from bitymi_ns.ops import webgpu
from bitymi_ns.ops.baked import draw
from bitymi_ns.ops.baked_cpu import draw as draw_on_cpu
from bitymi_ns.ops.baked_scene import decode_bc7
from bitymi_ns.ops.parameters import GEOMETRY
from bitymi_ns.ops.view_kinds import VIEW_COLORS
from bitymi_ns.ops.webgpu import device, on_device
from bitymi_ns.scene import Camera
from bitymi_ns.scene.baked import BakedScene
from tests.cuda.baked_scenes import FAR, camera_of, front, layered, scene_of, textured, to_average
from tests.ops.golden import GOLDEN_NAMES, SceneCase, atlas_of, crossing_scene, load_golden, reference
from tests.ops.test_view_color import reduced_parameters

FIELDS = ("rgb", "alpha", "beta", "depth", "normal", "overdraw")
PICTURE = ("rgb", "alpha", "beta", "depth")
"""Images compared: not the normal, whose sign is undefined edge-on, nor overdraw, which counts fragments behind the end
of a pixel within their batch."""
STEP = 1 / 255
EXTREME = extreme_scenes()


def check(
    scene: BakedScene, camera: Camera, background: Tensor | None = None, fields: Sequence[str] = FIELDS
) -> Tensor:
    """Compare a view with the CPU's: colours to a step, except one pixel in a thousand; returns the colour differences.
    A texture unit's weights have 8 fractional bits, which alpha carries to all images."""
    got = replace(scene, through_webgpu=True).render(camera, background, maps=True)
    want = scene.render(camera, background, maps=True)
    for name in fields:
        a, b = getattr(got, name), getattr(want, name)
        assert a.shape == b.shape and a.dtype == b.dtype and a.isfinite().all(), name
        share = STEP if scene.alpha_scale else 1e-3
        step = STEP if name == "rgb" else 0.5 if name == "overdraw" else share * max(1.0, float(b.abs().max()))
        assert ((a - b).abs() <= step).double().mean() >= 0.999, name
    return (got.rgb - want.rgb).abs()


@pytest.mark.parametrize("name", GOLDEN_NAMES)
def test_golden_scenes(name: str) -> None:
    golden = load_golden(name)
    params = {key: value.float() for key, value in golden.params.items()}
    scene = BakedScene(params, "sv", *atlas_of(golden)) if golden.tiles else scene_of(golden)
    camera = camera_of(golden)
    assert check(scene, camera, golden.background.float()).max() < STEP
    got = replace(scene, through_webgpu=True).render(camera, golden.background.float())
    assert (got.rgb.double() - golden.outputs["rgb"]).abs().max() < STEP


@pytest.mark.parametrize("case", EXTREME, ids=[case.name for case in EXTREME])
def test_numbers_that_misbehave(case: SceneCase) -> None:
    case = replace(case, width=min(case.width, 300), height=min(case.height, 300))
    check(scene_of(case), camera_of(case), case.background.float(), PICTURE)


def rectangles(scene: on_device.SceneOnDevice) -> NDArray[np.float32]:
    """Read the rectangles of the latest view's surfels, front to back: [M, 6] axis (unit vector), middle, half size
    along the axis and across, pixels: columns of `Seen` in scene.wgsl."""
    queue = scene._device.queue
    count = int(np.frombuffer(queue.read_buffer(scene._visible), np.uint32)[0])
    order = np.frombuffer(queue.read_buffer(scene._order[0]), np.uint32)[:count]
    return np.frombuffer(queue.read_buffer(scene._seen), np.float32).reshape(-1, 24)[order, 16:22]


def covered(rectangle: NDArray[np.float32], width: int, height: int) -> int:
    """Count the pixels of the image within a row of `rectangles`."""
    axis, middle, half_size = rectangle.reshape(3, 2).astype(np.float64)
    y, x = np.mgrid[:height, :width] + 0.5 - middle[::-1, None, None]
    along, across = x * axis[0] + y * axis[1], y * axis[0] - x * axis[1]
    return int(((np.abs(along) < half_size[0]) & (np.abs(across) < half_size[1])).sum())


@pytest.mark.parametrize("photo_pixel", [1.0, 0.5])
@pytest.mark.parametrize("seed", range(3))
def test_discs_across_the_camera_plane_are_drawn_where_they_show(seed: int, photo_pixel: float) -> None:
    """Discs without an ellipse are culled beyond the borders; others get at most the box of their visible part."""
    case = crossing_scene(80, seed, 150, 120)
    scene, camera = scene_of(case), camera_of(case)
    device = on_device.SceneOnDevice(scene)
    counts = device.draw(camera, "overdraw", 1, photo_pixel)[..., 0]
    want = draw_on_cpu(scene, [camera], None, ("overdraw",), photo_pixel)["overdraw"][0, ..., 0].numpy()
    assert (np.abs(counts - want) > 0.5).mean() < 2e-3
    if photo_pixel < 1:
        return
    shows = (reference(case, [case.params[name] for name in GEOMETRY]).weight > 0).view(120, 150, -1)
    boxes = [(x.any(0).sum() * x.any(1).sum()).item() for x in shows.unbind(-1) if x.any()]
    drawn = [covered(r, 150, 120) for r in rectangles(device)]
    assert len(drawn) <= len(boxes) + 8  # not beyond a single border
    assert sum(drawn) <= 1.25 * sum(boxes)


@pytest.mark.parametrize("seed", (0, 3))
def test_discs_far_larger_than_their_depth_are_drawn_whole(seed: int) -> None:
    """Their corners are differences of numbers as large as the disc, divided by a small depth."""
    case = crossing_scene(40, seed, 320, 240)
    case.params["log_scales"] += 5.0 + seed
    scene, camera = scene_of(case, near=0.02), camera_of(case)
    counts = on_device.SceneOnDevice(scene).draw(camera, "overdraw", 1)[..., 0]
    want = draw_on_cpu(scene, [camera], None, ("overdraw",))["overdraw"][0, ..., 0].numpy()
    assert np.abs(counts - want).max() <= 1 and (np.abs(counts - want) > 0.5).mean() < 1e-3


@pytest.mark.parametrize("kind", VIEW_COLORS)
@pytest.mark.parametrize("reduced", [False, True], ids=["all terms", "reduced"])
def test_view_colours(kind: str, reduced: bool) -> None:
    scene = replace(textured(40, 1, kind=kind), weight_bound=0.0)
    if reduced:
        scene.surfels = {k: v for k, v in scene.surfels.items() if k not in VIEW_COLORS[kind].names}
        scene.surfels |= reduced_parameters(kind, 40, torch.float32)
    assert check(scene, front()).mean() < 0.1 * STEP


def test_texels_are_fetched_within_their_tile() -> None:
    for dtype in (torch.uint8, torch.float32):
        scene = replace(textured(60, 0, dtype), weight_bound=0.0)
        # a texture unit's weights have 8 fractional bits
        assert check(scene, front(), torch.tensor([0.2, 0.4, 0.6])).max() < 2 * STEP


def cutting(scene: BakedScene) -> BakedScene:
    """Give the scene alpha texels from its atlas's fourth channel, and no weight bound."""
    mean = torch.randint(0, 256, (len(scene),), generator=torch.Generator().manual_seed(5)) / 128
    return replace(scene, alpha_scale=255 / 128, mean_alpha=mean, weight_bound=0.0)


@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32])
def test_alpha_texels_cut_surfels(dtype: torch.dtype) -> None:
    scene = cutting(textured(60, 0, dtype))
    assert check(scene, front(), torch.tensor([0.2, 0.4, 0.6])).max() < 2 * STEP
    opaque = replace(scene, alpha_scale=0.0, mean_alpha=None)
    assert (scene.render(front()).alpha - opaque.render(front()).alpha).abs().mean() > 0.01


@pytest.fixture
def as_a_card(monkeypatch: pytest.MonkeyPatch) -> None:
    """Keep BC7 blocks on the device even for a software adapter."""
    monkeypatch.setattr(on_device, "in_software", lambda: False)


def encoded(scene: BakedScene) -> BakedScene:
    """Replace a scene's texels by BC7 blocks and what these decode to."""
    blocks = [bytes(bc7_encoder("ultrafast")(page.numpy())) for page in scene.atlas]
    height, width = scene.atlas.shape[1:3]
    stored = np.stack([np.frombuffer(page, np.uint8).reshape(height // 4, width // 4, 16) for page in blocks])
    atlas = np.stack([decode_bc7(page, width, height) for page in blocks])
    return replace(scene, atlas=torch.from_numpy(atlas), blocks=torch.from_numpy(stored))


def test_the_processor_gets_decoded_texels(monkeypatch: pytest.MonkeyPatch) -> None:
    """A software adapter would decode a block per texel fetch."""
    scene = replace(encoded(textured(20, 0)), atlas=None, weight_bound=0.0)
    formats: list[str] = []
    monkeypatch.setattr(on_device, "in_software", lambda: True)
    made = on_device.SceneOnDevice._pages
    monkeypatch.setattr(
        on_device.SceneOnDevice,
        "_pages",
        lambda self, format, *rest: formats.append(format) or made(self, format, *rest),
    )
    webgpu.draw(scene, [front()], None, ["rgb"])
    assert formats == ["rgba8unorm"]


def test_bc7_blocks_are_drawn_by_the_texture_unit_as_they_are_decoded(as_a_card: None) -> None:
    scene = replace(encoded(textured(60, 0)), weight_bound=0.0)
    assert check(scene, front()).max() < 2 * STEP
    # the blocks suffice
    alone = replace(scene, atlas=None, through_webgpu=True).render(front())
    assert (alone.rgb - replace(scene, through_webgpu=True).render(front()).rgb).abs().max() == 0
    assert check(cutting(scene), front()).max() < 2 * STEP


@pytest.mark.parametrize("alpha", [False, True])
def test_more_batches_come_closer_to_the_weight_bound(alpha: bool) -> None:
    scene, camera = textured(200, 3), front()
    scene = replace(cutting(scene) if alpha else scene, weight_bound=0.05)
    want = scene.render(camera).rgb
    off = [
        float((webgpu.draw(scene, [camera], None, ["rgb"], layers=n)["rgb"][0] - want).abs().mean()) for n in (1, 8, 64)
    ]
    assert off[0] > off[1] > off[2] and off[2] < 0.5 * STEP


def test_surfels_of_equal_depth_are_drawn_in_their_order() -> None:
    """A few thousand, so that the sort has several blocks."""
    n = 3000
    g = torch.Generator().manual_seed(0)
    scene = replace(textured(n, 4), atlas=None, weight_bound=0.0, tiles=torch.zeros(n, 5, dtype=torch.int32))
    scene.surfels["means"] = torch.rand(n, 3, generator=g) * 2 - 1
    scene.surfels["means"][:, 2] = (torch.rand(n, generator=g) * 8).round() / 8
    scene.surfels["log_scales"] = torch.full((n, 2), -3.0)
    assert check(scene, front(), fields=PICTURE).max() < STEP


def test_a_scene_without_surfels_and_one_far_away() -> None:
    empty = textured(3, 0)
    empty = replace(
        empty,
        surfels={k: v[:0] for k, v in empty.surfels.items()},
        tiles=empty.tiles[:0],
        extent=None,
        mean_residual=None,
    )
    drawn = replace(empty, through_webgpu=True).render(front(), torch.tensor([0.25, 0.5, 1.0]))
    assert (drawn.rgb == torch.tensor([0.25, 0.5, 1.0])).all() and (drawn.alpha == 0).all()
    far = replace(textured(20, 0), weight_bound=0.0)
    far.surfels["means"] = far.surfels["means"] + torch.tensor([4096.0, -8192.0, 2048.0])
    camera = front()
    viewmat = camera.viewmat.clone()
    viewmat[:3, 3] -= torch.tensor([4096.0, -8192.0, 2048.0])
    check(far, replace(camera, viewmat=viewmat))


def photographed(scene: BakedScene, camera: Camera) -> BakedScene:
    """Make the scene photographed by this camera, 4 units away."""
    rate = float(torch.sqrt(camera.K[0, 0] * camera.K[1, 1])) / 4
    points = torch.cat([scene.surfels["means"], torch.full((len(scene), 1), rate)], 1)
    return replace(scene, photographed=points, weight_bound=0.0)


@pytest.mark.parametrize("alpha", [False, True])
@pytest.mark.parametrize("share", [2.0, 0.5, 0.12])
def test_views_of_other_sizes(share: float, alpha: bool) -> None:
    camera = front(240, 176)
    camera.K[:2, :2] *= 2.0
    for dtype in (torch.uint8, torch.float32):
        scene = photographed(textured(300, 3, dtype), camera)
        scene = cutting(scene) if alpha else scene
        off = check(scene, camera.scaled(share), torch.tensor([0.2, 0.4, 0.6]), ("rgb", "alpha", "depth"))
        assert off.mean() < 0.1 * STEP and off.max() < 2 * STEP, (off.mean() / STEP, off.max() / STEP)


def test_levels_of_blocks_and_of_tiles_without_a_mean(as_a_card: None) -> None:
    camera = front(240, 176)
    scene = encoded(photographed(textured(60, 0), camera))
    for each in (scene, replace(scene, mean_residual=None)):
        assert check(each, camera.scaled(0.3)).max() < 2 * STEP


@pytest.mark.parametrize("alpha, share, least", FAR)
def test_far_views_are_averages_of_near_ones(alpha: bool, share: float, least: float) -> None:
    scene, camera = layered(alpha)
    assert to_average(replace(scene, through_webgpu=True), camera, share) > least


def test_what_was_changed_is_drawn_anew() -> None:
    scene = replace(textured(20, 0), weight_bound=0.0, through_webgpu=True)
    first = scene.render(front(16, 16)).rgb
    scene.surfels["opacity_logits"] -= 3
    assert (scene.render(front(16, 16)).rgb - first).abs().max() > 0.01


def test_what_cannot_be_drawn_is_refused() -> None:
    scene = replace(textured(5, 0), through_webgpu=True)
    with pytest.raises(ValueError, match="packed"):
        draw(scene, [front()], None, ["packed"])
    scene.tiles = scene.tiles.clone()
    scene.tiles[1, 0] = 10_000
    with pytest.raises(ValueError, match="surfel 1"):
        scene.render(front())


@pytest.mark.parametrize(
    "limit, most, said",
    [
        ("max-texture-array-layers", 1, "texture array layers is 1, 2 are needed"),
        ("max-texture-dimension-2d", 100, "texture dimension 2d is 100, 1600 are needed"),
        ("max-storage-buffer-binding-size", 500, "storage buffer binding size is 500, 19600 are needed"),
        ("max-buffer-size", 500, "buffer size is 500, 19600 are needed"),
        ("max-compute-workgroups-per-dimension", 1, "compute workgroups per dimension is 1, 2 are needed"),
    ],
)
def test_what_the_device_does_not_take_is_said_before_it_is_asked_to(
    limit: str, most: int, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = device.device()
    lower = SimpleNamespace(limits={**found.limits, limit: most}, adapter=found.adapter)
    monkeypatch.setattr(device, "device", lambda: lower)
    with pytest.raises(webgpu.WebGpuUnavailable, match=said):
        replace(textured(100, 0), through_webgpu=True).render(front(16, 16, 3.0))
