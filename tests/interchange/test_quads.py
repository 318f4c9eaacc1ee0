"""The quad mesh: geometry, texels, file, render, and colours from pictures."""

from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from bitymi_ns.bundle import Bundle
from bitymi_ns.interchange.glb import quads_glb, upright
from bitymi_ns.interchange.quad_hits import _fetch, nearest_hits
from bitymi_ns.interchange.quads import Quads, quads_of
from bitymi_ns.interchange.recolor import recolored
from bitymi_ns.ops.reference.render import texel
from bitymi_ns.scene.tile_sizes import kernel_parameters
from bitymi_ns.train.init import tangents
from tests.interchange.glb import read_glb
from tests.interchange.test_alpha import drawn

LEVEL = 0.15


@pytest.fixture
def color() -> torch.Tensor:
    return torch.linspace(0.2, 0.7, 36).view(12, 3)


def test_quads_hold_the_disc_and_what_the_tile_shows(bundle: Bundle, color: torch.Tensor) -> None:
    scene = bundle.scene
    quads = quads_of(scene, color, LEVEL)
    opacity, beta = torch.sigmoid(scene.surfels["opacity_logits"]), kernel_parameters(scene.surfels)[1]
    kept = torch.nonzero(opacity > LEVEL).squeeze(1).tolist()
    assert len(quads) == len(kept) > 3
    axes = tangents(scene.surfels["quats"]) * scene.surfels["log_scales"].exp()[:, None]
    for row, i in enumerate(kept):
        radius = 3 * float((1 - (LEVEL / opacity[i]) ** (1 / beta[i])) ** 0.5)
        assert float(opacity[i]) * (1 - radius**2 / 9) ** float(beta[i]) == pytest.approx(LEVEL, rel=1e-4)
        mean = scene.surfels["means"][i]
        for corner, (u, v) in zip(quads.corners[row], ((-1, -1), (1, -1), (1, 1), (-1, 1)), strict=True):
            assert torch.allclose(corner, mean + radius * (u * axes[i, :, 0] + v * axes[i, :, 1]), atol=1e-5)
        x, y, layer, r_u, r_v = scene.tiles[i].tolist()
        tile = scene.residuals()[layer, y : y + r_v, x : x + r_u].double()
        s, t = torch.rand(2, 50, dtype=torch.float64)
        inside = quads.uv[row, 0] + s[:, None] * (quads.uv[row, 1] - quads.uv[row, 0])
        inside = inside + t[:, None] * (quads.uv[row, 3] - quads.uv[row, 0])
        found = _fetch(quads.pages, quads.page[row].expand(50), inside.double())
        at = radius / float(scene.extent[i]) * torch.stack([2 * s - 1, 2 * t - 1], 1) * 3  # of [-3, 3]
        shown = torch.relu(color[i].double() + texel(tile, at)).clamp(max=1)
        # a grid other than the tile's cuts off kinks but keeps the mean
        assert float((found[:, :3].double() - shown).mean().abs()) < 0.06
        r2 = (2 * s - 1) ** 2 + (2 * t - 1) ** 2
        assert bool((found[:, 3].double() >= 0.5)[r2 < 0.6].all()) and not bool((found[:, 3] >= 0.5)[r2 > 1.4].any())


def test_a_surfel_without_a_tile_has_its_constant(bundle: Bundle, color: torch.Tensor) -> None:
    bundle.scene.tiles[:] = 0
    bundle.scene.surfels["opacity_logits"][:] = 2.0
    quads = quads_of(bundle.scene, color, LEVEL)
    x = (quads.uv[:, 0] * torch.tensor([quads.pages.shape[2], quads.pages.shape[1]])).long()
    found = quads.pages[quads.page, x[:, 1], x[:, 0], :3]
    assert torch.equal(found, ((color + 0.1) * 255).round().to(torch.uint8))


def test_the_file_opens_elsewhere_and_holds_what_went_in(bundle: Bundle, color: torch.Tensor, tmp_path: Path) -> None:
    quads = quads_of(bundle.scene, color, LEVEL)
    (tmp_path / "a.glb").write_bytes(quads_glb(quads, np.eye(4)))
    found = read_glb(tmp_path / "a.glb")
    assert torch.equal(found.corners, quads.corners) and torch.equal(found.pages, quads.pages)
    assert torch.allclose(found.uv, quads.uv, atol=1e-6) and torch.equal(found.page, quads.page)
    mesh = next(iter(trimesh.load_scene(tmp_path / "a.glb", process=False).geometry.values()))
    assert mesh.faces.shape == (2 * len(quads), 3) and mesh.visual.material.alphaMode == "MASK"
    text = (tmp_path / "a.glb").read_bytes()
    assert b"KHR_materials_unlit" in text and b'"samplers"' in text and b'"doubleSided":true' in text
    sides = quads.corners[:, 1] - quads.corners[:, 0], quads.corners[:, 3] - quads.corners[:, 0]
    area = torch.linalg.cross(*sides).norm(dim=1).sum()
    assert mesh.area == pytest.approx(float(area), rel=1e-4)


@pytest.mark.parametrize("up", [(0.0, 0.0, 1.0), (0.6, 0.0, -0.8), (0.0, -1.0, 0.0), (0.0, 1.0, 0.0)])
def test_up_is_y_in_the_file(up: tuple, tmp_path: Path) -> None:
    corners = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1]]]) + torch.tensor(up)
    quads = Quads(corners, torch.zeros(1, 4, 2), torch.zeros(1).long(), torch.zeros(1, 4, 4, 4, dtype=torch.uint8))
    (tmp_path / "a.glb").write_bytes(quads_glb(quads, upright(torch.tensor(up))))
    found = read_glb(tmp_path / "a.glb").corners
    assert torch.allclose(found[..., 1], (corners * torch.tensor(up)).sum(-1), atol=1e-5)
    assert torch.allclose(torch.cdist(found[0], found[0]), torch.cdist(corners[0], corners[0]), atol=1e-5)


def square(z: float, half: float, rgb: tuple[int, int, int]) -> tuple[torch.Tensor, torch.Tensor]:
    ring = torch.tensor([[-half, -half, z], [half, -half, z], [half, half, z], [-half, half, z]])
    page = torch.full((4, 4, 4), 255, dtype=torch.uint8)
    page[..., :3] = torch.tensor(rgb, dtype=torch.uint8)
    return ring, page


def two_squares() -> Quads:
    """A red square in front of a larger green one, each with a page; the first column of the red one is a hole."""
    (near, red), (far, green) = square(-1.0, 1.0, (200, 0, 0)), square(1.0, 3.0, (0, 100, 0))
    red[:, 0, 3] = 0
    inset = torch.tensor([[0.125, 0.125], [0.875, 0.125], [0.875, 0.875], [0.125, 0.875]])
    return Quads(torch.stack([near, far]), inset.expand(2, 4, 2), torch.tensor([0, 1]), torch.stack([red, green]))


def test_the_nearest_quad_hides_the_others_but_for_its_holes(camera) -> None:
    view = camera(6.0, 64, 48)
    image = drawn(two_squares(), view)
    assert torch.allclose(image[24, 33], torch.tensor([200 / 255, 0.0, 0.0]))
    assert torch.allclose(image[24, 22], torch.tensor([0.0, 100 / 255, 0.0]))  # 32 - 60 / 5 = 20: within the hole
    assert torch.allclose(image[24, 50], torch.tensor([0.0, 100 / 255, 0.0]))
    assert image[2, 2].tolist() == [0.0, 0.0, 0.0]


def test_quads_that_reach_behind_the_camera_are_drawn_in_front_of_it(camera) -> None:
    """A floor beneath the camera: its visible part lies below the horizon."""
    floor = torch.tensor([[[-50.0, 1, -50], [50, 1, -50], [50, 1, 50], [-50, 1, 50]]])
    white = torch.full((1, 4, 4, 4), 255, dtype=torch.uint8)
    uv = torch.tensor([[[0.2, 0.2], [0.8, 0.2], [0.8, 0.8], [0.2, 0.8]]])
    hits = nearest_hits(Quads(floor, uv, torch.zeros(1).long(), white), camera(0.0, 64, 48), 0.1)
    rows = torch.unique(hits.pixel // 64)
    assert rows.tolist() == list(range(25, 48)) and len(hits.pixel) == 23 * 64  # y = 1: row 24 + 50 / z, z < 50
    assert len(nearest_hits(Quads(floor[:0], uv[:0], hits.quad[:0], white), camera(0.0, 64, 48), 0.1).pixel) == 0


def test_a_mesh_takes_the_colours_of_pictures_where_it_is_seen(camera) -> None:
    quads, view = two_squares(), camera(6.0, 64, 48)
    wanted = torch.tensor([0.3, 0.4, 0.5])
    again = recolored(quads, lambda c: wanted.expand(c.height, c.width, 3), [view] * 3, 0.2)
    image = drawn(again, view)
    assert torch.allclose(image[24, 33], wanted, atol=0.01) and torch.allclose(image[24, 50], wanted, atol=0.01)
    assert torch.equal(again.pages[..., 3], quads.pages[..., 3])
    assert torch.equal(recolored(quads, lambda c: wanted, [], 0.2).pages, quads.pages)
