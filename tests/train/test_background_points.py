"""Background points in cells of photographs without sparse points."""

import math

import pytest
import torch

from bitymi_ns.scene.camera import Camera
from bitymi_ns.scene.config import SceneConfig
from bitymi_ns.train.background_points import (
    CELLS,
    FARTHEST,
    NEAREST,
    POINTS_PER_CELL,
    RADIUS,
    SUPPORT,
    background_points,
)
from bitymi_ns.train.config import DensifyConfig, TrainConfig
from bitymi_ns.train.init import scene_for_views, surfels_from_points
from bitymi_ns.train.views import View

W, H, DEPTH = 96, 48, 2.0
EYE = torch.tensor([1.0, 2.0, -3.0])


def turned(degrees: float) -> Camera:
    """Make a camera at EYE, rotated about the y axis."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    viewmat = torch.eye(4)
    viewmat[:3, :3] = torch.tensor([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]])
    viewmat[:3, 3] = -viewmat[:3, :3] @ EYE
    return Camera(viewmat, torch.tensor([[90.0, 0.0, 45.0], [0.0, 91.0, 26.0], [0.0, 0.0, 1.0]]), W, H)


@pytest.fixture
def camera() -> Camera:
    return turned(20.0)


def projected(camera: Camera, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    local = points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    pixels = local[:, :2] / local[:, 2:] * torch.stack([camera.K[0, 0], camera.K[1, 1]]) + camera.K[:2, 2]
    return pixels, local[:, 2]


@pytest.fixture
def left(camera: Camera) -> torch.Tensor:
    """Make points in every cell of the left half."""
    side = W / CELLS
    cells = torch.cartesian_prod(torch.arange(CELLS // 2), torch.arange(int(H / side))).repeat(2 * POINTS_PER_CELL, 1)
    return camera.unproject(*((cells + 0.5) * side).unbind(1), DEPTH * torch.linspace(0.9999, 1.0001, len(cells)))


def test_empty_cells_get_a_point_on_their_ray(camera: Camera, left: torch.Tensor) -> None:
    image = torch.zeros(H, W, 3)
    image[..., 0] = (torch.arange(W) / W)[None]
    found = background_points(left, [View(camera, image)] * SUPPORT, seed=3)
    pixels, depth = projected(camera, found.xyz)
    side = W / CELLS
    cells = (pixels / side).floor()
    assert len(cells) == SUPPORT * len({tuple(cell) for cell in cells.tolist()}) == SUPPORT * 12 * 12
    assert bool((cells[:, 0] >= CELLS // 2).all())
    assert bool(((depth > NEAREST * DEPTH * 0.999) & (depth < FARTHEST * DEPTH * 1.001)).all())
    assert float(depth.log().std()) > 0.2 * math.log(FARTHEST / NEAREST)
    torch.testing.assert_close(found.rgb[:, 0], ((cells[:, 0] + 0.5) * side - 0.5) / W)  # mean of the cell
    torch.testing.assert_close(found.scales, RADIUS * side * depth / camera.K[0, 0])


def test_masked_and_transparent_cells_get_none(camera: Camera, left: torch.Tensor) -> None:
    image, mask = torch.full((H, W, 4), 200, dtype=torch.uint8), torch.ones(H, W, dtype=torch.bool)
    image[: H // 2, :, 3] = 0
    mask[:, 3 * W // 4 :] = False
    pixels, _ = projected(camera, background_points(left, [View(camera, image, mask)] * SUPPORT, 0).xyz)
    assert len(pixels) and bool((pixels[:, 1] >= H // 2).all()) and bool((pixels[:, 0] < 3 * W // 4).all())


def test_a_view_without_points_takes_the_depth_of_the_others(camera: Camera, left: torch.Tensor) -> None:
    away = turned(200.0)
    image = torch.rand(H, W, 3)
    both = background_points(left, [View(camera, image), *[View(away, image)] * SUPPORT], 0)
    _, depth = projected(away, both.xyz)  # only one view has the first one's empty cells: too few
    assert len(depth) == SUPPORT * CELLS * 12 and bool((depth > NEAREST * DEPTH * 0.999).all())
    assert len(background_points(left, [View(away, image)] * SUPPORT, 0).xyz) == 0
    assert len(background_points(torch.full((5, 3), math.nan), [View(camera, image)] * SUPPORT, 0).xyz) == 0


def test_points_that_few_views_show_or_that_hide_others_go(camera: Camera, left: torch.Tensor) -> None:
    image = torch.rand(H, W, 3)
    assert len(background_points(left, [View(camera, image)] * (SUPPORT - 1), 0).xyz) == 0
    ahead = turned(0.0)
    points = ahead.unproject(*projected(camera, left)[0].unbind(1), torch.full((len(left),), DEPTH))
    assert len(background_points(points, [View(ahead, image)] * SUPPORT, 0).xyz) == SUPPORT * 144
    viewmat = torch.eye(4)  # right of the empty cells, looking left
    viewmat[:3, :3] = torch.tensor([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    viewmat[:3, 3] = -viewmat[:3, :3] @ (EYE + torch.tensor([10.0, 0.0, 4.0]))
    side = Camera(viewmat, torch.tensor([[15.0, 0.0, 48.0], [0.0, 15.0, 24.0], [0.0, 0.0, 1.0]]), W, H)
    pixels = (torch.cartesian_prod(torch.arange(CELLS), torch.arange(12)) + 0.5) * (W / CELLS)
    pixels = pixels.repeat(POINTS_PER_CELL, 1)
    wall = side.unproject(*pixels.unbind(1), torch.full((len(pixels),), 40.0))
    views = [View(ahead, image)] * SUPPORT + [View(side, image)] * 3
    assert len(background_points(torch.cat([points, wall]), views, 0).xyz) == 0


def test_sparse_points_make_large_cells(camera: Camera, left: torch.Tensor) -> None:
    views = [View(camera, torch.rand(H, W, 3))] * SUPPORT
    few = left[torch.randperm(len(left), generator=torch.Generator().manual_seed(0))[: 18 * POINTS_PER_CELL]]
    found = background_points(few, views, 0)
    assert SUPPORT * 9 <= len(found.xyz) <= SUPPORT * 12  # the right half of about 6 x 3 cells
    assert bool((projected(camera, found.xyz)[0][:, 0] > W / 2 - W / 6).all())


def test_surfels_start_there_within_the_bounds(camera: Camera, left: torch.Tensor) -> None:
    views = [View(camera, torch.rand(H, W, 3))] * SUPPORT
    found = background_points(left, views, 0)

    def first(**options: object) -> tuple[dict[str, torch.Tensor], int]:
        config = TrainConfig(**options)  # type: ignore[arg-type]
        surfels, report = surfels_from_points(
            left, torch.rand(len(left), 3), camera.center[None], config, SceneConfig(), background=found
        )
        return surfels, report.background

    surfels, count = first(background_points=0.5)
    assert count == len(left) // 2 and len(surfels["means"]) == len(left) + count
    torch.testing.assert_close(surfels["means"][-count:], found.xyz[:count])
    assert bool((surfels["log_scales"][-count:].exp() <= 1.001 * found.scales[:count, None]).all())
    assert first(background_points=0.0)[1] == 0
    assert first(densify=DensifyConfig(max_surfels=len(left) + 3))[1] == 3
    assert first(densify=DensifyConfig(max_surfels=len(left) - 3))[1] == 0
    whole = scene_for_views(views, left, torch.rand(len(left), 3), SceneConfig(), TrainConfig(background_points=0.5))
    assert len(whole) == len(left) + count
