"""Borders of index ranges: faces of hash cells, edges of atlas pages."""

import itertools
import math
from dataclasses import replace

import pytest
import torch

from bitymi_ns import ops
from bitymi_ns.measure.stability.errors import Backend
from bitymi_ns.measure.stability.scenes import SV_KEYS, front_scene
from bitymi_ns.ops.parameters import GEOMETRY
from bitymi_ns.ops.reference import field as reference_field
from bitymi_ns.ops.reference import render as reference_render
from bitymi_ns.ops.reference import view_color as reference_view_color
from bitymi_ns.ops.reference.view_color import view_directions
from bitymi_ns.scene import Camera, HashField, SceneConfig
from bitymi_ns.scene.baked import BakedScene

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["double", "single"])
def test_points_exactly_on_the_faces_of_hash_cells(dtype: torch.dtype, backend: Backend) -> None:
    """Coordinates k / 8 of a grid of 8 cells, including both ends, exact in float32: points lie on faces of every
    level, both sides select the same cell, and values and gradients agree with the reference."""
    generator = torch.Generator().manual_seed(3)
    field = HashField(SceneConfig(min_resolution=8), (0.0, 0.0, 0.0), 1.0, False, 9, generator)
    with torch.no_grad():
        for parameter in field.parameters():
            parameter.copy_(torch.randn(parameter.shape, generator=generator) * 0.5)
    steps = torch.arange(9, dtype=torch.float64) / 4 - 1
    grid = torch.cartesian_prod(steps, steps, steps)  # [729, 3]
    field = field.to(backend.device, dtype)
    x = grid.to(backend.device, dtype).requires_grad_()
    weights = torch.rand(729, 3, generator=generator, dtype=torch.float64) - 0.5
    got = field(x)
    grads = torch.autograd.grad((got * weights.to(got)).sum(), [x, *field.weights])
    leaves = [grid.clone().requires_grad_(), *(w.detach().double().cpu().requires_grad_() for w in field.weights)]
    want = reference_field.field(*leaves, torch.zeros(3), 1.0, 8, contraction=False)
    wanted = torch.autograd.grad((want * weights).sum(), leaves)
    tolerance = 1e-12 if dtype == torch.float64 else 2e-6
    assert (got.detach().double().cpu() - want).abs().max() < tolerance * want.abs().max()
    # at the ends, clamping passes no gradient in the kernels but half of it in torch
    inside = (grid.abs() < 1).all(-1)
    pairs = [(grads[0][inside.to(x.device)], wanted[0][inside]), *zip(grads[1:], wanted[1:], strict=True)]
    for a, b in pairs:
        assert (a.double().cpu() - b).abs().max() < 5 * tolerance * b.abs().max()


@pytest.mark.parametrize("sides", [(4, 4), (8, 4), (4, 16)])
def test_atlas_tiles_at_every_page_edge(sides: tuple[int, int], backend: Backend) -> None:
    """Texels outside tiles are NaN, so a stray fetch shows. Texture units fetch neighbours with weight 0 at the outer
    texel centres, where 0 times NaN would show; for them it is a large number."""
    r_u, r_v = sides
    width, height, layers = 64, 48, 3
    right, bottom = width - r_u, height - r_v
    corners_and_middles = itertools.product((0, right // 2, right), (0, bottom // 2, bottom), range(layers))
    places = [place for place in corners_and_middles if place[:2] != (right // 2, bottom // 2)]
    n = len(places)
    case = front_scene(n, 1, 48, 36)
    case.params["log_scales"].fill_(math.log(0.3))
    case.params["opacity_logits"].fill_(1.0)
    case.params["means"][:, 2] = case.params["means"][:, 2].clamp(min=1.0)
    generator = torch.Generator().manual_seed(0)
    nothing = math.nan if backend.name == "cpu" else 1e3
    atlas, patches, tiles = torch.full((layers, height, width, 4), nothing), [], []
    for x, y, layer in places:
        patch = torch.rand(r_v, r_u, 3, generator=generator) - 0.5
        atlas[layer, y : y + r_v, x : x + r_u] = torch.cat([patch, torch.ones(r_v, r_u, 1)], -1)
        patches.append(patch.double())
        tiles.append((x, y, layer, r_u, r_v))
    surfels = {key: value.float().to(backend.device) for key, value in case.params.items()}
    tile_rows = torch.tensor(tiles, dtype=torch.int32, device=backend.device)
    scene = BakedScene(surfels, "sv", tile_rows, atlas.to(backend.device), weight_bound=0.0)
    camera = Camera(case.viewmat.float(), case.K.float(), case.width, case.height).to(backend.device)
    got = scene.render(camera).rgb.double().cpu()
    doubles = {key: value.double().cpu() for key, value in surfels.items()}
    colors = reference_view_color.sv(
        *(doubles[key] for key in SV_KEYS), view_directions(doubles["means"], case.viewmat)
    )
    geometry = [doubles[key] for key in GEOMETRY]
    want = reference_render.render(geometry, colors, replace(case, K=case.K.float().double()), tiles=patches)
    drawn = set(want.trace.blended.nonzero()[:, 1].tolist())
    assert len(drawn) == n, "every tile is seen"
    assert got.isfinite().all()
    error = (got - want.rgb).abs().amax(-1)
    # texture units have weights in steps of 1/256
    assert (error < (1e-4 if backend.name == "cpu" else 4e-3)).double().mean() > 0.999, error.max()
    assert error.max() < 2e-2


def test_pixels_at_the_edges_of_wide_and_tall_images_are_drawn(backend: Backend) -> None:
    """One disc over a whole 1 x 8192 and 8192 x 1 image: first and last pixel are drawn."""
    for width, height in ((1, 1), (1, 8192), (8192, 1)):
        f = float(max(width, height))
        K = torch.tensor([[f, 0, width / 2], [0, f, height / 2], [0, 0, 1]])
        camera = Camera(torch.eye(4), K, width, height).to(backend.device)
        disc = ([[0.0, 0.0, 2.0]], [[1.0, 0.0, 0.0, 0.0]], [[2.0, 2.0]], [2.0], [0.0])
        geometry = (torch.tensor(value, device=backend.device) for value in disc)
        fragments = ops.trace(ops.project(*geometry, camera))
        assert sorted(fragments.pixel.tolist()) == list(range(width * height))
