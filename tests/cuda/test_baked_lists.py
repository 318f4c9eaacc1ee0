"""Tile lists of the baked renderer on CUDA: contents, order, overflow."""

import pytest
import torch
from torch import Tensor

from bitymi_ns.ops import baked_renderer
from bitymi_ns.ops.baked_renderer import BakedRenderer, Stage, Workspace, slots_per_tile
from bitymi_ns.ops.parameters import GEOMETRY
from bitymi_ns.scene.baked import BakedScene
from tests.bake.conftest import make_surfels
from tests.cuda.baked_scenes import FLIP, camera_of, front, listed_pairs, most, scene_of
from tests.ops.golden import SceneCase, crossing_scene, random_scene, reference, tiles_reached

pytestmark = pytest.mark.slow


def mask_pixels(renderer: BakedRenderer, surfels: int, width: int, height: int) -> int:
    """Count the pixels of all tile parts in a one-view frame's pairs, within the image or not."""
    masks = listed_pairs(renderer.workspace, surfels, 1, width, height).pairs & 0xFF
    return 32 * sum(int((masks >> part & 1).sum()) for part in range(8))


def lists_of(renderer: BakedRenderer, surfels: int, width: int, height: int, views: int) -> list[Tensor]:
    """Return the surfels listed in each tile after a frame, numbered across views.

    Checks that they are unique and front to back, ties by number, and that a complete frame has all pairs.
    """
    ranges, depth, pairs = listed_pairs(renderer.workspace, surfels, views, width, height)
    if renderer.complete():
        assert len(pairs) == renderer.workspace.pairs
    lists = [pairs[begin:end] >> 8 for begin, end in ranges.tolist()]
    for rows_of_tile in lists:
        keys = depth[rows_of_tile] * 2**24 + rows_of_tile
        assert (keys.diff() > 0).all()
    return lists


def check_overdraw(case: SceneCase, device: torch.device, cpu) -> tuple[BakedRenderer, Tensor]:
    """Compare the overdraw of a case with the CPU's; returns the renderer, and the CPU's."""
    scene, camera = scene_of(case), camera_of(case)
    renderer = BakedRenderer(scene.to(device), camera.width, camera.height, images=("overdraw",))
    got = renderer.draw([camera])["overdraw"].cpu()
    with cpu():
        want = scene.render(camera, maps=True).overdraw
    assert ((got[0] != want).double().mean() < 2e-3) and (got[0] - want).abs().max() <= 1
    return renderer, want


@pytest.mark.parametrize("count", [5, 140])
def test_large_surfels(count: int, device: torch.device, cpu) -> None:
    """More rows of tiles per surfel, and per block, than the block has threads, among small surfels."""
    case = random_scene(count, 20, width=90, height=360)
    case.params["log_scales"][::2] += 3.0
    case.params["opacity_logits"] -= 4.0  # so that few pixels end before the last surfel
    renderer, _ = check_overdraw(case, device, cpu)
    assert renderer.workspace.pairs > 30 * count


@pytest.mark.parametrize("seed", [0, 1])
def test_no_pixel_of_thin_small_and_large_surfels_is_lost(seed: int, device: torch.device, cpu) -> None:
    """The single-precision bounds (core/footprint.h) give the same fragments as the CPU's double ones."""
    case = random_scene(150, 100 + seed, width=72, height=56)
    g = torch.Generator().manual_seed(seed)
    case.params["log_scales"] += 2.0 * torch.randn(150, 2, generator=g, dtype=torch.float64)
    case.params["opacity_logits"] -= 2.0  # so that few pixels end before the last surfel
    check_overdraw(case, device, cpu)


@pytest.mark.parametrize("seed, width, height", [(0, 96, 80), (1, 300, 200)])
def test_discs_across_the_camera_plane_are_listed_where_they_show(
    seed: int, width: int, height: int, device: torch.device, cpu
) -> None:
    """Discs without a box are listed only in tiles and parts that they reach, and never beyond the borders."""
    case = crossing_scene(60, seed, width, height)
    renderer, want = check_overdraw(case, device, cpu)
    weights = reference(case, [case.params[name] for name in GEOMETRY]).weight
    assert renderer.workspace.pairs <= 1.25 * int(tiles_reached(weights, width, height).sum())
    assert mask_pixels(renderer, 60, width, height) <= 1.25 * float(want.sum())


@pytest.fixture
def few_slots(monkeypatch: pytest.MonkeyPatch) -> None:
    """Give tiles the fewest slots that the kernels support."""
    monkeypatch.setattr(baked_renderer, "slots_per_tile", lambda capacity, tiles: 32)


def test_a_frame_that_does_not_fit_is_drawn_again(
    device: torch.device, cpu, few_slots: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both the tiles' slots and the shared list overflow."""
    case = random_scene(60, 0, width=70, height=60)
    case.params["log_scales"] += 3.0  # every surfel on nearly every tile
    case.params["opacity_logits"] -= 3.0
    scene, camera = scene_of(case).to(device), camera_of(case)
    renderer = BakedRenderer(scene, camera.width, camera.height, images=("rgb",))
    small = renderer.workspace.capacity
    renderer.draw([camera], check=False)
    pairs, spilled = renderer.workspace.counts()
    assert not renderer.complete() and pairs > spilled > small
    lists = lists_of(renderer, 60, camera.width, camera.height, 1)
    assert pairs - spilled < sum(len(rows) for rows in lists) <= pairs - spilled + small
    found = iter([spilled // 2, pairs, pairs])  # the first growth is too small
    with monkeypatch.context() as patch:
        patch.setattr(Workspace, "pairs", property(lambda workspace: next(found)))
        rgb = renderer.draw([camera])["rgb"].clone()
    assert renderer.complete() and renderer.workspace.capacity > renderer.workspace.pairs == pairs
    again = renderer.draw([camera])["rgb"]
    assert torch.equal(rgb, again) and again.data_ptr() == renderer.images["rgb"].data_ptr()
    with cpu():
        want = scene_of(case).render(camera).rgb
    off = (rgb[0].cpu() - want).abs()
    assert off.max() < most(device, 1e-4, FLIP) and (off < 1e-4).double().mean() > 0.999
    torch.testing.assert_close(scene.render(camera).rgb, rgb[0], atol=0, rtol=0)


@pytest.mark.parametrize("views", [1, 3])
@pytest.mark.parametrize("count", [1, 33, 300, 1025, 3000])
def test_lists_of_all_lengths_are_in_order(count: int, views: int, device: torch.device, cpu) -> None:
    """Several runs of a block sort, with ties in depth, beside empty tiles."""
    surfels = make_surfels(count, seed=30)
    surfels["means"] *= 0.05  # in the middle
    surfels["means"][count // 2 :, 2] = surfels["means"][0, 2]
    surfels["log_scales"] += 1.0
    surfels["opacity_logits"] = surfels["opacity_logits"] - 3.0
    scene = BakedScene(surfels, "sv", torch.zeros(count, 5, dtype=torch.int32), None, transmittance_min=0.0)
    camera = front(170, 20)
    renderer = BakedRenderer(scene.to(device), 170, 20, views, images=("rgb", "overdraw"))
    images = renderer.draw([camera] * views)
    lists = lists_of(renderer, count, 170, 20, views)
    lengths = [len(each) for each in lists]
    assert max(lengths) > 0.9 * count and min(lengths) == 0
    with cpu():
        want = scene.render(camera, maps=True)
    for view in range(views):
        off = (images["rgb"][view].cpu() - want.rgb).abs()
        assert off.max() < most(device, 1e-4, FLIP) and (off < 1e-4).double().mean() > 0.999
        assert ((images["overdraw"][view].cpu() != want.overdraw).double().mean()) < 2e-3
        per_view = len(lists) // views
        assert [len(each) for each in lists[view * per_view : (view + 1) * per_view]] == lengths[:per_view]


@pytest.mark.parametrize("views", [1, 3])
@pytest.mark.parametrize(
    "count, width, height, scale", [(2500, 16, 16, 0.0), (1200, 40, 40, 2.0), (80, 90, 130, 3.0), (200, 300, 20, 1.0)]
)
def test_pairs_without_a_slot_are_listed_like_the_others(
    count: int, width: int, height: int, scale: float, views: int, device: torch.device, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All pairs in one tile, some in several, surfels with many tiles, empty tiles."""
    surfels = make_surfels(count, seed=31)
    surfels["log_scales"] += scale
    surfels["opacity_logits"] = surfels["opacity_logits"] - 4.0
    scene = BakedScene(surfels, "sv", torch.zeros(count, 5, dtype=torch.int32), None).to(device)
    cameras = [front(width, height, distance) for distance in (4.0, 6.0, 5.0)[:views]]
    found = []
    for slots in (1024 * -(-count // 1024), 32):
        monkeypatch.setattr(baked_renderer, "slots_per_tile", lambda capacity, tiles, slots=slots: slots)
        renderer = BakedRenderer(scene, width, height, views, images=("rgb", "overdraw"))
        images = {name: image.clone() for name, image in renderer.draw(cameras).items()}
        found.append((images, lists_of(renderer, count, width, height, views), renderer.workspace.counts()))
        renderer.run(Stage.DRAW)  # of lists that are sorted
        for name, image in images.items():
            assert torch.equal(image, renderer.images[name])
    (all_images, all_lists, counts), (images, lists, spilled_counts) = found
    assert counts[1] == 0 and 0 < spilled_counts[1] < spilled_counts[0] == counts[0]
    for rows, same in zip(all_lists, lists, strict=True):
        assert torch.equal(rows, same)
    for name, image in images.items():
        assert torch.equal(image, all_images[name])


@pytest.mark.parametrize("pairs, width, height", [(8, 16, 16), (80_000, 320, 240), (10**7, 3840, 2160)])
def test_memory_is_bounded_by_the_pairs(pairs: int, width: int, height: int, device: torch.device) -> None:
    """20 bytes per pair, 32 MB, and 36 bytes per tile."""
    workspace, tiles = Workspace(device), -(-width // 16) * -(-height // 16)
    workspace.resize(1, 1, width, height, False, pairs)
    assert workspace.memory.numel() < 20 * pairs + 2**25 + 36 * tiles + 4096
    assert workspace.slots % 32 == 0 and 32 <= workspace.slots <= 1024
    assert slots_per_tile(pairs, 2**24) == 32


def test_many_tiles(device: torch.device) -> None:
    """Tiles that a narrower image also has get the same lists."""
    case = random_scene(30, 9, 1_000, 20)
    scene, ranges = scene_of(case).to(device), []
    for width in (1_000, 600_000):
        renderer = BakedRenderer(scene, width, 20)
        renderer._resize(2_000)
        renderer._viewmats.copy_(case.viewmat)
        renderer._Ks.copy_(case.K)
        renderer.run(Stage.LIST)
        assert 100 < renderer.workspace.pairs <= renderer.workspace.capacity
        all_ranges = listed_pairs(renderer.workspace, 30, 1, width, 20).ranges
        ranges.append(all_ranges.diff(dim=-1).view(2, -(-width // 16)))
        assert ranges[-1].sum() == renderer.workspace.pairs and (ranges[-1] >= 0).all()
    narrow = ranges[0].shape[1] - 1  # the last tile is cut by the narrow image
    assert torch.equal(ranges[0][:, :narrow], ranges[1][:, :narrow])
