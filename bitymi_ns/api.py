"""Public functions, none of which needs nerfstudio."""

import copy
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from .bake import BakeOptions, RefineOptions, bake, export
from .bake.compact import Compact
from .bundle import Bundle, read_bundle, reserved_bundle
from .bundle.cameras import CapturedCamera, cameras_data
from .bundle.parts import CAMERAS
from .capture.image_files import in_threads, pixels_of, read_image
from .capture.lens import Lens, make_lenses
from .capture.masks import checked_mask
from .capture.points import Points
from .capture.read import CaptureOptions, check_options, read_capture
from .capture.types import OPENCV_AXES, Photograph
from .ops import (
    Fragments,
    Projection,
    blended_image,
    can_rasterize,
    draw_by_lists,
    project,
    rasterize_image,
    trace,
)
from .ops.backend import on_same_device
from .ops.capacity import memory_errors
from .ops.constants import BETA_MAX, COLOR_BIAS
from .ops.project import geometry_of
from .scene.camera import Camera
from .scene.scene import NEAR, RenderOutput, Scene
from .train.config import RefinePoses
from .train.fit import TrainLog, fit
from .train.init import scene_for_views
from .train.preset import load_preset
from .train.view_checks import check_counted, check_points, checked_views, learning_modes
from .train.views import View

__all__ = ["Bundle", "Camera", "View", "bake_scene", "load_capture", "rasterize", "read_bundle", "train_scene"]


def load_capture(
    path: str | Path, part: Literal["all", "train", "val", "test"] = "all", **options: Any
) -> tuple[list[View], Tensor, Tensor]:
    """Load a capture of any format that `ns-train` reads: photographs with cameras and masks, and points.

    Photographs are undistorted; those of wide cameras become several views. All stay in memory. Poses, scale and axes
    are those of the capture's files, but a COLMAP model's are turned so that up, about -y, is z. Cameras and points are
    float32: translate captures with large coordinates (UTM) to the origin first.

    Args:
        path: a folder, or a file: transforms.json or a video.
        part: photographs to load: all by name, or a part of the capture's own split; without one, every eighth is "val"
            and "test".
        options: fields of `capture.read.CaptureOptions`, as `downscale_factor=2` or `points="random"` (none).

    Returns:
        views: `Camera`s are world to camera with OpenCV axes (x right, y down, z forward), in pixels; images uint8
            [H, W, 3], or [H, W, 4] with straight alpha; masks [H, W] bool or None.
        points: [M, 3] of the capture, triangulated where it has none and kept beside the photographs; M may be 0.
        colors: [M, 3] in [0, 1].

    Raises:
        CaptureError, a ValueError: the capture cannot be used, or an option is out of range.
        TypeError, KeyError: there is no such option, or part.
    """
    asked = CaptureOptions(data=Path(path), **options)
    check_options(asked)
    capture = read_capture(asked)
    every = capture.photographs
    chosen = every if part == "all" else [every[i] for i in capture.parts[part]]
    pairs = zip(chosen, make_lenses(chosen, capture.downscale), strict=True)
    views = in_threads(_view, [(photograph, lens) for photograph, lenses in pairs for lens in lenses])
    points = capture.points or Points(np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    return views, torch.from_numpy(points.xyz).float(), torch.from_numpy(points.rgb).float() / 255


def _view(source: tuple[Photograph, Lens]) -> View:
    photograph, lens = source
    to = lens.pinhole
    image = lens.undistort(read_image(photograph.file, lens.stored, lens.camera.size))
    viewmat = torch.from_numpy(np.linalg.inv(photograph.pose @ OPENCV_AXES @ lens.turn)).float()
    K = torch.tensor([[to.fx, 0.0, to.cx], [0.0, to.fy, to.cy], [0.0, 0.0, 1.0]], dtype=torch.float32)
    mask = None if photograph.mask is None else checked_mask(photograph.mask)
    whole = mask is None and lens.whole
    counts = None if whole else torch.from_numpy(np.array(lens.undistort_mask(mask, photograph.mask)))
    camera = Camera(viewmat, K, to.width, to.height)
    return View(camera, torch.from_numpy(pixels_of(image)), counts, file=photograph.file)


@memory_errors()
def rasterize(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    betas: Tensor,
    colors: Tensor,
    camera: Camera,
    background: Tensor | None = None,
    near: float = NEAR,
    maps: bool = False,
) -> RenderOutput:
    """Rasterize 2D Beta surfels with one color each; differentiable in everything but the intrinsics.

    The blending weight of a surfel is w = sigma T with sigma = min(0.99, o (1 - (u^2 + v^2) / 9)^beta) at the
    intersection (u, v) of the pixel's ray with the surfel's plane, in units of its scales.

    Args:
        means: [N, 3] centers, world frame.
        quats: [N, 4] rotations, wxyz, of any length; the first two columns of the matrix are the tangents.
        scales: [N, 2] > 0, lengths of the two tangents, world units; the disc ends at three times its scales.
        opacities: [N] from 0 to 1.
        betas: [N] from 0 to 4, exponent of the kernel: small = hard disc, 3.5 = nearly Gaussian.
        colors: [N, 3] in the images' own scale, clamped at 0.
        camera: its `viewmat` has a gradient projected onto rigid motions.
        background: [3] color behind the surfels; None: black.
        near: surfels with a nearer center are not drawn (camera z, world units).
        maps: also render depth and normals.
        All tensors are float32 or float64, of one dtype, on the CPU or on one CUDA device.

    Returns:
        `RenderOutput` with rgb [H, W, 3], alpha [H, W, 1], beta [H, W, 1] and, with `maps`, depth [H, W, 1] and normal
        [H, W, 3], both summed with the blending weights, in the camera frame.

    Raises:
        ValueError: a shape, dtype or device does not fit, a value is out of its range, or the camera has skew.
        TooManyFragments: those of a row of screen tiles do not fit into memory; larger views are drawn in bands.
        MemoryError: the picture does not fit.
    """
    on_same_device(means, scales=scales, opacities=opacities, betas=betas)
    _check_ranges(
        scales=(scales, torch.finfo(scales.dtype).tiny, torch.finfo(scales.dtype).max),
        opacities=(opacities, 0.0, 1.0),
        betas=(betas, 0.0, BETA_MAX),
    )
    surfels = {"means": means, "quats": quats, "log_scales": scales.log()}
    surfels |= {"opacity_logits": _logit(opacities), "beta_raw": _logit(betas / BETA_MAX)}
    projection = project(*geometry_of(surfels), camera=camera, near=near)
    base = colors - COLOR_BIAS
    if can_rasterize(means.device):
        image, fragments = rasterize_image(projection, base, maps=maps)
        return RenderOutput.of_image(image, projection, fragments, background, maps)

    def draw(part: Projection, most: int | None) -> tuple[Tensor, Fragments]:
        fragments = trace(part, most=most)
        return blended_image(fragments, part, base, maps=maps), fragments

    image, fragments = draw_by_lists(projection, draw)
    return RenderOutput.of_image(image, projection, fragments, background, maps)


def _check_ranges(**ranges: tuple[Tensor, float, float]) -> None:
    wrong = {name: ~((values >= low) & (values <= high)) for name, (values, low, high) in ranges.items()}
    if not torch.stack([rows.any() for rows in wrong.values()]).any():  # one wait for the device
        return
    name = next(name for name, rows in wrong.items() if rows.any())
    (values, low, high), row = ranges[name], tuple(wrong[name].nonzero()[0].tolist())
    limits = "above 0 and finite" if 0.0 < low else f"from {low:g} to {high:g}"
    raise ValueError(f"{name} have to be {limits}: {name}{list(row)} is {values[row].item():g}")


def _logit(p: Tensor) -> Tensor:
    """Compute logits, clamped to finite values with a straight-through gradient. The operations apply the sigmoid, as
    its slope o (1 - o) is exact as a function of the logit, but in float32 nothing is left of 1 - o where o -> 1."""
    nearest = p.clamp(1e-12, 1.0 - 8 * torch.finfo(p.dtype).eps)
    return torch.logit(p + (nearest - p).detach())


@learning_modes()
def train_scene(
    views: Sequence[View],
    points: Tensor,
    colors: Tensor,
    *,
    steps: int = 1500,
    method: str = "bitymi",
    eval_views: Sequence[View] = (),
    seed: int = 0,
    refine_poses: RefinePoses = "off",
    device: torch.device | str = "cpu",
    callback: Callable[[int, float], None] | None = None,
) -> tuple[Scene, TrainLog]:
    """Train a scene on photographs with known poses, with the training steps of `ns-train`, without nerfstudio.

    Args:
        views: photographs with their cameras, at full size.
        points: [M, 3] world positions of the initial surfels; M may be 0. A short run uses a random subset
            (`TrainConfig.first_surfels`).
        colors: [M, 3] in [0, 1], of the points.
        steps: length of the run; all schedules scale with it.
        method: preset, the name of a file in method_configs/.
        eval_views: held-out photographs, whose PSNR is logged.
        seed: of all random numbers.
        refine_poses: on = optimise the cameras, too (`log.cameras`).
        device: to train on.
        callback: called after each step with the number of steps done and the loss, which synchronises a CUDA device.

    Returns:
        The scene on `device`, and the log with the PSNR of `eval_views` and the cameras of `views`: if poses were
        refined, give `bake_scene` the views with these.

    Raises:
        ValueError: there are no views, their masks exclude everything, a view, points or colors are not as stated, an
            option is out of range, or torch is in inference mode.
        PresetError: there is no such preset.
    """
    views, eval_views = checked_views(views), checked_views(eval_views, "eval_views")
    check_counted(views)
    check_points(points, colors)
    preset = load_preset(method)
    config = replace(copy.deepcopy(preset.train), seed=seed, refine_poses=refine_poses)
    scene = scene_for_views(views, points, colors, preset.scene, config, steps)
    scene, views = scene.to(device), [view.to(device) for view in views]
    step_done = None if callback is None else lambda trainer: callback(trainer.step, trainer.loss)
    return scene, fit(scene, views, [view.to(device) for view in eval_views], config, steps, step_done)


@learning_modes()
def bake_scene(
    scene: Scene,
    views: Sequence[View],
    folder: str | Path,
    *,
    background: Tensor | None = None,
    overwrite: bool = False,
    options: BakeOptions | None = None,
    target_mb: float | None = None,
) -> Bundle:
    """Bake a trained scene to a bundle, as `ns-export bitymi-atlas` does, and read it back.

    Args:
        scene: of `train_scene`, with any texture; its device does the work.
        views: the training photographs, on which texels are fine-tuned, with their `correction` if any.
        folder: of the bundle, complete or absent.
        background: [3] color behind the scene; None: black.
        overwrite: replace an existing bundle, which stays if the new one cannot be written.
        options: see `BakeOptions`; None: its defaults, a compact bundle.
        target_mb: limit of all files of a compact bundle, in MB (10^6 bytes); None: the default precision.

    Returns:
        The bundle as read from the folder, with the cameras of the views.

    Raises:
        ValueError: as `train_scene`; no surfel is left, or the atlas would be too large.
        BundleError: the folder exists or cannot be written, which is tried first, or what was written cannot be read.
        RuntimeError: the format is bc7, and its encoder is not installed.
    """
    views = checked_views(views)
    check_counted(views)
    background = torch.zeros(3, dtype=torch.float32) if background is None else background.float().cpu()
    if background.shape != (3,) or not bool(torch.isfinite(background).all()):
        raise ValueError(f"background has to be a finite color [3], not {background.tolist()}")
    options = options or BakeOptions()
    options.check()
    cameras = [view.camera for view in views]
    rows = [CapturedCamera.of(f"{i:04d}", v.camera, False, correction=v.correction) for i, v in enumerate(views)]
    listed = cameras_data(rows)
    compact = Compact() if options.bundle_format == "compact" else None
    if target_mb is not None:
        if compact is None:
            raise ValueError(f"target_mb is for compact bundles, and this one's format is {options.bundle_format}")
        compact = compact.fitting(target_mb, len(listed))
    refine = RefineOptions.for_scene(scene, len(views), compact=compact)
    where = {"first": cameras[0], "extra_files": {CAMERAS: listed}, "overwrite": overwrite}
    with reserved_bundle(folder, overwrite):
        baked = bake(scene, cameras, views, background, options, refine)
        return export(baked, folder, background=background.tolist(), **where)
