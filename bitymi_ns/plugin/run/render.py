"""Rendering in `ns-render`: films and frames without the ffmpeg program, options checked before a scene is loaded.
`hooks.patch_render` replaces functions of nerfstudio's script by those of this module."""

import math
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.utils import colormaps
from torch import Tensor

from bitymi_ns.files import check_folder, check_writable, reserved, size_text, write_errors_as
from bitymi_ns.progress import rich_progress
from bitymi_ns.ranges import spread
from bitymi_ns.scene.baked import as_bytes
from ..console import INTERRUPTED, InputError, fail, say, warn
from ..data.cameras import to_camera
from .camera_path import MOST_PIXELS, read_camera_path
from .films import RATES, check_frames, film, frames
from .surfel_model import SurfelModel

TRAJECTORIES = ("RenderCameraPath", "RenderInterpolated", "SpiralRender")
"""nerfstudio's script classes that render along a path."""
OUTPUTS = ("rgb", "rgba", "accumulation", "depth", "normal", "beta", "overdraw")
WITHOUT_MAPS = {"rgb", "rgba", "accumulation"}
DEPTH_VIEWS, DEPTH_SIDE, DEPTH_SHARE = 16, 160, 0.01
"""Frames sampled for a film's depth range, their longer side in pixels, and the share of depths clipped at either
end."""
TURNS = 2  # of a spiral
FAINT = 1 / 255  # accumulation of a pixel that shows nothing
OPTION = " (--output-path)."


def leave_out_photographs(command: Any) -> bool:
    """Have `ns-render dataset` draw all outputs, and no photographs, if it names none; return True if it then needs no
    photographs."""
    if type(command).__name__ != "DatasetRender":
        return False
    if command.rendered_output_names is None:
        command.rendered_output_names = [name for name in OUTPUTS if name != "rgba"]
    return not any("gt-" in name for name in command.rendered_output_names)


def check_evaluation(command: Any) -> None:
    path, folder = command.output_path, command.render_output_path
    if path.suffix != ".json":
        fail(f"--output-path must end in .json, {path} does not.")
    with write_errors_as(path, InputError, OPTION):
        check_writable(path)
    if folder is not None:
        with write_errors_as(folder, InputError, " (--render-output-path)."):
            check_folder(folder)


def target_of(command: Any) -> Path:
    """Name the output: films without an extension get .mp4, folders nerfstudio's names."""
    path = Path(command.output_path)
    if not hasattr(command, "output_format"):
        return path / command.split
    if command.output_format == "images":
        return path.parent / path.stem
    return path if path.suffix else path.with_suffix(".mp4")


def check_options(command: Any) -> None:
    as_film = getattr(command, "output_format", "images") == "video"
    for name, low, high in (
        ("downscale_factor", 1 / MOST_PIXELS, MOST_PIXELS),
        ("jpeg_quality", 1, 100),
        ("frame_rate", *RATES),
        ("interpolation_steps", 1, math.inf),
        ("seconds", 1 / RATES[1], math.inf),
        ("radius", 0, math.inf),
    ):
        value = getattr(command, name, None)
        if value is not None and not low <= value <= high:
            between = f"from {low:g} to {high:,}" if high < math.inf else f"at least {low:g}"
            fail(f"--{name.replace('_', '-')} must be {between}, not {value}.")
    if command.render_nearest_camera or command.check_occlusions:
        fail("--render-nearest-camera and --check-occlusions need rays: leave them out.")
    _check_outputs(command, not as_film and command.image_format == "png")
    dataset = not hasattr(command, "output_format")
    if not dataset and not Path(command.output_path).name:
        fail(f"--output-path {str(command.output_path)!r} has no name of a {'film' if as_film else 'folder'}.")
    path = target_of(command)
    if as_film and path.suffix.lower() != ".mp4":
        fail(f"films are MP4: --output-path must end in .mp4, {path} does not. Frames: --output-format images.")
    with write_errors_as(path, InputError, OPTION):
        if dataset:
            check_folder(path)
        else:
            with reserved(path, None if as_film else partial(check_frames, path)):
                pass
    planes = command.depth_near_plane, command.depth_far_plane
    if None not in planes:
        _check_planes(*planes)
    if hasattr(command, "camera_path_filename"):
        path = read_camera_path(Path(command.camera_path_filename))
        if as_film and not RATES[0] <= path.rate <= RATES[1]:
            fail(f"{command.camera_path_filename} makes {path.rate:g} frames per second: correct its seconds.")
        command.camera_path_filename = path.written()
    elif getattr(command, "seconds", None) is not None and int(command.frame_rate * command.seconds) < 1:
        fail(f"{command.seconds} seconds have no frame at --frame-rate {command.frame_rate}: give more.")


def _check_planes(near: float, far: float) -> None:
    if not near < far:
        fail(f"--depth-near-plane must be less than --depth-far-plane, and these are {near:.3g} and {far:.3g}.")


def _check_outputs(command: Any, transparency: bool) -> None:
    names = command.rendered_output_names
    if names is None:  # all of a dataset
        return
    dataset = not hasattr(command, "output_format")
    more = "; with raw- before it for raw values; gt-rgb" if dataset else ""
    if not names:
        fail("--rendered-output-names names nothing: give rgb, depth or another output.")
    for name in names:
        output = name.removeprefix("raw-") if dataset else name
        if output not in OUTPUTS and not (dataset and output.startswith("gt-")):
            fail(f"there is no output {name}: --rendered-output-names may be {', '.join(OUTPUTS)}{more}.")
    if "rgba" in names and not transparency:
        fail("rgba has transparency: add --image-format png (and frames, not a film).")
    if "rgba" in names and len(names) > 1 and not dataset:
        fail("rgba cannot stand beside other outputs: name it alone in --rendered-output-names.")


def interpolated(stock: Any, cameras: Cameras, **options: Any) -> Cameras:
    """Make nerfstudio's path between cameras, in the first one's size, with principal points interpolated."""
    if len(cameras) < 2:
        fail(f"a path needs two cameras, not {len(cameras)}: --pose-source train has more, or use `ns-render spiral`.")
    path = stock(cameras=cameras, **options)
    points = Cameras(cameras.camera_to_worlds, fx=cameras.cx, fy=cameras.cy, cx=cameras.cx, cy=cameras.cy)
    along = stock(cameras=points, **options)  # principal points in the fields of focal lengths
    path.cx, path.cy = along.fx, along.fy
    for name in ("width", "height"):
        setattr(path, name, torch.full_like(getattr(path, name), int(getattr(cameras, name)[0])))
    return path


def with_principal_points(path: Cameras, found: dict[str, Any]) -> Cameras:
    """Give a path's cameras their `principal_point`, shares of width and height, which nerfstudio ignores."""
    points = torch.tensor([frame["principal_point"] for frame in found["camera_path"]]).float()
    path.cx = found["render_width"] * points[:, :1]
    path.cy = found["render_height"] * points[:, 1:]
    return path


@torch.no_grad()
def spiral(model: SurfelModel, start: Cameras, steps: int, radius: float) -> Cameras:
    """Make cameras on a spiral around `start`, `radius` scene units along its axes, all facing the point at the median
    depth of its image's centre; nerfstudio's spiral rolls."""
    camera = to_camera(start, model.device).within(DEPTH_SIDE)
    outputs = model.outputs_of(camera, maps=True)
    y, x = camera.height // 3, camera.width // 3
    middle = tuple(outputs[name][y : camera.height - y, x : camera.width - x] for name in ("depth", "accumulation"))
    known = middle[0][middle[1] > 0.5]
    target = torch.tensor([0.0, 0.0, -float(known.median()) if len(known) else -1e6], dtype=torch.float64)
    angle = torch.arange(steps, dtype=torch.float64) * (2 * math.pi * TURNS / steps)
    center = radius * torch.stack([angle.cos(), -angle.sin(), -(angle / TURNS).sin()], 1)
    back = torch.nn.functional.normalize(center - target, dim=1)
    right = torch.nn.functional.normalize(torch.linalg.cross(torch.tensor([[0.0, 1.0, 0.0]]).double(), back), dim=1)
    local = torch.stack([right, torch.linalg.cross(back, right), back, center], 2)  # [steps, 3, 4]
    pose = start.camera_to_worlds[0].cpu().double()
    poses = pose[:, :3] @ local
    poses[:, :, 3] += pose[:, 3]
    scalars = {name: getattr(start, name)[0].item() for name in ("fx", "fy", "cx", "cy", "width", "height")}
    return Cameras(poses.float(), **scalars)


@torch.no_grad()
def write_trajectory(model: SurfelModel, cameras: Cameras, command: Any, seconds: float) -> None:
    """Render a path, or a spiral, as a film or frames. Raises InputError: it cannot be written."""
    if hasattr(command, "radius"):
        cameras = spiral(model, cameras, int(command.frame_rate * command.seconds), command.radius)
    fps = len(cameras) / seconds if hasattr(command, "camera_path_filename") else float(command.frame_rate)
    target, names = target_of(command), command.rendered_output_names
    images, started = command.output_format == "images", time.monotonic()
    cameras.rescale_output_resolution(1.0 / command.downscale_factor)
    views = [to_camera(cameras[i : i + 1], model.device) for i in range(len(cameras))]
    width, height = views[0].width * len(names), views[0].height
    if not images and min(width, height) < 2:
        fail(f"a film of {width} x {height} pixels cannot be written: give a smaller --downscale-factor.")
    if not images and (width % 2 or height % 2):
        say(f"H.264 needs even sizes: of {width} x {height} pixels the last row or column is left out.")
        width, height = width // 2 * 2, height // 2 * 2
    planes = _depth_planes(model, views, command) if "depth" in names else {}
    empty = 0
    try:
        with write_errors_as(target, InputError, OPTION):
            output = frames(target, command.image_format, command.jpeg_quality) if images else film(target, fps)
            with output as add, rich_progress() as progress:
                for i, camera in enumerate(views):
                    picture, shows = _picture(model, camera, names, planes, command.colormap_options)
                    add(picture)
                    empty += not shows
                    progress("rendering", i + 1, len(views))
    except KeyboardInterrupt:
        warn(f"The rendering was interrupted; nothing was written to {target}.")
        raise SystemExit(INTERRUPTED) from None
    what = f"{len(views)} frames of {width} x {height}"
    if not images:
        what += f", {fps:.3g} per second, {size_text(target.stat().st_size)}"
    say(f"{target}: {what}; {time.monotonic() - started:.1f} s")
    if empty:
        warn(f"{empty} of {len(views)} frames show nothing: is the path of another scene?")


def _picture(
    model: SurfelModel, camera: Any, names: Sequence[str], planes: dict[str, float], options: Any
) -> tuple[np.ndarray, bool]:
    """Draw outputs side by side in nerfstudio's colours [H, W, 3 or 4] uint8; return whether the scene shows, too."""
    outputs = model.outputs_of(camera, maps=not WITHOUT_MAPS.issuperset(names))
    outputs["rgba"] = model.get_rgba_image(outputs)
    parts = []
    for name in names:
        image: Tensor = outputs[name]
        if name == "depth":
            image = colormaps.apply_depth_colormap(image, outputs["accumulation"], colormap_options=options, **planes)
        elif name != "rgba":
            image = colormaps.apply_colormap(image, options)
        parts.append(image)
    return as_bytes(torch.cat(parts, dim=1)).numpy(), bool((outputs["accumulation"] > FAINT).any())


def _depth_planes(model: SurfelModel, views: Sequence[Any], command: Any) -> dict[str, float]:
    """Return the depth range of the colours: from the options, else common to all frames."""
    seen = []
    for i in spread(len(views), DEPTH_VIEWS):
        outputs = model.outputs_of(views[i].within(DEPTH_SIDE), maps=True)
        seen.append(outputs["depth"][outputs["accumulation"] > 0.5].cpu())
    depths = torch.cat(seen).numpy()
    near, far = np.quantile(depths, (DEPTH_SHARE, 1 - DEPTH_SHARE)).tolist() if len(depths) else (0.0, 1.0)
    near = near if command.depth_near_plane is None else command.depth_near_plane
    far = far if command.depth_far_plane is None else command.depth_far_plane
    if (command.depth_near_plane, command.depth_far_plane) != (None, None):
        _check_planes(near, far)
    say(f"Depth colours span {near:.3g} to {far:.3g} units of the scene (--depth-near-plane, --depth-far-plane).")
    return {"near_plane": near, "far_plane": far}
