"""Initial scene: surfels from the sparse points, and the domain of the texture field."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from bitymi_ns.ops.constants import COLOR_BIAS
from bitymi_ns.ops.parameters import GEOMETRY_PARAMETERS
from bitymi_ns.ops.view_kinds import entry_of
from bitymi_ns.ranges import check_ranges
from bitymi_ns.scene.config import SceneConfig
from bitymi_ns.scene.field import HashField
from bitymi_ns.scene.scene import NEAR, Scene
from .background_points import BackgroundPoints, background_points
from .config import TrainConfig
from .views import View

MAX_SCALE = 0.25
"""Largest initial scale, as a fraction of the larger of scene extent and distance to the nearest camera."""
PIXELS_PER_FIRST_SURFEL = 1000  # pixels rendered in a run per initial surfel, at least
FEWEST_FIRST = 5000  # initial surfels that runs of any length may have
MIN_SCALE = 1e-6  # smallest initial scale, as a fraction of the scene extent


@dataclass
class PointReport:
    """Counts of the sparse points used and dropped."""

    given: int
    not_finite: int = 0
    duplicates: int = 0
    over_cap: int = 0
    random: int = 0  # Random surfels, because no point was usable.
    background: int = 0  # Surfels added where the photographs show no point (`background_points`).


def limit_first_surfels(config: TrainConfig, steps: int, pixels: int, views: int) -> TrainConfig:
    """Set `first_surfels` by the length of the run, unless given. `pixels`: total of `views` training views at full
    size."""
    if config.first_surfels is not None or not views:
        return config
    return replace(config, first_surfels=max(FEWEST_FIRST, int(steps * pixels / views / PIXELS_PER_FIRST_SURFEL)))


def _finite(positions: Tensor, dtype: torch.dtype) -> Tensor:
    """Keep the finite rows of positions [M, 3], on the CPU."""
    positions = positions.detach().reshape(-1, 3).to("cpu", dtype)
    return positions[positions.isfinite().all(-1)]


def scene_extent(camera_centers: Tensor, points: Tensor | None = None) -> float:
    """Compute 1.1 times the largest distance of training cameras [C, 3] from their mean, world units. If all are at one
    position: the median distance of the finite points [M, 3] from it, and 1 without points."""
    centers = _finite(camera_centers, torch.float64)
    middle = centers.mean(0) if len(centers) else torch.zeros(3, dtype=torch.float64)
    reach = float((centers - middle).norm(dim=-1).max()) if len(centers) else 0.0
    if reach > 1e-6 * max(1.0, float(middle.norm())):
        return 1.1 * reach
    points = centers[:0] if points is None else _finite(points, torch.float64)
    median = float((points - middle).norm(dim=-1).median()) if len(points) else 0.0
    return median if median > 0.0 else 1.0


def surfels_from_points(
    xyz: Tensor,
    rgb: Tensor,
    camera_centers: Tensor,
    config: TrainConfig,
    scene_config: SceneConfig,
    box: Tensor | None = None,
    background: BackgroundPoints | None = None,
) -> tuple[dict[str, Tensor], PointReport]:
    """Initialise surfel parameters from sparse points.

    A surfel has scale `neighbour_distance`, its normal towards the nearest camera, a random in-plane rotation, and its
    point's colour from every direction. Duplicate points and those that are not finite are dropped; of more than the
    options allow, a random subset is used. Without a usable point, `config.random_points` surfels are sampled in `box`.

    Args:
        xyz: [M, 3] world positions; M may be 0.
        rgb: [M, 3] colours in [0, 1]; grey where not finite.
        camera_centers: [C, 3] world positions; without cameras, orientations are random.
        box: [2, 3] corners for random surfels; default: the cube of the scene extent about the cameras.
        background: as of `background_points`.

    Returns:
        Parameters by name, float32, on the CPU (docs/overview.md), and counts of points.

    Raises:
        ValueError: `xyz` and `rgb` differ in length.
    """
    generator = torch.Generator().manual_seed(config.seed)
    centers = _finite(camera_centers, torch.float32)
    xyz = xyz.detach().reshape(-1, 3).float().cpu()
    rgb = rgb.detach().reshape(-1, 3).float().cpu()
    if len(xyz) != len(rgb):
        raise ValueError(f"{len(xyz)} points came with {len(rgb)} colours")
    xyz, rgb, report = _usable(xyz, rgb)
    if len(xyz) == 0:
        xyz, rgb = _random_points(config.random_points, centers, box, generator)
        report.random = len(xyz)
    cap = min((most for most in (config.densify.max_surfels, config.first_surfels or 0) if most > 0), default=0)
    if 0 < cap < len(xyz):
        report.over_cap = len(xyz) - cap
        keep = torch.randperm(len(xyz), generator=generator)[:cap].sort().values
        xyz, rgb = xyz[keep], rgb[keep]
    extent = scene_extent(centers, xyz)
    first = len(xyz)
    if background is not None and report.random == 0:
        report.background = min(len(background.xyz), int(config.background_points * first))
        if config.densify.max_surfels > 0:
            report.background = min(report.background, config.densify.max_surfels - first)
        xyz = torch.cat([xyz, background.xyz[: report.background]])
        rgb = torch.cat([rgb, background.rgb[: report.background]])
    n = len(xyz)
    to_camera, camera_distance = _nearest_camera(xyz, centers)
    largest = MAX_SCALE * torch.clamp(camera_distance, min=extent)
    if background is not None and report.background:
        largest[first:] = torch.minimum(largest[first:], background.scales[: report.background])
    scales = torch.minimum(neighbour_distance(xyz, extent), largest).clamp(min=MIN_SCALE * extent)
    logit = math.log(config.init_opacity / (1.0 - config.init_opacity))
    surfels = {
        "means": xyz.clone(),
        "quats": _orientation(to_camera, generator),
        "log_scales": scales.log()[:, None].repeat(1, 2),
        "opacity_logits": torch.full((n,), logit),
        **{p.name: torch.full((n, *p.shape), p.start) for p in GEOMETRY_PARAMETERS.values() if p.start is not None},
        **entry_of(scene_config.view_color).first_values(rgb - COLOR_BIAS, scene_config, generator),
    }
    return surfels, report


def neighbour_distance(xyz: Tensor, extent: float) -> Tensor:
    """Compute the root mean square distance [M] of each point to its nearest neighbours, at most 3; a hundredth of the
    extent for a single point."""
    from scipy.spatial import cKDTree  # slow to import

    k = min(3, len(xyz) - 1)
    if k < 1:
        return torch.full((len(xyz),), 0.01 * extent)
    points = xyz.double().numpy()
    distances, _ = cKDTree(points).query(points, k=k + 1)  # the nearest is the point itself
    return torch.from_numpy(np.sqrt(np.mean(np.square(distances[:, 1:]), axis=1))).float()


def _usable(xyz: Tensor, rgb: Tensor) -> tuple[Tensor, Tensor, PointReport]:
    report = PointReport(given=len(xyz))
    finite = xyz.isfinite().all(-1)
    report.not_finite = int((~finite).sum())
    xyz = xyz[finite]
    rgb = rgb[finite].nan_to_num(0.5, 0.5, 0.5).clamp(0.0, 1.0)
    if len(xyz) == 0:
        return xyz, rgb, report
    _, first = np.unique(xyz.numpy() + 0.0, axis=0, return_index=True)  # + 0.0 turns -0 into 0
    report.duplicates = len(xyz) - len(first)
    keep = torch.from_numpy(np.sort(first))
    return xyz[keep], rgb[keep], report


def _random_points(n: int, centers: Tensor, box: Tensor | None, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    if box is None:
        middle = centers.mean(0) if len(centers) else torch.zeros(3)
        extent = scene_extent(centers)
        box = torch.stack([middle - extent, middle + extent])
    low, high = box.detach().float().cpu()
    xyz = low + (high - low) * torch.rand(n, 3, generator=generator)
    return xyz, torch.rand(n, 3, generator=generator)


def _nearest_camera(xyz: Tensor, centers: Tensor) -> tuple[Tensor, Tensor]:
    """Compute vectors [M, 3] to the nearest camera centre and their lengths [M]; zeros without cameras."""
    if len(centers) == 0:
        return torch.zeros_like(xyz), torch.zeros(len(xyz))
    nearest = torch.cat([torch.cdist(chunk, centers).argmin(-1) for chunk in xyz.split(65_536)])
    to_camera = centers[nearest] - xyz
    return to_camera, to_camera.norm(dim=-1)


def _orientation(to_camera: Tensor, generator: torch.Generator) -> Tensor:
    """Compute quaternions [M, 4] of surfels with normals along `to_camera` [M, 3], random if that is 0."""
    n = len(to_camera)
    angles = 2.0 * math.pi * torch.rand(n, generator=generator)
    fallback = torch.nn.functional.normalize(torch.randn(n, 3, generator=generator), dim=-1)
    distance = to_camera.norm(dim=-1, keepdim=True)
    normals = torch.where(distance > 1e-12, to_camera / distance.clamp(min=1e-12), fallback)
    return quat_from_normal(normals, angles)


def quat_from_normal(normals: Tensor, angles: Tensor) -> Tensor:
    """Compute unit quaternions [N, 4] that rotate about z by angles [N], radians, and then take z to unit normals
    [N, 3]."""
    x, y, z = normals.unbind(-1)
    zero = torch.zeros_like(x)
    tilt = torch.stack([1.0 + z, -y, x, zero], -1)  # shortest rotation from (0, 0, 1); vanishes at -z
    flip = torch.tensor([0.0, 1.0, 0.0, 0.0], dtype=tilt.dtype, device=tilt.device)
    tilt = torch.where((tilt.norm(dim=-1) < 1e-4)[:, None], flip, tilt)
    return rotate_in_plane(tilt / tilt.norm(dim=-1, keepdim=True), angles)


def rotate_in_plane(quats: Tensor, angles: Tensor) -> Tensor:
    """Rotate surfels [N, 4] in their planes by angles [N], radians, from first to second tangent."""
    w, x, y, z = quats.unbind(-1)
    cos, sin = torch.cos(angles / 2), torch.sin(angles / 2)
    return torch.stack([w * cos - z * sin, x * cos + y * sin, y * cos - x * sin, z * cos + w * sin], -1)


def tangents(quats: Tensor) -> Tensor:
    """Compute the tangents u, v of surfels, [N, 3, 2] unit vectors: the first two columns of their rotation matrices.
    `quats`: [N, 4] of any length; zero: no rotation."""
    norm = quats.norm(dim=-1, keepdim=True)
    identity = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=quats.dtype, device=quats.device)
    w, x, y, z = torch.where(norm > 0, quats / norm.clamp(min=torch.finfo(quats.dtype).tiny), identity).unbind(-1)
    u = torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], -1)
    v = torch.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], -1)
    return torch.stack([u, v], -1)


def build_scene(
    points: Tensor,
    colors: Tensor,
    camera_centers: Tensor,
    scene_config: SceneConfig,
    train_config: TrainConfig,
    bounded: bool,
    image_pixels: int,
    box: Tensor | None = None,
    declared: Tensor | None = None,
    background: BackgroundPoints | None = None,
) -> tuple[Scene, PointReport]:
    """Build the initial scene on the CPU: surfels (`surfels_from_points`) and an untrained field.

    Args:
        bounded: the scene has no background (images with alpha): contraction "auto" is then off, as with a small
            `declared` box.
        image_pixels: total over all training images, for the size of the hash table.
        declared: [2, 3] corners of the scene box that the capture states.

    Raises:
        ValueError: an option is out of range.
    """
    check_ranges(scene_config)
    check_ranges(train_config)
    surfels, report = surfels_from_points(points, colors, camera_centers, train_config, scene_config, box, background)
    means = surfels["means"][: len(surfels["means"]) - report.background]  # others would make the field coarse
    near = NEAR * scene_extent(camera_centers, means)
    if scene_config.texture != "hash":  # texels are added once the geometry has settled
        return Scene(scene_config, surfels, None, near), report
    if declared is not None:  # over a larger box a grid would be coarser than over contracted space
        bounded |= float((declared[1] - declared[0]).max()) <= 4 * scene_extent(camera_centers)
    contract = scene_config.contraction == "on" or (scene_config.contraction == "auto" and not bounded)
    mid, half = field_domain(means if declared is None else declared, camera_centers, contract)
    log2_size = scene_config.log2_table_size
    if log2_size is None:
        log2_size = default_table_size(image_pixels)
    generator = torch.Generator().manual_seed(train_config.seed)
    field = HashField(scene_config, mid, half, contract, log2_size, generator)
    return Scene(scene_config, surfels, field, near), report


def scene_for_views(
    views: Sequence[View],
    points: Tensor,
    colors: Tensor,
    scene_config: SceneConfig,
    train_config: TrainConfig,
    steps: int | None = None,
) -> Scene:
    """Build the initial scene for views at full size and points, see `build_scene`. `steps`: length of the run, which
    limits the number of points; None: no limit."""
    centers = torch.stack([view.camera.center.cpu() for view in views]) if views else torch.zeros(0, 3)
    pixels = sum(view.camera.width * view.camera.height for view in views)
    bounded = any(view.image.shape[-1] == 4 for view in views)
    if steps is not None:
        train_config = limit_first_surfels(train_config, steps, pixels, len(views))
    points, colors = points.cpu(), colors.cpu()
    background = background_points(points, views, train_config.seed) if train_config.background_points else None
    return build_scene(points, colors, centers, scene_config, train_config, bounded, pixels, background=background)[0]


def field_domain(means: Tensor, camera_centers: Tensor, contract: bool) -> tuple[tuple[float, float, float], float]:
    """Compute centre and half size of the field's domain, world units: with contraction of the ball around all cameras
    (`scene_extent`), without of a cube a tenth larger than the box of `means`."""
    if contract and len(camera_centers):
        x, y, z = camera_centers.detach().float().cpu().mean(0).tolist()
        return (x, y, z), scene_extent(camera_centers, means)
    low, high = means.amin(0), means.amax(0)
    x, y, z = ((low + high) / 2).tolist()
    return (x, y, z), max(0.55 * float((high - low).max()), 1e-3)


def default_table_size(image_pixels: int) -> int:
    """Choose log2 of the entries per hash level, at most 17: four such levels, 8 MB, fit into a cache."""
    return min(17, max(14, table_size_of(image_pixels)))


def table_size_of(image_pixels: int) -> int:
    """Compute log2 of the entries per hash level that the photographs support: one (4 features) per 32 pixels."""
    return round(math.log2(max(1, image_pixels) / 32))
