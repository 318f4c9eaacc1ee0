"""The views of a COLMAP model: its photographs found on disk, its cameras as pinholes, its points, in nerfstudio's
frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.data.utils.colmap_parsing_utils import qvec2rotmat

from bitymi_ns.capture.masks import USUAL_FOLDERS, mask_folder, mask_of, smaller_masks
from bitymi_ns.capture.recognise import PHOTOGRAPHS
from bitymi_ns.capture.types import CaptureError, SfmSettings
from bitymi_ns.host.colmap_model import Model, read_model
from bitymi_ns.host.errors import fail, listed, say, warn
from bitymi_ns.host.images import THREADS, of_header
from bitymi_ns.host.lens import Lens, Pinhole, lens, rescaled
from bitymi_ns.host.poses import check_spread, oriented


@dataclass(frozen=True)
class Place:
    """How a model's frame becomes that of training; as in nerfstudio's parsers."""

    scale_factor: float = 1.0
    orientation_method: Literal["pca", "up", "vertical", "none"] = "up"
    center_method: Literal["poses", "focus", "none"] = "poses"
    auto_scale_poses: bool = True
    scene_scale: float = 1.0


@dataclass(frozen=True)
class Origin:
    """Of what a model was found here, so that a run can keep it.

    Attributes:
        kind: of what.
        path: the folder that was searched for photographs, or the video, seen from the capture.
        photographs: folder of the photographs, seen from the capture; None = those of the model are upright copies or
            frames, in a folder that can go.
        settings: with which the poses were found; None = they are not known.
    """

    kind: Literal["photographs", "video"]
    path: str
    photographs: str | None
    settings: SfmSettings | None = None


@dataclass(frozen=True)
class Source:
    """A COLMAP model and the photographs that belong to it.

    Attributes:
        folder: of the model.
        photographs: folder to which the names in the model are relative.
        masks: folder of masks; None = there are none.
        reduction: the photographs are so many times smaller than those of the model.
        reduced: folder of photographs that are that much smaller already; None = they are made so when they are read.
        left_out: photographs that the model lacks, with reasons where they are known.
        report: folder of the report on how the poses were found; None = there is none.
        origin: of what the model was found here; None = the capture came with it.
    """

    folder: Path
    photographs: Path
    masks: Path | None = None
    reduction: int = 1
    reduced: Path | None = None
    left_out: Mapping[str, str] = field(default_factory=dict)
    report: Path | None = None
    origin: Origin | None = None

    @property
    def read(self) -> Path:
        """Folder of the files that are read."""
        return self.reduced or self.photographs

    def files(self, model: Model) -> list[Path]:
        """The photographs of the model's images."""
        return [self.read / image.name for image in model.images]

    def told(self, model: Model) -> str:
        """What it is."""
        kinds: dict[str, int] = {}
        for number in {image.camera_id for image in model.images}:
            kinds[model.cameras[number].model] = kinds.get(model.cameras[number].model, 0) + 1
        cameras = " and ".join(f"{count} {kind}" for kind, count in sorted(kinds.items()))
        text = f"COLMAP model {self.folder} ({len(model.images)} photographs, {cameras} camera"
        text += f"{'s' if sum(kinds.values()) > 1 else ''}, {len(model.xyz):,} points), photographs {self.read}"
        if self.masks is not None:
            text += f", masks {self.masks}"
        if self.reduction > 1 and self.reduced is None:
            text += f", reduced {self.reduction} times as they are read"
        return text


def find_source(
    folder: Path,
    capture: Path,
    images_path: Path | None = None,
    masks_path: Path | None = None,
    reduction: int = 1,
    left_out: Mapping[str, str] | None = None,
    look: bool = True,
) -> Source:
    """Find a model's photographs and masks.

    Args:
        folder: of the model.
        capture: folder to which the paths are relative, and below which photographs are looked for; where it is that of
            the model, the folders above it, too.
        images_path, masks_path: where they are, if that is known.
        reduction: use photographs that are so many times smaller.
        left_out: what is known of photographs that the model lacks.
        look: the photographs are needed; else they may be missing.

    Raises:
        InputError: no folder has the model's photographs, or the masks are not whole.
    """
    names = [image.name for image in read_model(folder).images]
    photographs = _photographs(names, folder, capture, images_path, reduction, look)
    masks = masks_of_capture(photographs, capture, masks_path, reduction)
    return source_in(folder, photographs, masks, reduction, left_out)


def source_in(
    folder: Path,
    photographs: Path,
    masks: Path | None = None,
    reduction: int = 1,
    left_out: Mapping[str, str] | None = None,
) -> Source:
    """A model whose photographs and masks are in known folders; those of reduced ones, as `images_2` and `masks_2`, are
    used where they are there."""
    smaller = photographs.with_name(f"{photographs.name}_{reduction}")
    reduced = smaller if reduction > 1 and smaller.is_dir() else None
    if masks is not None and reduction > 1 and (reduced is not None or not masks.is_dir()):
        small = smaller_masks(masks, reduction)
        masks = small if small.is_dir() else masks  # which are reduced as they are read
    return Source(folder, photographs, masks, reduction, reduced, dict(left_out or {}))


def _photographs(
    names: Sequence[str], folder: Path, capture: Path, given: Path | None, reduction: int, look: bool
) -> Path:
    """The folder that has the most of these photographs."""
    if given is not None:
        if not look or (capture / given).is_dir() or (capture / f"{given}_{reduction}").is_dir():
            return capture / given
        fail(
            f"the folder of photographs {capture / given} does not exist. Give it, seen from {capture}, with "
            "--images-path, or leave that out to have it found."
        )
    bases = [capture]
    if folder.is_relative_to(capture):
        bases += [path for path in folder.parents if path.is_relative_to(capture) and path != capture]
    if folder == capture:
        bases += folder.parents[:3]
    places = [base / name for base in bases for name in USUAL_FOLDERS]
    places += [path for base in bases[:1] for path in sorted(base.iterdir()) if path.is_dir()]
    places += bases

    def present(place: Path) -> int:
        both = (place, place.with_name(f"{place.name}_{reduction}"))
        return max(sum((each / name).is_file() for name in names) if each.is_dir() else 0 for each in both)

    best = max(places, key=present)  # the first of equals
    if look and present(best) == 0:
        fail(
            f"the COLMAP model {folder} is of {listed(names)}, which are in none of the folders of {capture}. Copy the "
            "photographs to its folder `images`, or give their folder, seen from there: `bitymi-data --images-path`."
        )
    return best


def masks_of_capture(photographs: Path, capture: Path, given: Path | None, reduction: int = 1) -> Path | None:
    """The folder of masks by the rule of `mask_folder`.

    Args:
        photographs: their folder.
        capture: the folder of the data.
        given: the folder of masks, seen from the capture; None = it is found.
        reduction: photographs that are so many times smaller may be used.

    Raises:
        InputError: the given one is not there.
    """
    try:
        return mask_folder(photographs, capture, None if given is None else capture / given, reduction)
    except CaptureError as error:
        fail(f"{error}. Give it, seen from {capture}, with --masks-path.", error)


def mask_files(source: Source, model: Model) -> list[Path] | None:
    """The masks of the model's images; see `mask_of`."""
    if source.masks is None:
        return None
    found = {image.name: mask_of(source.masks, image.name) for image in model.images}
    missing = [name for name, file in found.items() if file is None]
    if missing:
        fail(
            f"{source.masks} has no mask of {listed(missing)}, but of others. Give every photograph a mask of its name "
            "with .png (a white picture lets all pixels count), or move the folder away."
        )
    return [file for file in found.values() if file is not None]


def tell_left_out(source: Source, model: Model) -> None:
    """Name the photographs that the model lacks."""
    used = {image.name for image in model.images}
    nested = any("/" in name for name in used)
    there = source.photographs.rglob("*") if nested else source.photographs.glob("*")
    names = {path.relative_to(source.photographs).as_posix() for path in there if path.suffix.lower() in PHOTOGRAPHS}
    unused = sorted((names | source.left_out.keys()) - used)
    if unused:
        named = [f"{name} ({source.left_out[name]})" if name in source.left_out else name for name in unused]
        warn(
            f"{len(unused)} of {len(used) + len(unused)} photographs have no pose in the model and are left out: "
            f"{listed(named)}."
        )


def views(source: Source, place: Place, points: bool, look: bool, announce: bool = True) -> DataparserOutputs:
    """All views of a model in the order of their names, as a parser of nerfstudio gives them; the lenses of the
    photographs are in its metadata.

    Args:
        source: the model and its photographs.
        place: what is done with its frame.
        points: have its points, too.
        look: look into photographs, which decide the size of reduced ones.
        announce: say what is lost.
    """
    model = read_model(source.folder)
    if len(model.images) == 1:
        fail(f"{source.folder} has one image only. A scene cannot be learned from one view: add photographs.")
    files = source.files(model)
    lenses = _lenses(source, model, files, look, announce)
    c2w = np.stack([_camera_to_world(image.qvec, image.tvec) for image in model.images])
    if place.auto_scale_poses:
        check_spread(c2w[:, :3, 3], str(source.folder))
    there = torch.from_numpy(c2w.astype(np.float32))
    poses, transform = oriented(there, place.orientation_method, place.center_method)
    scale = place.scale_factor
    if place.auto_scale_poses:
        scale /= float(poses[:, :3, 3].abs().max())
    poses[:, :3, 3] *= scale
    transform = transform @ torch.from_numpy(TO_NERFSTUDIO.astype(np.float32))
    cameras = pinhole_cameras([each.pinhole for each in lenses], poses)
    metadata: dict[str, Any] = {"lenses": lenses}
    if points and len(model.xyz):
        metadata.update(points_of(model, transform, scale))
    elif points and announce:
        warn(f"The COLMAP model {source.folder} has no points. Training starts from random points.")
    side = place.scene_scale
    return DataparserOutputs(
        image_filenames=files,
        cameras=cameras,
        scene_box=SceneBox(aabb=torch.tensor([[-side] * 3, [side] * 3], dtype=torch.float32)),
        mask_filenames=mask_files(source, model) if look else None,
        dataparser_scale=scale,
        dataparser_transform=transform,
        metadata=metadata,
    )


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


def points_of(model: Model, transform: torch.Tensor, scale: float) -> dict[str, torch.Tensor]:
    """nerfstudio's entries for a model's points, moved by [3, 4] and scaled."""
    xyz = torch.from_numpy(model.xyz.astype(np.float32)) @ transform[:3, :3].T + transform[:3, 3]
    return {"points3D_xyz": xyz * scale, "points3D_rgb": torch.from_numpy(model.rgb)}


TO_NERFSTUDIO = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
"""[4, 4] COLMAP's world, in which up is about -y, to nerfstudio's with z up; nerfstudio's parser does the same."""


def _camera_to_world(qvec: np.ndarray, tvec: np.ndarray) -> np.ndarray:
    """[4, 4] camera to world in nerfstudio's frames (camera: x right, y up, z backward)."""
    rotation = qvec2rotmat(qvec / np.linalg.norm(qvec))
    c2w = np.eye(4)
    c2w[:3, :3], c2w[:3, 3] = rotation.T, -rotation.T @ tvec
    return TO_NERFSTUDIO @ c2w @ np.diag([1.0, -1.0, -1.0, 1.0])


def _lenses(source: Source, model: Model, files: Sequence[Path], look: bool, announce: bool) -> list[Lens]:
    """The lens of each image."""
    sizes: list[tuple[int, int] | None] = [None] * len(files)
    if source.reduced is not None and look:
        with ThreadPoolExecutor(THREADS) as pool:
            sizes = list(pool.map(_size, files))
    made: dict[tuple[int, tuple[int, int]], Lens] = {}
    result, told = [], []
    for image, path, size in zip(model.images, files, sizes, strict=True):
        camera = model.cameras[image.camera_id]
        full = (camera.width, camera.height)
        small = (max(1, round(full[0] / source.reduction)), max(1, round(full[1] / source.reduction)))
        if size is not None and max(abs(size[0] - small[0]), abs(size[1] - small[1])) > 1:
            fail(
                f"the image {path} has {size[0]} x {size[1]} pixels, but its camera is for {full[0]} x {full[1]}, of "
                f"which 1/{source.reduction} is {small[0]} x {small[1]}. Make the folder {source.read} anew, or leave "
                "--downscale-factor out."
            )
        used = size or small
        key = (image.camera_id, used)
        if key not in made:
            stored = used if source.reduced is not None else full
            params = rescaled(camera.model, camera.params, full, used)
            whose = f"camera {image.camera_id} of {source.folder}"
            made[key], sentences = lens(camera.model, params, *used, stored, whose)
            told += sentences
        result.append(made[key])
    if announce:
        for sentence in told[:3]:
            say(f"{sentence[0].upper()}{sentence[1:]}")
        if len(told) > 3:
            say(f"So are those of {len(told) - 3} more cameras.")
    return result


def _size(path: Path) -> tuple[int, int] | None:
    """Width and height of a photograph; None where there is none to read."""
    return of_header(path, lambda image: image.size, None)
