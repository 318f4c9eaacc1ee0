"""Surface extraction from a scene: TSDF fusion of median depths (as in 2DGS, Huang et al. 2024), with open3d."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from bitymi_ns.ops import TexelAlpha, fitting_lists, project
from bitymi_ns.ops.project import geometry_of
from bitymi_ns.progress import Progress, no_progress
from bitymi_ns.ranges import check_ranges
from bitymi_ns.scene.camera import Camera
from .frame import Similarity
from .triangles import Triangles, cleaned, solid

if TYPE_CHECKING:
    import open3d

HALF = 0.5  # accumulated weight at the median depth
TRUNCATION = 8.0  # truncation distance of the TSDF in voxels; with 4, walls with noisy depth get more holes
SMOOTHING = 10  # iterations of Taubin smoothing
QUANTILE = 0.01  # share of the observed points outside each side of the box
REACH = 3.0
"""Maximum half side of the box, relative to the larger of the cameras' extent and the median depth of all views."""
SMALLEST = 0.005  # components with less than this share of the largest one's triangles are dropped
BOX_SIDE = 160  # longer side in pixels of the depth maps that determine the box
PIXELS_PER_VOXEL = 2.0
"""Pixels per voxel at far depths: finer depth maps do not improve the volume."""
FAR = 0.9  # quantile of a view's depths in the box used as far depth
SAMPLED = 4  # open3d looks for voxels at every fourth pixel of a depth map, and fails without any
POISSON_DEPTH = 9  # of the octree of the watertight reconstruction


class NoSurface(ValueError):
    """No surface can be extracted; the message says why."""


@dataclass(kw_only=True)
class SurfaceOptions:
    """Options of surface extraction."""

    resolution: Annotated[int, Field(ge=16, le=4096)] = 256
    """Voxels along the longest side of the observed box. Time and memory grow with its square."""
    triangles: Annotated[int, Field(ge=0, le=10**8)] = 500_000
    """Maximum number of triangles, reached by simplification (quadric error metrics); 0 = no limit."""
    watertight: bool = False
    """Close the mesh, for 3D printing, by Poisson reconstruction, which invents surface in unobserved regions; open or
    self-touching parts are cut and filled."""


@torch.no_grad()
def median_depth(surfels: Mapping[str, Tensor], camera: Camera, near: float, alpha: TexelAlpha | None = None) -> Tensor:
    """Compute the median depth [H, W], camera z of the fragment at which the accumulated blending weight reaches 0.5; 0
    if none does. `surfels`: geometry by name (`GEOMETRY`). `near`: near plane, camera z. `alpha`: opacities of texels;
    None: opaque. Raises TooManyFragments: a row of screen tiles has more fragments than memory holds."""
    projection = project(*geometry_of(surfels), camera=camera, near=near, alpha=alpha)
    rows = []
    for fragments in fitting_lists(projection):
        order = fragments.pixel.argsort(stable=True)  # keeps the front-to-back order within each pixel
        weight = fragments.weight[order].double()
        total = weight.cumsum(0)
        part = fragments.weight.new_zeros(fragments.height * fragments.width)
        count = torch.bincount(fragments.pixel, minlength=len(part))
        before = torch.cat([total.new_zeros(1), total])[count.cumsum(0) - count]  # total of all previous pixels
        reached = total - before.repeat_interleave(count)
        crossing = order[(reached >= HALF) & (reached - weight < HALF)]
        part[fragments.pixel[crossing].long()] = fragments.depth[crossing]
        rows.append(part.view(fragments.height, fragments.width))
    return torch.cat(rows)


def observed_box(depths: Sequence[Tensor], cameras: Sequence[Camera]) -> Tensor:
    """Compute the box [2, 3] around the points of depth maps, by `QUANTILE` and `REACH`. Raises NoSurface: there are no
    cameras, or no pixel has a depth."""
    if not cameras:
        raise NoSurface("there are no cameras that see the surface")
    points = torch.cat([_points(depth, camera) for depth, camera in zip(depths, cameras, strict=True)])
    if not len(points):
        raise NoSurface("no pixel of the cameras' views is covered to one half: there is no surface to fuse")
    centers = torch.stack([camera.center.cpu() for camera in cameras])
    middle = centers.mean(0)
    typical = torch.cat([depth[depth > 0] for depth in depths]).median()
    reach = REACH * max(float((centers - middle).norm(dim=1).max()), float(typical))
    inside = points[((points - middle).abs() <= reach).all(1)]
    low, high = (torch.from_numpy(np.quantile(inside.numpy(), q, axis=0)) for q in (QUANTILE, 1 - QUANTILE))
    margin = 0.02 * (high - low).max()
    return torch.stack([low - margin, high + margin])


def _points(depth: Tensor, camera: Camera) -> Tensor:
    """Unproject the pixels of known depth [H, W] to world points [M, 3]."""
    y, x = (depth > 0).nonzero(as_tuple=True)
    return camera.to("cpu").unproject(x.cpu() + 0.5, y.cpu() + 0.5, depth[y, x].cpu().double())


def extract_surface(
    surfels: Mapping[str, Tensor],
    render: Callable[[Camera], Tensor],
    cameras: Sequence[Camera],
    near: float,
    options: SurfaceOptions | None = None,
    progress: Progress = no_progress,
    alpha: TexelAlpha | None = None,
    to: Similarity | None = None,
) -> Triangles:
    """Fuse the median depths of views (`median_depth`) into a triangle mesh with vertex colors. `render`: renders the
    colors [H, W, 3] of a view. `to`: transform to the mesh's frame; None: the scene's. Raises NoSurface: there is
    nothing to fuse. Raises ValueError: an option is out of range."""
    import open3d

    options = options or SurfaceOptions()
    check_ranges(options)
    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):  # errors are raised here instead
        small = [camera.within(BOX_SIDE) for camera in cameras]
        depths = []
        for i, camera in enumerate(small):
            depths.append(median_depth(surfels, camera, near, alpha).cpu())
            progress("finding the box", i + 1, len(small))
        box = observed_box(depths, small)
        voxel = float((box[1] - box[0]).max()) / options.resolution
        real = open3d.core.float32
        # ScalableTSDFVolume of 0.20.0 fuses nothing
        volume = open3d.t.geometry.VoxelBlockGrid(("tsdf", "weight", "color"), (real,) * 3, ((1), (1), (3)), voxel)
        for i, camera in enumerate(cameras):
            inside = _cut(depths[i], small[i], box)
            far = inside[inside > 0].quantile(FAR).item() if inside.any() else 0.0
            side = max(camera.width, camera.height) * (PIXELS_PER_VOXEL * far / voxel)
            camera = camera.within(max(BOX_SIDE, math.ceil(side / float(camera.K[:2, :2].diagonal().max()))))
            depth = _cut(median_depth(surfels, camera, near, alpha).cpu(), camera, box)
            if bool((depth[::SAMPLED, ::SAMPLED] > 0).any()):
                _integrate(volume, camera, depth, render(camera))
            progress("fusing depth maps", i + 1, len(cameras))
        mesh = _in_order(volume.extract_triangle_mesh(0.0))
        if not len(mesh.triangles):
            raise NoSurface("the depth maps fuse to no surface: try a smaller --resolution")
        return _postprocess(mesh, options, progress, to)


def _cut(depth: Tensor, camera: Camera, box: Tensor) -> Tensor:
    """Set depths [H, W] of points outside the box [2, 3] to 0."""
    known = depth > 0
    points = _points(depth, camera)
    inside = ((points >= box[0]) & (points <= box[1])).all(1)
    cut = torch.zeros_like(depth)
    cut[known] = torch.where(inside, depth[known], 0.0)
    return cut


def _integrate(volume: open3d.t.geometry.VoxelBlockGrid, camera: Camera, depth: Tensor, rgb: Tensor) -> None:
    import open3d

    K, viewmat = camera.K.cpu().double(), camera.viewmat.cpu().double()
    K[:2, 2] -= 0.5  # open3d samples pixels at integer coordinates, this package at + 0.5
    K, viewmat = open3d.core.Tensor(K.numpy()), open3d.core.Tensor(viewmat.numpy())
    maps = (np.ascontiguousarray(image.float().numpy()) for image in (depth, rgb.clamp(0.0, 1.0).cpu()))
    depth, rgb = (open3d.t.geometry.Image(open3d.core.Tensor(image)) for image in maps)
    limits = (1.0, math.inf, TRUNCATION)  # the depth's unit, and the farthest
    blocks = volume.compute_unique_block_coordinates(depth, K, viewmat, *limits)
    volume.integrate(blocks, depth, rgb, K, K, viewmat, *limits)


def _in_order(mesh: open3d.t.geometry.TriangleMesh) -> open3d.geometry.TriangleMesh:
    """Sort vertices, joined where they fall together, and triangles, which come in the order of open3d's threads."""
    import open3d

    vertices, first, into = np.unique(mesh.vertex.positions.numpy(), axis=0, return_index=True, return_inverse=True)
    faces = into.ravel()[mesh.triangle.indices.numpy()]
    sorted_mesh = open3d.geometry.TriangleMesh(
        open3d.utility.Vector3dVector(vertices), open3d.utility.Vector3iVector(faces[np.lexsort(faces.T)])
    )
    sorted_mesh.vertex_colors = open3d.utility.Vector3dVector(mesh.vertex.colors.numpy()[first])
    return sorted_mesh.remove_degenerate_triangles()


def _postprocess(
    mesh: open3d.geometry.TriangleMesh, options: SurfaceOptions, progress: Progress, to: Similarity | None
) -> Triangles:
    import open3d

    labels, counts, _ = (np.asarray(part) for part in mesh.cluster_connected_triangles())
    mesh.remove_triangles_by_mask(counts[labels] < SMALLEST * counts.max())
    mesh.remove_unreferenced_vertices()
    progress("removing specks", 1, 1)
    if options.watertight:
        mesh.compute_vertex_normals()
        cloud = open3d.geometry.PointCloud(mesh.vertices)
        cloud.normals, cloud.colors = mesh.vertex_normals, mesh.vertex_colors
        mesh, _ = open3d.geometry.TriangleMesh.create_from_point_cloud_poisson(cloud, depth=POISSON_DEPTH)
    budget = options.triangles or len(mesh.triangles)
    simplified = mesh
    while True:
        if len(simplified.triangles) > budget:
            simplified = mesh.simplify_quadric_decimation(budget)
            progress("simplifying", 1, 1)
        result = _from_open3d(simplified.filter_smooth_taubin(SMOOTHING), to)
        if options.watertight:
            result = solid(result, SMALLEST)
            progress("closing the mesh", 1, 1)
        if not len(result):
            raise NoSurface("nothing is left of the mesh: try more --triangles")
        if not options.triangles or len(result) <= options.triangles:
            return result
        budget -= len(result) - options.triangles  # triangles added to close holes


def _from_open3d(mesh: open3d.geometry.TriangleMesh, to: Similarity | None) -> Triangles:
    vertices = np.asarray(mesh.vertices)
    faces = np.asarray(mesh.triangles).astype(np.int64)
    if to is not None:
        vertices = to.points(torch.from_numpy(vertices)).numpy()
        if float(torch.linalg.det(to.turn)) < 0:  # a reflection turns triangles inside out
            faces = faces[:, ::-1]
    colors = np.asarray(mesh.vertex_colors).clip(0.0, 1.0)
    return cleaned(Triangles(vertices.astype(np.float32), faces, colors.astype(np.float32)))
