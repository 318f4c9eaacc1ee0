"""The surface of a scene as a triangle mesh: TSDF fusion of median depths (as in 2DGS, Huang et al. 2024).

open3d, which nerfstudio depends on, does the fusion, the extraction and the simplification.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from bitymi_ns.interchange.frame import Similarity
from bitymi_ns.interchange.triangles import Triangles, cleaned, solid
from bitymi_ns.ops import Prefilter, TexelAlpha, fitting_lists, project
from bitymi_ns.ops.project import GEOMETRY
from bitymi_ns.progress import Progress, no_progress
from bitymi_ns.ranges import check_ranges
from bitymi_ns.scene.baked import as_bytes
from bitymi_ns.scene.camera import Camera

if TYPE_CHECKING:
    import open3d

HALF = 0.5  # accumulated weight at which the median depth is reached
TRUNCATION = 8.0  # truncation distance of the TSDF in voxels; with 4, walls with noisy depth get more holes
SMOOTHING = 10  # iterations of Taubin smoothing, which takes the noise of depths and keeps volumes
QUANTILE = 0.01  # share of the observed points that the box leaves out at each of its sides
REACH = 3.0
"""Half the side of the largest box, in units of the greatest distance of a camera from their mean or, where that is
more, of the median depth of all views."""
SMALLEST = 0.005  # connected parts with less than this share of the triangles of the largest part are dropped
BOX_SIDE = 160  # longer side in pixels of the depth maps that the box is found from
PIXELS_PER_VOXEL = 2.0
"""Pixels along a voxel where a view is far: a finer depth map tells the volume nothing."""
FAR = 0.9  # quantile of a view's depths in the box that counts as far
POISSON_DEPTH = 9  # depth of the octree of the watertight reconstruction


class NoSurface(ValueError):
    """The cameras see no surface that could be fused; the message says why."""


@dataclass(kw_only=True)
class SurfaceOptions:
    """Options of the extraction of a surface."""

    resolution: Annotated[int, Field(ge=16, le=4096)] = 256
    """Voxels along the longest side of the box that holds what the cameras see, 16 to 4096. Time and memory grow with
    its square."""
    triangles: Annotated[int, Field(ge=0, le=10**8)] = 500_000
    """Budget of triangles, met by simplification (quadric error metrics); 0 = no limit."""
    watertight: bool = False
    """Close the mesh, for printing: a Poisson reconstruction, of which what is open or touches itself is cut away and
    filled. Invents surface where nothing was seen."""


@torch.no_grad()
def median_depth(
    surfels: Mapping[str, Tensor],
    camera: Camera,
    near: float,
    prefilter: Prefilter = "low_pass",
    alpha: TexelAlpha | None = None,
) -> Tensor:
    """Depth at which half of the light of each pixel is blocked.

    Args:
        surfels: geometry by name (`GEOMETRY`), of N surfels.
        near: nearest depth that is drawn, camera z.
        prefilter: as in `ops.project`.
        alpha: opacities of the surfels' texels; None = opaque texels.

    Returns:
        [H, W] camera z of the first fragment with which the blending weights of its pixel reach 0.5; 0 where they do
        not.

    Raises:
        TooManyFragments: a single row of screen tiles has more fragments than memory holds.
    """
    projection = project(*(surfels[name] for name in GEOMETRY), camera, near, prefilter, alpha=alpha)
    rows = []
    for fragments in fitting_lists(projection):
        order = fragments.pixel.argsort(stable=True)  # front to back within each pixel, as the fragments of a tile are
        weight = fragments.weight[order].double()
        total = weight.cumsum(0)
        part = fragments.weight.new_zeros(fragments.height * fragments.width)
        count = torch.bincount(fragments.pixel, minlength=len(part))
        before = torch.cat([total.new_zeros(1), total])[count.cumsum(0) - count]  # of the pixels in front
        reached = total - before.repeat_interleave(count)
        crossing = order[(reached >= HALF) & (reached - weight < HALF)]
        part[fragments.pixel[crossing].long()] = fragments.depth[crossing]
        rows.append(part.view(fragments.height, fragments.width))
    return torch.cat(rows)


def observed_box(depths: Sequence[Tensor], cameras: Sequence[Camera]) -> Tensor:
    """[2, 3] corners of the box that holds what the cameras see, without the outermost `QUANTILE` of it, cut to `REACH`
    times the extent of the cameras or their median depth.

    Raises:
        NoSurface: no depth is known.
    """
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
    """[M, 3] world points of the pixels [H, W] whose depth is known."""
    y, x = (depth > 0).nonzero(as_tuple=True)
    return camera.to("cpu").unproject(x.cpu() + 0.5, y.cpu() + 0.5, depth[y, x].cpu().double())


def extract_surface(
    surfels: Mapping[str, Tensor],
    render: Callable[[Camera], Tensor],
    cameras: Sequence[Camera],
    near: float,
    options: SurfaceOptions | None = None,
    prefilter: Prefilter = "low_pass",
    progress: Progress = no_progress,
    alpha: TexelAlpha | None = None,
    to: Similarity | None = None,
) -> Triangles:
    """Fuse the median depths of views into a triangle mesh with vertex colors.

    Args:
        surfels: geometry by name (`GEOMETRY`).
        render: [H, W, 3] colors of a view, for the vertices.
        near: nearest depth that is drawn, camera z.
        prefilter: as in `ops.project`.
        alpha: as in `median_depth`.
        to: the frame of the mesh; None = the scene's.

    Raises:
        NoSurface: there is nothing to fuse.
        ValueError: an option is out of range.
    """
    import open3d

    options = options or SurfaceOptions()
    check_ranges(options)
    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):  # it warns of what is raised here
        small = [camera.within(BOX_SIDE) for camera in cameras]
        depths = []
        for i, camera in enumerate(small):
            depths.append(median_depth(surfels, camera, near, prefilter, alpha).cpu())
            progress("finding the box", i + 1, len(small))
        box = observed_box(depths, small)
        voxel = float((box[1] - box[0]).max()) / options.resolution
        volume = open3d.pipelines.integration.ScalableTSDFVolume(
            voxel, TRUNCATION * voxel, open3d.pipelines.integration.TSDFVolumeColorType.RGB8
        )
        for i, camera in enumerate(cameras):
            inside = _cut(depths[i], small[i], box)
            far = inside[inside > 0].quantile(FAR).item() if inside.any() else 0.0
            camera = _coarsened(camera, PIXELS_PER_VOXEL * far / voxel)
            depth = _cut(median_depth(surfels, camera, near, prefilter, alpha).cpu(), camera, box)
            rgb = as_bytes(render(camera)).numpy()
            picture = open3d.geometry.RGBDImage.create_from_color_and_depth(
                open3d.geometry.Image(np.ascontiguousarray(rgb)),
                open3d.geometry.Image(np.ascontiguousarray(depth.float().numpy())),
                depth_scale=1.0,
                depth_trunc=math.inf,
                convert_rgb_to_intensity=False,
            )
            K = camera.K.cpu().double()
            # open3d samples a pixel at its integer coordinates, this package half a pixel further
            pinhole = (K[0, 0].item(), K[1, 1].item(), K[0, 2].item() - 0.5, K[1, 2].item() - 0.5)
            intrinsic = open3d.camera.PinholeCameraIntrinsic(camera.width, camera.height, *pinhole)
            volume.integrate(picture, intrinsic, camera.viewmat.cpu().double().numpy())
            progress("fusing depth maps", i + 1, len(cameras))
        mesh = volume.extract_triangle_mesh()
        if not len(mesh.triangles):
            raise NoSurface("the depth maps fuse to no surface: try a smaller --resolution")
        return _finished(mesh, options, progress, to)


def _coarsened(camera: Camera, focal: float) -> Camera:
    """The camera with pictures reduced to a focal length in pixels, but not below `BOX_SIDE`."""
    side = max(camera.width, camera.height)
    return camera.within(max(BOX_SIDE, math.ceil(side * focal / float(camera.K[:2, :2].diagonal().max()))))


def _cut(depth: Tensor, camera: Camera, box: Tensor) -> Tensor:
    """The depths [H, W] of points within the box [2, 3], 0 elsewhere."""
    known = depth > 0
    points = _points(depth, camera)
    inside = ((points >= box[0]) & (points <= box[1])).all(1)
    cut = torch.zeros_like(depth)
    cut[known] = torch.where(inside, depth[known], 0.0)
    return cut


def _finished(
    mesh: open3d.geometry.TriangleMesh, options: SurfaceOptions, progress: Progress, to: Similarity | None
) -> Triangles:
    """The mesh in its frame without specks, closed where asked for, within the budget of triangles."""
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
    few = mesh
    while True:
        if len(few.triangles) > budget:
            few = mesh.simplify_quadric_decimation(budget)
            progress("simplifying", 1, 1)
        result = _as_written(few.filter_smooth_taubin(SMOOTHING), to)
        if options.watertight:
            result = solid(result, SMALLEST)
            progress("closing the mesh", 1, 1)
        if not len(result):
            raise NoSurface("nothing is left of the mesh: try more --triangles")
        if not options.triangles or len(result) <= options.triangles:
            return result
        budget -= len(result) - options.triangles  # triangles that close holes


def _as_written(mesh: open3d.geometry.TriangleMesh, to: Similarity | None) -> Triangles:
    """The mesh in another frame."""
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.triangles).astype(np.int64)
    if to is not None:
        vertices = to.points(torch.from_numpy(vertices)).numpy()
        if float(torch.linalg.det(to.turn)) < 0:  # a mirror image turns triangles inside out
            faces = faces[:, ::-1]
    colors = np.asarray(mesh.vertex_colors).clip(0.0, 1.0)
    return cleaned(Triangles(vertices.astype(np.float32), faces, colors.astype(np.float32)))
