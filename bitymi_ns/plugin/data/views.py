"""Views of a capture for training: photographs with cameras and poses become pinhole pictures in nerfstudio's frame,
those of wide cameras several."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import torch
from nerfstudio.cameras.camera_utils import auto_orient_and_center_poses
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from nerfstudio.data.scene_box import SceneBox

from bitymi_ns.capture.camera import SPHERICAL_MODEL, ColmapCamera
from bitymi_ns.plugin.console import fail, listed, say
from bitymi_ns.plugin.data.depth_files import MAPS, MapFiles
from bitymi_ns.plugin.data.images import image_size, in_threads
from bitymi_ns.plugin.data.lens import Lens, Pinhole, colmap_distortion, lenses_of
from bitymi_ns.plugin.data.point_files import Points
from bitymi_ns.plugin.data.pose_checks import check_spread, far_from_origin

Pose = npt.NDArray[np.float64]
OPENCV_AXES = np.diag([1.0, -1.0, -1.0, 1.0])
"""[4, 4] between camera frames with OpenCV axes and with nerfstudio's (OpenGL)."""
USUAL_SPREAD, MAX_SPREAD = 2.5, 25.0
"""Median distance of cameras from their middle, in half sides of the scene box: of NeRF-Synthetic, and from which on a
capture is taken to be in another unit."""
NO_PHOTOS = "without photographs"  # metadata key of views whose photographs are gone
LONGEST_SIDE = 1600  # default longest side of a training photograph, pixels; as in papers on such captures


@dataclass(frozen=True)
class Photograph:
    """A photograph with its camera."""

    file: Path  # image file
    camera: ColmapCamera  # in pixels of the photograph before any downscaling
    pose: Pose  # [4, 4] float64, camera to world in nerfstudio's axes (camera: x right, y up, z backward)
    label: str  # names the camera in messages
    mask: Path | None = None  # mask file; None = none
    downscaled: bool = False  # `file` is a copy that is downscaled already
    frame: int | None = None  # number that photographs share which a rig took together; None = it stands alone
    maps: MapFiles = MapFiles()  # depth and normals


Orientation = Literal["pca", "up", "vertical", "none"]


@dataclass
class FrameOptions:
    """Orientation, centering and scaling of a capture, as in nerfstudio's parsers."""

    scale_factor: float = 1.0
    """Factor on the positions of the cameras."""
    orientation_method: Orientation = "up"
    """Orientation of the capture: up = the cameras' mean up is z."""
    center_method: Literal["poses", "focus", "none"] = "poses"
    """Origin: the middle of the cameras, or the point that they look at."""
    auto_scale_poses: bool = True
    """Scale the capture so that the cameras fit into a box from -1 to 1."""
    scene_scale: float = 1.0
    """Half the side of the box of random points."""


def fit_scale(frame: FrameOptions, photographs: Sequence[Photograph], source: str) -> FrameOptions:
    """Reduce the scale of a capture whose cameras lie far outside of the scene box: in millimetres they would, and
    random points would all fall on one spot of the pictures. `frame` is the format's default, without
    auto_scale_poses."""
    centers = np.stack([photograph.pose[:3, 3] for photograph in photographs])
    spread = float(np.median(np.linalg.norm(centers - centers.mean(0), axis=1)))
    ratio = spread * frame.scale_factor / frame.scene_scale
    if ratio <= MAX_SPREAD:
        return frame
    scale = frame.scale_factor * USUAL_SPREAD / ratio
    say(
        f"The cameras of {source} lie {spread:,.4g} units from their middle, where those of this format usually lie "
        f"{USUAL_SPREAD * frame.scene_scale / frame.scale_factor:.2g}: the capture is scaled by {scale:.3g}. Bundles "
        "state that."
    )
    return replace(frame, scale_factor=scale)


class Views(DataparserOutputs):
    """DataparserOutputs with a float64 dataparser_transform: a capture may lie millions of units from its origin."""

    def transform_poses_to_original_space(self, poses: torch.Tensor, *args: Any, **kwargs: Any) -> torch.Tensor:
        """Call nerfstudio's method in float64."""
        return super().transform_poses_to_original_space(poses.double(), *args, **kwargs)


def make_views(
    photographs: Sequence[Photograph],
    frame: FrameOptions,
    points: Points | None,
    source: str,
    downscale: int = 1,
    need_photos: bool = True,
    applied: Pose | None = None,
    applied_scale: float = 1.0,
    alpha_color: torch.Tensor | None = None,
) -> Views:
    """Build the views of a capture, in the order of the photographs. metadata has for each view its `Lens` ("lenses"),
    photograph ("files"), the number of the photograph ("photographs"), which views of one share, and that of the first
    photograph of the rig's frame ("frames").

    Args:
        photographs: at least two.
        points: in the frame of the poses; None = none.
        downscale: use photographs that are smaller by this factor.
        need_photos: open downscaled copies for their size; else they may be missing.
        applied, applied_scale: [4, 4] and scale that were applied to the capture before `photographs` state it.
        alpha_color: behind transparent pixels.

    Raises:
        InputError: a camera or a photograph cannot be used.
    """
    if len(photographs) == 1:
        fail(f"{source} has one image only. A scene cannot be learned from one view: add photographs.")
    parts = make_lenses(photographs, downscale, need_photos)
    poses = np.stack([photograph.pose for photograph in photographs])
    if frame.auto_scale_poses:
        check_spread(poses[:, :3, 3], source)
    transform, scale = training_frame(poses, frame, source)
    moved = transform @ poses
    moved[:, :3, 3] *= scale
    lenses, of, moved = _split(parts, moved)
    files = [photographs[i].file for i in of]
    first: dict[Any, int] = {}
    frames = [
        first.setdefault(i if each.frame is None else ("frame", each.frame), i) for i, each in enumerate(photographs)
    ]
    metadata: dict[str, Any] = {"lenses": lenses, "files": files, "photographs": of, "frames": [frames[i] for i in of]}
    maps = [MapFiles() if lens.face else photographs[i].maps for i, lens in zip(of, lenses, strict=True)]
    if any(each != MapFiles() for each in maps):
        metadata[MAPS] = maps
    wide = [photographs[i].file for i, lens in zip(of, lenses, strict=True) if lens.face and photographs[i].maps.depth]
    if wide:
        say(f"Depth of photographs that become faces of a cube is not used: {listed(list(dict.fromkeys(wide)))}.")
    if points is not None and len(points.xyz):
        xyz = (points.xyz @ transform[:, :3].T + transform[:, 3]) * scale * applied_scale
        metadata["points3D_xyz"] = torch.from_numpy(xyz.astype(np.float32))
        metadata["points3D_rgb"] = torch.from_numpy(points.rgb)
    masks = [photographs[i].mask for i in of]
    side = frame.scene_scale
    return Views(
        image_filenames=view_names(files, lenses),
        cameras=pinhole_cameras([each.pinhole for each in lenses], torch.from_numpy(moved.astype(np.float32))),
        alpha_color=alpha_color,
        scene_box=SceneBox(aabb=torch.tensor([[-side] * 3, [side] * 3], dtype=torch.float32)),
        mask_filenames=masks if any(masks) else None,  # type: ignore[arg-type]  # some may have none
        dataparser_scale=scale * applied_scale,
        dataparser_transform=torch.from_numpy(transform if applied is None else transform @ applied),
        metadata=metadata,
    )


def _split(parts: Sequence[Sequence[Lens]], poses: Pose) -> tuple[list[Lens], list[int], Pose]:
    """Split photographs into the views of their lenses (`parts`, of each photograph), with poses [N, 3 or 4, 4] camera
    to world in nerfstudio's axes. Returns lens, number of the photograph and pose of each view."""
    lenses = [lens for some in parts for lens in some]
    of = [i for i, some in enumerate(parts) for _ in some]
    turns = np.stack([OPENCV_AXES @ lens.turn @ OPENCV_AXES for lens in lenses])
    return lenses, of, poses[of] @ turns


def view_names(files: Sequence[Path], lenses: Sequence[Lens]) -> list[Path]:
    """Name views: by their photograph, and the face of the cube where it is split."""
    return [
        file.with_name(f"{file.stem}-{lens.face}{file.suffix}") if lens.face else file
        for file, lens in zip(files, lenses, strict=True)
    ]


def photograph_files(outputs: DataparserOutputs) -> list[Path]:
    """Return the photograph of each view."""
    return outputs.metadata.get("files", outputs.image_filenames)


def training_frame(poses: Pose, frame: FrameOptions, source: str) -> tuple[Pose, float]:
    """Compute the transform [3, 4] that orients and centers poses [N, 4, 4] camera to world, and the scale that follows
    it.

    Both are nerfstudio's, but the capture is centered in float64 first: UTM or ECEF positions have seven digits before
    the point, which is all that float32 has.
    """
    middle = poses[:, :3, 3].mean(0)
    local = poses.copy()
    local[:, :3, 3] -= middle
    # the transform alone: for `pca`, nerfstudio 1.1.5 turns cameras that come out upside down, but two of them only
    _, oriented = auto_orient_and_center_poses(
        torch.from_numpy(local.astype(np.float32)), frame.orientation_method, frame.center_method
    )
    transform = oriented.double().numpy()[:3].copy()
    u, _, v = np.linalg.svd(transform[:, :3])  # far from the origin, the rounding of a rotation is a displacement
    transform[:, :3] = u @ v
    far = frame.center_method == "none" and far_from_origin(poses[:, :3, 3])
    if far:
        say(
            f"The cameras of {source} lie {np.linalg.norm(middle):,.0f} units from the origin, where float32 would "
            "blur the scene: their middle becomes the origin. Bundles state where that is."
        )
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

    return Cameras(
        **{name: column(name) for name in ("fx", "fy", "cx", "cy")},
        **{name: column(name, torch.int32) for name in ("width", "height")},
        camera_to_worlds=poses[:, :3, :4],
        camera_type=CameraType.PERSPECTIVE,
    )


def make_lenses(photographs: Sequence[Photograph], downscale: int = 1, need_photos: bool = True) -> list[list[Lens]]:
    """Make the lenses of each photograph, equal ones once; see `make_views`."""
    sizes = in_threads(lambda each: image_size(each.file) if each.downscaled and need_photos else None, photographs)
    made: dict[tuple[Any, ...], list[Lens]] = {}
    lenses, messages = [], []
    for photograph, size in zip(photographs, sizes, strict=True):
        camera = photograph.camera
        full = camera.size
        small = full if downscale == 1 else (max(1, round(full[0] / downscale)), max(1, round(full[1] / downscale)))
        if size is not None and max(abs(size[0] - small[0]), abs(size[1] - small[1])) > 1:
            fail(
                f"the image {photograph.file} has {size[0]} x {size[1]} pixels, but its camera is for {full[0]} x "
                f"{full[1]}, of which 1/{downscale} is {small[0]} x {small[1]}. Make the folder "
                f"{photograph.file.parent} again, or leave --downscale-factor out."
            )
        used = size or small
        key = (camera, used, photograph.downscaled)
        if key not in made:
            stored = used if photograph.downscaled else full
            made[key], lost = lenses_of(camera.rescaled(*used), stored, photograph.label)
            messages += lost
        lenses.append(made[key])
    for message in messages[:3]:
        say(f"{message[0].upper()}{message[1:]}")
    if len(messages) > 3:
        say(f"So are those of {len(messages) - 3} more cameras.")
    return lenses


def with_lenses(outputs: DataparserOutputs) -> DataparserOutputs:
    """Give the outputs of any nerfstudio parser lenses, and the lenses' pinhole cameras in place of distorted ones."""
    if "lenses" in outputs.metadata or NO_PHOTOS in outputs.metadata:
        return outputs
    cameras = outputs.cameras
    if cameras.camera_to_worlds.ndim != 3:  # nerfstudio's Cameras lose the dimension of a single view
        fail(
            "nerfstudio's reader of this format fails on a split with a single photograph. Hold out more of them, for "
            "example with `--eval-mode interval --eval-interval 4` after the name of the reader."
        )
    distortion = cameras.distortion_params
    photographs = []
    for i, file in enumerate(outputs.image_filenames):
        values = [0.0] * 6 if distortion is None else distortion[i].tolist()
        model, coefficients = colmap_distortion(CameraType(int(cameras.camera_type[i])), values, f"of {file}")
        pinhole = [float(getattr(cameras, name)[i]) for name in ("fx", "fy", "cx", "cy")]
        size = (int(cameras.width[i]), int(cameras.height[i]))
        camera = ColmapCamera(model, *size, size if model == SPHERICAL_MODEL else (*pinhole, *coefficients))
        photographs.append(Photograph(file, camera, np.eye(4), f"the camera of {file}"))
    lenses, of, poses = _split(make_lenses(photographs), cameras.camera_to_worlds.double().numpy())
    outputs = select_views(outputs, of)
    files = outputs.image_filenames
    return dataclasses.replace(
        outputs,
        image_filenames=view_names(files, lenses),
        cameras=pinhole_cameras([lens.pinhole for lens in lenses], torch.from_numpy(poses).float()),
        metadata={**outputs.metadata, "lenses": lenses, "files": files, "photographs": of},
    )


def limit_size(outputs: DataparserOutputs, longest: int, verbose: bool) -> DataparserOutputs:
    """Downscale views with more than `longest` pixels along a side (0 = no limit), by their lenses.

    Raises:
        InputError: `longest` is negative.
    """
    if longest < 0:
        fail(
            f"--pipeline.datamanager.longest-side is {longest}: give a number of pixels, or 0 to use photographs as "
            "they are."
        )
    lenses: list[Lens] = outputs.metadata.get("lenses", [])
    sizes = [(lens.pinhole.width, lens.pinhole.height) for lens in lenses]
    large = [size for size in sizes if longest and max(size) > longest]
    if not large:
        return outputs
    sized = dict(zip(lenses, sizes, strict=True))
    small = {lens: lens.downscaled(min(1.0, longest / max(size))) for lens, size in sized.items()}
    lenses = [small[lens] for lens in lenses]
    if verbose:
        width, height = max(large, key=max)
        say(
            f"{len(large)} of {len(sizes)} training photographs have more than {longest} pixels along a side (up to "
            f"{width} x {height}): they are reduced to that as they are read. --pipeline.datamanager.longest-side 0 "
            "uses them as they are."
        )
    return dataclasses.replace(
        outputs,
        cameras=pinhole_cameras([lens.pinhole for lens in lenses], outputs.cameras.camera_to_worlds),
        metadata={**outputs.metadata, "lenses": lenses},
    )


def select_views(outputs: DataparserOutputs, indices: Sequence[int]) -> DataparserOutputs:
    """Return a subset of the views, with all that belongs to them."""
    count = len(outputs.image_filenames)
    masks = outputs.mask_filenames
    metadata = {
        key: [value[i] for i in indices] if isinstance(value, list) and len(value) == count else value
        for key, value in outputs.metadata.items()
    }
    return dataclasses.replace(
        outputs,
        image_filenames=[outputs.image_filenames[i] for i in indices],
        mask_filenames=None if masks is None else [masks[i] for i in indices],
        cameras=outputs.cameras[torch.tensor(indices, dtype=torch.long)],
        metadata=metadata,
    )
