"""Median depth against the float64 reference, and the fused surface against known geometry."""

import math

import numpy as np
import open3d
import pytest
import torch
import trimesh

from bitymi_ns.interchange.frame import Similarity
from bitymi_ns.interchange.surface import NoSurface, SurfaceOptions, extract_surface, median_depth
from bitymi_ns.ops import TexelAlpha, TexelTiles
from bitymi_ns.ops.parameters import GEOMETRY
from bitymi_ns.ranges import check_ranges
from bitymi_ns.scene.camera import Camera
from tests.ops.golden import GOLDEN_NAMES, camera_of, load_golden, reference


def plane(side: int, opacity: float = 0.95) -> dict[str, torch.Tensor]:
    """Make a dense grid of discs in the plane z = 0, from -1 to 1."""
    at = torch.linspace(-1, 1, side)
    means = torch.stack([*torch.meshgrid(at, at, indexing="xy"), torch.zeros(side, side)], -1).reshape(-1, 3)
    count = len(means)
    return {
        "means": means,
        "quats": torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        "log_scales": torch.full((count, 2), math.log(1.2 / side)),
        "opacity_logits": torch.full((count,), math.log(opacity / (1 - opacity))),
        "beta_raw": torch.zeros(count),
    }


def looking_down(x: float, y: float, distance: float = 2.0) -> Camera:
    """Make a camera above the plane z = 0 that looks along -z."""
    viewmat = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
    viewmat[:3, 3] = -viewmat[:3, :3] @ torch.tensor([x, y, distance])
    return Camera(viewmat, torch.tensor([[60.0, 0, 31.3], [0, 62.0, 25.1], [0, 0, 1]]), 64, 48)


@pytest.mark.parametrize("name", GOLDEN_NAMES)
def test_median_depth_is_that_of_the_reference(name: str) -> None:
    case = load_golden(name)
    values = [case.params[key].double() for key in GEOMETRY]
    depth = median_depth(dict(zip(GEOMETRY, values, strict=True)), camera_of(case), 0.2)
    t = reference(case, values)
    reached = t.weight[:, t.order].cumsum(1) >= 0.5
    z = t.depth[:, t.order].gather(1, reached.double().argmax(1, keepdim=True))[:, 0]
    expected = torch.where(reached.any(1), z, 0.0).view(case.height, case.width)
    close = (depth - expected).abs() <= 1e-6
    assert close.double().mean() > 0.999  # rounding may shift the crossing of one half by a surfel


def test_what_is_cut_away_has_no_depth() -> None:
    surfels, camera = plane(30), looking_down(0.0, 0.0)
    left = surfels["means"][:, 0] < 0
    tiles = TexelTiles.of_sizes(torch.ones(len(left), 2, dtype=torch.int32), torch.full((len(left),), 3.0))
    depth = median_depth(surfels, camera, 0.2, alpha=TexelAlpha(tiles, torch.where(left, 0.0, 1.0), 0.0))
    assert bool((depth[25, 4:28] == 0).all()) and torch.allclose(depth[25, 36:60], torch.tensor(2.0), atol=1e-3)


CAMERAS = [looking_down(x, y) for x in (-0.3, 0.0, 0.3) for y in (-0.2, 0.2)]


def gray(camera: Camera) -> torch.Tensor:
    return torch.full((camera.height, camera.width, 3), 0.5)


def test_a_plane_is_fused_where_it_lies() -> None:
    mesh = extract_surface(plane(60), gray, CAMERAS, 0.02, SurfaceOptions(resolution=64))
    vertices, colors = mesh.vertices, mesh.colors
    assert len(mesh) > 500 and np.abs(vertices[:, 2]).max() < 2e-3
    assert np.abs(colors - 0.5).max() < 0.01
    x, y = vertices[:, 0], vertices[:, 1]  # limited to what the outermost cameras see
    assert 0.6 < x.max() < 1.06 and abs(x.max() + x.min()) < 0.1 and 0.4 < y.max() < 1.06
    shape = trimesh.Trimesh(vertices, mesh.faces, process=False)
    assert shape.face_normals[:, 2].min() > 0.9  # towards the cameras
    assert shape.area_faces.min() > 0.0


def test_open3d_is_silent_and_cameras_are_needed() -> None:
    levels = []

    def render(camera: Camera) -> torch.Tensor:
        levels.append(open3d.utility.get_verbosity_level())
        return gray(camera)

    before = open3d.utility.get_verbosity_level()
    extract_surface(plane(60), render, CAMERAS[:2], 0.02, SurfaceOptions(resolution=32))
    assert set(levels) == {open3d.utility.VerbosityLevel.Error} and open3d.utility.get_verbosity_level() == before
    with pytest.raises(NoSurface, match="no cameras"):
        extract_surface(plane(60), gray, [], 0.02)


@pytest.mark.slow
def test_large_views_are_drawn_no_finer_than_the_voxels_need() -> None:
    sizes = []

    def render(camera: Camera) -> torch.Tensor:
        sizes.append((camera.width, camera.height))
        return gray(camera)

    large = [camera.scaled(10.0) for camera in CAMERAS]
    mesh = extract_surface(plane(60), render, large, 0.02, SurfaceOptions(resolution=128))
    width = 64 / 62 * 2 * 2.0 / (2.04 / 128)  # two pixels per voxel of the box at distance 2
    assert all(abs(w / width - 1.0) < 0.05 and abs(h / w - 0.75) < 0.01 for w, h in sizes)
    assert np.abs(mesh.vertices[:, 2]).max() < 2e-3
    sizes.clear()
    extract_surface(plane(60), render, large, 0.02, SurfaceOptions(resolution=512))
    assert set(sizes) == {(640, 480)}


@pytest.mark.slow
@pytest.mark.parametrize("resolution", [32, 64])
def test_the_budget_and_the_closed_surface_are_kept(resolution: int) -> None:
    few = extract_surface(plane(40), gray, CAMERAS, 0.02, SurfaceOptions(resolution=64, triangles=200))
    assert 50 < len(few) <= 200
    options = SurfaceOptions(resolution=resolution, watertight=True, triangles=2000)
    closed = extract_surface(plane(40), gray, CAMERAS, 0.02, options)
    shape = trimesh.Trimesh(closed.vertices, closed.faces)
    assert closed.open_edges() == 0 and 100 < len(closed) <= 2000
    assert shape.is_watertight and shape.is_winding_consistent and shape.volume > 0


def test_a_mirrored_frame_keeps_what_is_outside() -> None:
    mirror = torch.diag(torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64))
    zero = torch.zeros(3, dtype=torch.float64)
    options = SurfaceOptions(resolution=48)
    mesh = extract_surface(plane(40), gray, CAMERAS, 0.02, options, to=Similarity(mirror, 2.0, zero, zero))
    assert trimesh.Trimesh(mesh.vertices, mesh.faces).face_normals[:, 2].max() < -0.9


def test_a_scene_without_a_surface_says_so() -> None:
    with pytest.raises(NoSurface, match="no pixel of the cameras' views is covered"):
        extract_surface(plane(4, 0.05), gray, CAMERAS, 0.02)


@pytest.mark.parametrize("option", [{"resolution": 8}, {"triangles": -1}])
def test_options_out_of_range_are_named(option: dict[str, int]) -> None:
    with pytest.raises(ValueError, match=f"{next(iter(option))} must be"):
        check_ranges(SurfaceOptions(**option))
