"""Make training views of a capture: pinhole pictures in nerfstudio's frame, several of a wide camera's photograph."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from nerfstudio.cameras.camera_utils import auto_orient_and_center_poses
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from nerfstudio.data.scene_box import SceneBox

from bitymi_ns.capture.lens import Lens, Pinhole, colmap_distortion, make_lenses
from bitymi_ns.capture.pose_checks import check_spread, far_from_origin
from bitymi_ns.capture.read import Capture
from bitymi_ns.capture.types import OPENCV_AXES, SPHERICAL_MODEL, ColmapCamera, FrameOptions, MapFiles, Photograph, Pose
from ..console import fail, listed, say
from .facts import KEY, CaptureFacts

DATA = "BITYMI_DATA"
"""Environment variable with a capture's location, for which most commands have no option."""
MOVED = f"If it was moved, say where it is now: `{DATA}=/where/it/is` before the command."
LONGEST_SIDE = 1600  # of training photographs, pixels; as in papers on such captures


class Views(DataparserOutputs):
    """DataparserOutputs with float64 transforms: captures may lie millions of units from the origin."""

    def transform_poses_to_original_space(self, poses: torch.Tensor, *args: Any, **kwargs: Any) -> torch.Tensor:
        return super().transform_poses_to_original_space(poses.double(), *args, **kwargs)


def make_views(
    capture: Capture, need_photos: bool = True, alpha_color: torch.Tensor | None = None
) -> dict[str, DataparserOutputs]:
    """Build a capture's views by part (train, val, test). `need_photos`: open downscaled copies for their size; else
    they may be missing. `alpha_color`: [3] behind transparent photographs. Raises CaptureError: a camera or a
    photograph cannot be used."""
    photographs = capture.photographs
    frame = capture.frame
    points = capture.points
    source = capture.source
    if len(photographs) == 1:
        fail(f"{source} has one image only: add photographs.")
    parts = make_lenses(photographs, capture.downscale, need_photos)
    poses = np.stack([photograph.pose for photograph in photographs])
    if frame.auto_scale_poses:
        check_spread(poses[:, :3, 3], source)
    transform, scale = training_frame(poses, frame, source)
    moved = transform @ poses
    moved[:, :3, 3] *= scale
    sources, names, cameras, facts = _split(parts, moved, [photograph.file for photograph in photographs])
    lenses = facts.lenses
    maps = [MapFiles() if lens.face else photographs[i].maps for i, lens in zip(sources, lenses, strict=True)]
    wide = {photographs[i].file for i, lens in zip(sources, lenses, strict=True)
            if lens.face and photographs[i].maps.depth}  # fmt: skip
    if wide:
        say(f"Depth of photographs that become faces of a cube is not used: {listed(sorted(wide))}.")
    facts = dataclasses.replace(
        facts,
        maps=maps if set(maps) != {MapFiles()} else (),
        declares_box=capture.declares_box,
        poses_report=capture.report,
        poses_found=capture.model,
    )
    metadata: dict[str, Any] = {KEY: facts}
    if points is not None and len(points.xyz):
        xyz = (points.xyz @ transform[:, :3].T + transform[:, 3]) * scale * capture.applied_scale
        metadata["points3D_xyz"] = torch.from_numpy(xyz.astype(np.float32))
        metadata["points3D_rgb"] = torch.from_numpy(points.rgb)
    masks: list[Any] = [photographs[i].mask for i in sources]
    views = Views(
        image_filenames=names,
        cameras=cameras,
        alpha_color=alpha_color,
        metadata=metadata,
        scene_box=SceneBox(aabb=torch.tensor([[-1.0] * 3, [1.0] * 3]) * frame.scene_scale),
        mask_filenames=masks if any(masks) else None,
        dataparser_scale=scale * capture.applied_scale,
        dataparser_transform=torch.from_numpy(transform if capture.applied is None else transform @ capture.applied),
    )
    chosen = {name: set(part) for name, part in capture.parts.items()}
    return {name: select_views(views, [i for i, n in enumerate(sources) if n in part]) for name, part in chosen.items()}


def _split(
    parts: Sequence[Sequence[Lens]], poses: Pose, photographs: Sequence[Path]
) -> tuple[list[int], list[Path], Cameras, CaptureFacts]:
    """Split photographs into views of their lenses (`parts`); poses [N, 3 or 4, 4] are camera to world in nerfstudio's
    axes. Return the number of each view's photograph, and the views' names, cameras and facts."""
    lenses = [lens for own in parts for lens in own]
    sources = [i for i, own in enumerate(parts) for _ in own]
    turns = np.stack([OPENCV_AXES @ lens.turn @ OPENCV_AXES for lens in lenses])
    files = [photographs[i] for i in sources]
    cameras = pinhole_cameras([lens.pinhole for lens in lenses], torch.from_numpy(poses[sources] @ turns).float())
    names = [lens.name(file) for file, lens in zip(files, lenses, strict=True)]
    return sources, names, cameras, CaptureFacts(lenses, files)


def training_frame(poses: Pose, frame: FrameOptions, source: str) -> tuple[Pose, float]:
    """Compute the transform [3, 4] that orients and centers poses [N, 4, 4] camera to world, and the scale after it.
    Large positions (UTM, ECEF) are centered in float64 before nerfstudio's functions."""
    middle = poses[:, :3, 3].mean(0)
    local = poses.copy()
    local[:, :3, 3] -= middle
    # the returned poses are unused: for `pca`, nerfstudio 1.1.5 turns only two cameras of an upside-down scene
    _, oriented = auto_orient_and_center_poses(
        torch.from_numpy(local.astype(np.float32)), frame.orientation_method, frame.center_method
    )
    transform = oriented.double().numpy()[:3].copy()
    u, _, v = np.linalg.svd(transform[:, :3])  # rounding of a rotation displaces what is far from the origin
    transform[:, :3] = u @ v
    far = frame.center_method == "none" and far_from_origin(poses[:, :3, 3])
    if far:
        away = f"{np.linalg.norm(middle):,.0f} units from the origin"
        say(f"The cameras of {source} lie {away}, too far for float32: their middle becomes the origin.")
    if far or frame.center_method != "none":
        transform[:, 3] -= transform[:, :3] @ middle
    scale = frame.scale_factor
    if frame.auto_scale_poses:
        scale /= float(np.abs((transform @ poses)[:, :3, 3]).max())
    return transform, scale


def pinhole_cameras(pinholes: Sequence[Pinhole], poses: torch.Tensor) -> Cameras:
    """Make nerfstudio's cameras of pinholes and poses [N, 3 or 4, 4] camera to world."""

    def column(name: str, dtype: torch.dtype = torch.float32) -> torch.Tensor:
        return torch.tensor([getattr(pinhole, name) for pinhole in pinholes], dtype=dtype)

    columns: dict[str, Any] = {name: column(name) for name in ("fx", "fy", "cx", "cy")}
    columns |= {name: column(name, torch.int32) for name in ("width", "height")}
    return Cameras(**columns, camera_to_worlds=poses[:, :3, :4], camera_type=CameraType.PERSPECTIVE)


def with_lenses(outputs: DataparserOutputs) -> DataparserOutputs:
    """Add lenses to the outputs of nerfstudio's parsers, with the lenses' pinholes as cameras."""
    if KEY in outputs.metadata:
        return outputs
    cameras = outputs.cameras
    if cameras.camera_to_worlds.ndim != 3:  # Cameras lose the dimension of a single view
        fail(
            "nerfstudio's reader of this format fails on a single held-out photograph. Hold out more: "
            "`--eval-mode interval --eval-interval 4` after the reader's name."
        )
    distortion = cameras.distortion_params
    photographs = []
    for i, file in enumerate(outputs.image_filenames):
        values = [0.0] * 6 if distortion is None else distortion[i].tolist()
        model, coefficients = colmap_distortion(CameraType(int(cameras.camera_type[i])).name, values, f"of {file}")
        pinhole = [float(getattr(cameras, name)[i]) for name in ("fx", "fy", "cx", "cy")]
        size = (int(cameras.width[i]), int(cameras.height[i]))
        camera = ColmapCamera(model, *size, size if model == SPHERICAL_MODEL else (*pinhole, *coefficients))
        photographs.append(Photograph(file, camera, np.eye(4), f"the camera of {file}"))
    poses = cameras.camera_to_worlds.double().numpy()
    sources, names, cameras, facts = _split(make_lenses(photographs), poses, outputs.image_filenames)
    metadata = {**outputs.metadata, KEY: facts}
    return dataclasses.replace(
        select_views(outputs, sources), image_filenames=names, cameras=cameras, metadata=metadata
    )


def limit_size(outputs: DataparserOutputs, longest: int, verbose: bool) -> DataparserOutputs:
    """Downscale views of more than `longest` pixels along a side; 0 = no limit."""
    if longest < 0:
        fail(f"--pipeline.datamanager.longest-side is {longest}: give a number of pixels, or 0 for no limit.")
    facts = CaptureFacts.of(outputs.metadata)
    lenses = facts.lenses
    large = [lens.pinhole[4:] for lens in lenses if longest and max(lens.pinhole[4:]) > longest]
    if not large:
        return outputs
    small = {lens: lens.downscaled(min(1.0, longest / max(lens.pinhole[4:]))) for lens in set(lenses)}
    lenses = [small[lens] for lens in lenses]
    if verbose:
        width, height = max(large, key=max)
        which = f"{len(large)} of {len(lenses)} training photographs, up to {width} x {height}"
        say(f"{which}, are reduced to {longest} pixels (--pipeline.datamanager.longest-side 0: as they are).")
    cameras = pinhole_cameras([lens.pinhole for lens in lenses], outputs.cameras.camera_to_worlds)
    metadata = {**outputs.metadata, KEY: dataclasses.replace(facts, lenses=lenses)}
    return dataclasses.replace(outputs, cameras=cameras, metadata=metadata)


def select_views(outputs: DataparserOutputs, indices: Sequence[int]) -> DataparserOutputs:
    masks = outputs.mask_filenames
    return dataclasses.replace(
        outputs,
        image_filenames=[outputs.image_filenames[i] for i in indices],
        mask_filenames=None if masks is None else [masks[i] for i in indices],
        cameras=outputs.cameras[torch.tensor(indices, dtype=torch.long)],
        metadata={**outputs.metadata, KEY: CaptureFacts.of(outputs.metadata).select(indices)},
    )
