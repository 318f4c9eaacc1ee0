"""The scene that training starts from: its surfels, and where in space the texture field lies."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from bitymi_ns.ops.constants import SUPPORT
from bitymi_ns.ranges import check_ranges
from bitymi_ns.scene.camera import Camera
from bitymi_ns.scene.config import SceneConfig
from bitymi_ns.scene.field import HashField
from bitymi_ns.scene.scene import NEAR, Scene
from bitymi_ns.train.background_points import BackgroundPoints, background_points
from bitymi_ns.train.config import TrainConfig
from bitymi_ns.train.init import PointReport, scene_extent, surfels_from_points
from bitymi_ns.train.views import View


def build_scene(
    points: Tensor,
    colours: Tensor,
    camera_centers: Tensor,
    scene_config: SceneConfig,
    train_config: TrainConfig,
    bounded: bool,
    image_pixels: int,
    box: Tensor | None = None,
    declared: Tensor | None = None,
    background: BackgroundPoints | None = None,
) -> tuple[Scene, PointReport]:
    """Surfels at the points, or at random in the box, and an empty texture field around them.

    Args:
        points: [M, 3] world positions; M may be 0.
        colours: [M, 3] in [0, 1].
        camera_centers: [C, 3] world positions of the training cameras.
        scene_config: the representation.
        train_config: training options.
        bounded: there is nothing behind the scene (images with alpha): contraction "auto" is then off, as it is for
            scenes with a small `declared` box.
        image_pixels: of all training images together; decides the size of the hash table where none is given.
        box: [2, 3] corners for random surfels; default: the cube of the scene extent about the cameras.
        declared: [2, 3] corners of the box that the capture declares to hold its scene, if it does.
        background: further points, in parts of the photographs that show none.

    Returns:
        The scene on the CPU, and what became of the points.

    Raises:
        ValueError: an option is out of range, or there is nothing to start from.
    """
    check_ranges(scene_config)
    check_ranges(train_config)
    surfels, report = surfels_from_points(points, colours, camera_centers, train_config, scene_config, box, background)
    means = surfels["means"][: len(surfels["means"]) - report.background]  # the others would make the field coarse
    near = NEAR * scene_extent(camera_centers, means)
    if scene_config.texture != "hash":  # texels are added once the geometry has settled
        return Scene(scene_config, surfels, None, near), report
    if declared is not None:  # captures of open scenes may declare a large box: a grid over it would be coarser than
        # one over contracted space, which is twice as wide as the cameras' ball
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
    views: Sequence[View], points: Tensor, colors: Tensor, scene_config: SceneConfig, train_config: TrainConfig
) -> Scene:
    """`build_scene` for photographs that are in memory.

    Args:
        views: training photographs at full size.
        points: [M, 3] world positions; M may be 0.
        colors: [M, 3] in [0, 1].
        scene_config, train_config: the representation, and training options.
    """
    centers = torch.stack([view.camera.center.cpu() for view in views]) if views else torch.zeros(0, 3)
    pixels = sum(view.camera.width * view.camera.height for view in views)
    bounded = any(view.image.shape[-1] == 4 for view in views)
    points, colors = points.cpu(), colors.cpu()
    background = background_points(points, views, train_config.seed) if train_config.background_points else None
    return build_scene(points, colors, centers, scene_config, train_config, bounded, pixels, background=background)[0]


def field_domain(means: Tensor, camera_centers: Tensor, contract: bool) -> tuple[tuple[float, float, float], float]:
    """Middle and half size of the field's domain, world units.

    With contraction: the ball about the mean of the cameras that holds them all (`scene_extent`). Without: a cube
    around `means` (the first surfels, or the corners of the capture's box), a tenth larger.
    """
    if contract and len(camera_centers):
        middle = camera_centers.detach().float().cpu().mean(0)
        return tuple(middle.tolist()), scene_extent(camera_centers, means)  # type: ignore[return-value]
    low, high = means.amin(0), means.amax(0)
    middle, half = (low + high) / 2, 0.55 * float((high - low).max())
    return tuple(middle.tolist()), max(half, 1e-3)  # type: ignore[return-value]


def default_table_size(image_pixels: int) -> int:
    """Entries per hash level, as a power of two: what the photographs can tell apart, and what a cache can hold.

    Four levels of 2^17 entries are 8 MB in float32.
    """
    return min(17, max(14, table_size_of(image_pixels)))


def table_size_of(image_pixels: int) -> int:
    """Entries per hash level, as a power of two, that the photographs can tell apart: one entry of 4 features for 32
    pixels of all photographs together."""
    return round(math.log2(max(1, image_pixels) / 32))


SAMPLE = 4096  # surfels that are tested first: nearly all views see one of them
CHUNK = 1 << 20


@torch.no_grad()
def views_without_surfels(scene: Scene, cameras: Sequence[Camera]) -> list[int]:
    """Numbers of the views that no surfel can be seen in.

    A surfel counts as seen where the ball around it, as large as its disc, reaches beyond the near plane and into the
    picture.

    Args:
        scene: as training starts.
        cameras: of the views.
    """
    means = scene.surfels["means"].detach()
    radii = SUPPORT * scene.surfels["log_scales"].detach().exp().amax(-1)
    first = torch.randperm(len(means), generator=torch.Generator().manual_seed(0))[:SAMPLE].to(means.device)
    return [
        i
        for i, camera in enumerate(cameras)
        if not _sees(camera, means[first], radii[first], scene.near)
        and not any(
            _sees(camera, *chunk, scene.near) for chunk in zip(means.split(CHUNK), radii.split(CHUNK), strict=True)
        )
    ]


def _sees(camera: Camera, means: Tensor, radii: Tensor, near: float) -> bool:
    camera = camera.to(means.device)
    x, y, z = camera.local(means).unbind(-1)
    K = camera.K
    depth = z.clamp(min=near)
    seen = z > near - radii
    for along, focal, middle, size in ((x, K[0, 0], K[0, 2], camera.width), (y, K[1, 1], K[1, 2], camera.height)):
        at, reach = focal * along / depth + middle, focal * radii / depth
        seen &= (at > -reach) & (at < size + reach)
    return bool(seen.any())
