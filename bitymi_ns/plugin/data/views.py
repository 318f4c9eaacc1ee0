"""The views of a capture as training has them: photographs with cameras and poses, whichever files state these, become
pinhole pictures in nerfstudio's frame."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import torch
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from nerfstudio.data.scene_box import SceneBox

from bitymi_ns.plugin.console import fail, say
from bitymi_ns.plugin.data.colmap_model import ModelCamera
from bitymi_ns.plugin.data.images import THREADS, of_header
from bitymi_ns.plugin.data.lens import Lens, Pinhole, lens, rescaled
from bitymi_ns.plugin.data.ply import Points
from bitymi_ns.plugin.data.poses import check_spread, is_far_off, oriented

OPENCV_AXES = np.diag([1.0, -1.0, -1.0, 1.0])
"""[4, 4] from a camera with OpenCV's axes to one with nerfstudio's, which are OpenGL's, and back."""
USUAL_RATIO, LARGEST_RATIO = 2.5, 25.0
"""Distance of cameras from their middle, in half sides of the scene's box: of NeRF-Synthetic, and from which on a
capture is in another unit."""
ALONE = "without photographs"
"""Entry of the metadata of views whose photographs are gone."""


@dataclass(frozen=True)
class Photograph:
    """A photograph with its camera.

    Attributes:
        file: that is read.
        camera: in pixels of the photograph before any reduction.
        pose: [4, 4] float64, camera to world in nerfstudio's axes (camera: x right, y up, z backward).
        whose: the camera, for messages.
        mask: its file; None = there is none.
        smaller: the file is that of a copy that is reduced already.
    """

    file: Path
    camera: ModelCamera
    pose: npt.NDArray[np.float64]
    whose: str
    mask: Path | None = None
    smaller: bool = False


@dataclass(frozen=True)
class Place:
    """How a capture's frame becomes that of training; as in nerfstudio's parsers."""

    scale_factor: float = 1.0
    orientation_method: Literal["pca", "up", "vertical", "none"] = "up"
    center_method: Literal["poses", "focus", "none"] = "poses"
    auto_scale_poses: bool = True
    scene_scale: float = 1.0


def in_proportion(place: Place, photographs: Sequence[Photograph], where: str) -> Place:
    """The place for a capture that is not scaled by its cameras, with a scale at which these do not lie far outside of
    the box of the scene: in millimetres they would, and random points would all be in a spot of the pictures.

    Args:
        place: the usual one of the format.
        photographs: of the capture.
        where: their poses are from, for the message.
    """
    centers = np.stack([photograph.pose[:3, 3] for photograph in photographs])
    spread = float(np.median(np.linalg.norm(centers - centers.mean(0), axis=1)))
    ratio = spread * place.scale_factor / place.scene_scale
    if ratio <= LARGEST_RATIO:
        return place
    scale = place.scale_factor * USUAL_RATIO / ratio
    say(
        f"The cameras of {where} lie {spread:,.4g} units from their middle, where those of this format usually lie "
        f"{USUAL_RATIO * place.scene_scale / place.scale_factor:.2g}: the capture is scaled by {scale:.3g}. Bundles "
        "state that."
    )
    return replace(place, scale_factor=scale)


class Views(DataparserOutputs):
    """What a parser of nerfstudio gives, of which `dataparser_transform` is in float64: a capture may lie millions of
    units from its origin."""

    def transform_poses_to_original_space(self, poses: torch.Tensor, *args: Any, **kwargs: Any) -> torch.Tensor:
        """nerfstudio's own, in float64."""
        return super().transform_poses_to_original_space(poses.double(), *args, **kwargs)


def views_of_capture(
    photographs: Sequence[Photograph],
    place: Place,
    points: Points | None,
    where: str,
    reduction: int = 1,
    look: bool = True,
    announce: bool = True,
    before: npt.NDArray[np.float64] | None = None,
    before_scale: float = 1.0,
    alpha_color: torch.Tensor | None = None,
) -> Views:
    """All views of a capture, in the order of the photographs; the lenses are in the metadata.

    Args:
        photographs: at least two.
        place: what is done with their frame.
        points: in the frame of the poses; None = there are none.
        where: the poses are from, for messages.
        reduction: use photographs that are so many times smaller.
        look: look into photographs, which decide the size of reduced ones.
        announce: say what is lost.
        before: [4, 4] that was applied to the capture already; the transform of the result is from before that.
        before_scale: the same for a scale.
        alpha_color: behind transparent pixels.

    Raises:
        InputError: a camera or a photograph cannot be used.
    """
    if len(photographs) == 1:
        fail(f"{where} has one image only. A scene cannot be learned from one view: add photographs.")
    lenses = lenses_of(photographs, reduction, look, announce)
    poses = np.stack([photograph.pose for photograph in photographs])
    if place.auto_scale_poses:
        check_spread(poses[:, :3, 3], where)
    transform, scale = in_training_frame(poses, place, where, announce)
    there = transform @ poses
    there[:, :3, 3] *= scale
    metadata: dict[str, Any] = {"lenses": lenses}
    if points is not None and len(points.xyz):
        xyz = (points.xyz @ transform[:, :3].T + transform[:, 3]) * scale * before_scale
        metadata["points3D_xyz"] = torch.from_numpy(xyz.astype(np.float32))
        metadata["points3D_rgb"] = torch.from_numpy(points.rgb)
    masks = [photograph.mask for photograph in photographs if photograph.mask is not None]
    side = place.scene_scale
    return Views(
        image_filenames=[photograph.file for photograph in photographs],
        cameras=pinhole_cameras([each.pinhole for each in lenses], torch.from_numpy(there.astype(np.float32))),
        alpha_color=alpha_color,
        scene_box=SceneBox(aabb=torch.tensor([[-side] * 3, [side] * 3], dtype=torch.float32)),
        mask_filenames=masks or None,
        dataparser_scale=scale * before_scale,
        dataparser_transform=torch.from_numpy(transform if before is None else transform @ before),
        metadata=metadata,
    )


def in_training_frame(
    poses: npt.NDArray[np.float64], place: Place, where: str, announce: bool = True
) -> tuple[npt.NDArray[np.float64], float]:
    """The transform [3, 4] that turns and centres a capture, and the factor that scales it after that.

    Both are nerfstudio's, but the capture is centred in float64 first: positions in UTM or ECEF coordinates have seven
    digits before the point, which is all that float32 has.

    Args:
        poses: [N, 4, 4] camera to world.
        place: what is done with them.
        where: they are from, for messages.
        announce: say where a capture is centred that was not to be.
    """
    middle = poses[:, :3, 3].mean(0)
    local = poses.copy()
    local[:, :3, 3] -= middle
    found = oriented(torch.from_numpy(local.astype(np.float32)), place.orientation_method, place.center_method)[1]
    transform = found.double().numpy()[:3].copy()
    u, _, v = np.linalg.svd(transform[:, :3])  # far from the origin, the rounding of a rotation is a displacement
    transform[:, :3] = u @ v
    kept = place.center_method == "none"
    if kept and is_far_off(poses[:, :3, 3]):
        kept = False
        if announce:
            say(
                f"The cameras of {where} lie {np.linalg.norm(middle):,.0f} units from the origin, where float32 would "
                "blur the scene: their middle becomes the origin. Bundles state where that is."
            )
    if not kept:
        transform[:, 3] -= transform[:, :3] @ middle
    scale = place.scale_factor
    if place.auto_scale_poses:
        scale /= float(np.abs((transform @ poses)[:, :3, 3]).max())
    return transform, scale


def pinhole_cameras(pinholes: Sequence[Pinhole], poses: torch.Tensor) -> Cameras:
    """nerfstudio's cameras of these, with poses [N, 3 or 4, 4] camera to world."""

    def column(name: str, dtype: torch.dtype = torch.float32) -> torch.Tensor:
        return torch.tensor([getattr(pinhole, name) for pinhole in pinholes], dtype=dtype)

    return Cameras(
        **{name: column(name) for name in ("fx", "fy", "cx", "cy")},
        **{name: column(name, torch.int32) for name in ("width", "height")},
        camera_to_worlds=poses[:, :3, :4],
        camera_type=CameraType.PERSPECTIVE,
    )


def lenses_of(photographs: Sequence[Photograph], reduction: int, look: bool, announce: bool) -> list[Lens]:
    """The lens of each photograph; see `views_of_capture`."""
    sizes: list[tuple[int, int] | None] = [None] * len(photographs)
    smaller = [i for i, photograph in enumerate(photographs) if photograph.smaller]
    if smaller and look:
        with ThreadPoolExecutor(THREADS) as pool:
            for i, size in zip(smaller, pool.map(size_of, [photographs[i].file for i in smaller]), strict=True):
                sizes[i] = size
    made: dict[tuple[Any, ...], Lens] = {}
    result, told = [], []
    for photograph, size in zip(photographs, sizes, strict=True):
        camera = photograph.camera
        full = (camera.width, camera.height)
        small = (max(1, round(full[0] / reduction)), max(1, round(full[1] / reduction)))
        if size is not None and max(abs(size[0] - small[0]), abs(size[1] - small[1])) > 1:
            fail(
                f"the image {photograph.file} has {size[0]} x {size[1]} pixels, but its camera is for {full[0]} x "
                f"{full[1]}, of which 1/{reduction} is {small[0]} x {small[1]}. Make the folder "
                f"{photograph.file.parent} anew, or leave --downscale-factor out."
            )
        used = size or small
        key = (camera, used, photograph.smaller)
        if key not in made:
            stored = used if photograph.smaller else full
            params = rescaled(camera.model, camera.params, full, used)
            made[key], sentences = lens(camera.model, params, *used, stored, photograph.whose)
            told += sentences
        result.append(made[key])
    if announce:
        for sentence in told[:3]:
            say(f"{sentence[0].upper()}{sentence[1:]}")
        if len(told) > 3:
            say(f"So are those of {len(told) - 3} more cameras.")
    return result


def size_of(path: Path) -> tuple[int, int] | None:
    """Width and height of a photograph; None where there is none to read."""
    return of_header(path, lambda image: image.size, None)
