"""Photographs, cameras and poses of JSON files: nerfstudio's transforms.json, instant-ngp's, and Blender's.

The three differ in how they state a focal length and where photographs lie; every entry is read wherever it stands, in
a frame before the top of the file. Entries that nothing reads are reported.
"""

import math
import os
from collections.abc import Sequence
from dataclasses import astuple, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from nerfstudio.cameras.cameras import CAMERA_MODEL_TO_TYPE, CameraType

from bitymi_ns.capture.camera import SPHERICAL_MODEL, ColmapCamera
from bitymi_ns.capture.recognise import SPLITS
from bitymi_ns.plugin.console import fail, listed, say, warn
from bitymi_ns.plugin.data.depth_files import MAP_FILES, MapFiles
from bitymi_ns.plugin.data.find_files import FileFinder, renamed_message
from bitymi_ns.plugin.data.images import image_size
from bitymi_ns.plugin.data.lens import colmap_distortion
from bitymi_ns.plugin.data.mask_files import with_masks
from bitymi_ns.plugin.data.splits import NameLists
from bitymi_ns.plugin.data.transforms import (
    COEFFICIENTS,
    DISTORTION,
    FILE_KEYS,
    FOCALS,
    INTRINSICS,
    LATLONG,
    check_number,
    is_equirectangular,
    load_transforms,
    stated_model,
    take_lists,
)
from bitymi_ns.plugin.data.views import Photograph
from bitymi_ns.reading import reading

EQUAL_AREA = ("equirectangular", "is_equirectangular")
"""Entries of instant-ngp's for pictures of all directions of which rows show equal areas."""
USED = {
    "frames", *FILE_KEYS, "transform_matrix", "camera_model", "is_fisheye", "fisheye", "ply_file_path",
    *LATLONG, *EQUAL_AREA, "applied_transform", "applied_scale", "orientation_override", "aabb_scale",
    *INTRINSICS, *DISTORTION, *FOCALS["x"], *FOCALS["y"],
}  # fmt: skip
IRRELEVANT = {"rotation", "sharpness", "colmap_im_id", "made_by"}
"""Unused entries that are not reported: turntable step, sharpness, number in another file, program."""
UNKNOWN_SIZE = 800
"""Pixels along a side of a picture whose size is not stated and that is missing, where none is needed."""


@dataclass(frozen=True)
class Transforms:
    """JSON file of a capture."""

    path: Path  # the file
    meta: dict[str, Any]  # its content
    photographs: list[Photograph]  # sorted by file name
    lists: NameLists  # of names for training and evaluation
    named: frozenset[Path]  # its pictures, masks and maps, before they are replaced by downscaled copies

    @property
    def files(self) -> list[Path]:
        """Files of the photographs."""
        return [photograph.file for photograph in self.photographs]


def read_transforms(
    path: Path, own_format: bool, downscale: int = 1, need_photos: bool = True, use_masks: bool = True
) -> Transforms:
    """Read and check a JSON file, see `load_transforms`, and find its photographs, or copies that are smaller by
    `downscale`, and masks, those beside the photographs where it names none; see `with_masks`. Photographs may be
    missing where they are not needed.

    Raises:
        InputError: the file cannot be used, or lacks photographs.
    """
    meta = load_transforms(path, own_format)
    frames = meta["frames"]
    for holder in (meta, *frames):
        for key in EQUAL_AREA:
            if holder.get(key) and "camera_model" not in holder:
                fail(
                    f"{path}: {key} is set, by which instant-ngp means pictures whose rows show equal areas, which "
                    'cannot be read. For rows of equal angles write "camera_model": "EQUIRECTANGULAR" instead.'
                )
    lists = take_lists(meta)
    names = [frame["file_path"] for frame in frames]
    files = _find_photographs(path, names, need_photos)
    masks = _find_masks(path.parent, [frame.get("mask_path") if use_masks else None for frame in frames], files,
                        need_photos)  # fmt: skip
    maps = _find_maps(path, frames, need_photos)
    cloud = meta.get("ply_file_path")
    if cloud is not None and (not isinstance(cloud, str) or not cloud):
        fail(f"{path}: ply_file_path is {cloud!r}, not the name of a file. Correct it or remove it.")
    if cloud and not (path.parent / cloud).is_file():
        there = FileFinder(path.parent, extensions=(".ply",)).find(cloud)
        meta["ply_file_path"] = cloud if there is None else there.relative_to(path.parent).as_posix()
    if need_photos:
        _report_files(path, names, files, masks)
    _report_unused(path, meta, own_format)
    made: dict[ColmapCamera, ColmapCamera] = {}
    photographs = []
    for frame, file, mask, beside in zip(frames, files, masks, maps, strict=True):
        label = f"the camera of {frame['file_path']} in {path}"
        with reading(label, fail, "Correct its entries."):
            camera = _camera(path, meta, frame, file)
        pose = np.array(frame["transform_matrix"])
        photographs.append(Photograph(file, made.setdefault(camera, camera), pose, label, mask, maps=beside))
    photographs.sort(key=lambda photograph: photograph.file)
    if use_masks and need_photos and not any(masks):
        photographs = with_masks(photographs, path.parent, path.parent if path.name in SPLITS else None)
    used = [*files, *(each.mask for each in photographs), *(file for each in maps for file in astuple(each))]
    if downscale > 1:
        photographs = _downscaled(photographs, path.parent, downscale)
    named = frozenset(Path(os.path.normpath(file)) for file in used if file is not None)
    return Transforms(path, meta, photographs, lists, named)


def _report_files(path: Path, names: Sequence[str], files: Sequence[Path], masks: Sequence[Path | None]) -> None:
    """Report files that have other names than stated, and those outside of the folder: results show them."""
    other = renamed_message(names, files, path.parent)
    if other:
        say(f"{path}: {other}")
    folder = os.path.normpath(path.parent)
    pictures = dict.fromkeys(Path(os.path.normpath(file)) for file in (*files, *masks) if file is not None)
    outside = [file for file in pictures if not file.is_relative_to(folder) and file.is_file()]
    if outside:
        warn(f"{path} names pictures outside of its folder, which are read there: {listed(outside)}.")


def _report_unused(path: Path, meta: dict[str, Any], own_format: bool) -> None:
    known = USED | IRRELEVANT
    unused = [key for key in meta if key not in known]
    unused += [f"{key} of frames" for key in dict.fromkeys(k for f in meta["frames"] for k in f) if key not in known]
    if own_format and "aabb_scale" in meta:
        unused.append("aabb_scale")
    if unused:
        say(f"Entries of {path} that are not used: {listed(unused, most=12)}.")


def _find_photographs(path: Path, names: Sequence[str], need_photos: bool) -> list[Path]:
    """Find the photographs of a file; missing ones keep the stated names. Fails where a name fits more than one
    file."""
    folder = path.parent
    finder = FileFinder(folder, outside=True)
    found = finder.find_all(names)
    if need_photos and None in found and (folder / "images").is_dir():
        taken = set(found)
        images = FileFinder(folder / "images").find_all(names)
        found = [one or (other if other not in taken else None) for one, other in zip(found, images, strict=True)]
    for i, (name, file) in enumerate(zip(names, found, strict=True)):
        ambiguous = finder.ambiguous(name) if need_photos and file is None else []
        if ambiguous:
            fail(
                f"{path}: frame {i} is of {name}, but there are {listed(ambiguous)}. Write the ending of the right one."
            )
    return [Path(os.path.normpath(file or folder / name)) for name, file in zip(names, found, strict=True)]


def _find_masks(
    folder: Path, names: Sequence[str | None], photographs: Sequence[Path], need_photos: bool
) -> list[Path | None]:
    """Find the masks of these names, which may serve several photographs; missing ones keep the stated names."""
    finder = FileFinder(folder, outside=True)
    found = {name: finder.find(name) if need_photos else None for name in dict.fromkeys(names) if name is not None}
    taken = set(photographs)
    paths = {name: folder / name if path is None or path in taken else path for name, path in found.items()}
    return [None if name is None else paths[name] for name in names]


def _find_maps(path: Path, frames: Sequence[dict[str, Any]], need_photos: bool) -> list[MapFiles]:
    """Find the maps of depth and normals, with a warning on those that are missing."""
    finder = FileFinder(path.parent, outside=True, extensions=MAP_FILES)
    found: dict[str, list[Path | None]] = {}
    for key in ("depth_file_path", "normal_file_path"):
        names = [frame.get(key) for frame in frames]
        found[key] = [None if name is None else finder.find(name) for name in names]
        lacking = [name for name, file in zip(names, found[key], strict=True) if name is not None and file is None]
        if lacking and need_photos:
            warn(f"{path}: {len(lacking)} files of {key} are missing, and not used: {listed(lacking)}.")
    return [MapFiles(depth, normal=normal) for depth, normal in zip(*found.values(), strict=True)]


def _downscaled(photographs: list[Photograph], folder: Path, downscale: int) -> list[Photograph]:
    """Replace photographs by their downscaled copies, where there are such, in `images_2` beside `images`, under the
    same names or, as nerfstudio's tool writes them, without folders; else they are downscaled as they are read."""

    def copies(file: Path) -> list[Path]:
        inside = file.relative_to(folder).parts if file.is_relative_to(folder) else (file.parent.name, file.name)
        flat = folder / f"images_{downscale}" / file.name
        if len(inside) == 1:
            return [flat]
        return list(dict.fromkeys((folder.joinpath(f"{inside[0]}_{downscale}", *inside[1:]), flat)))

    def mask_copy(mask: Path | None) -> Path | None:
        small = None if mask is None else folder / f"masks_{downscale}" / mask.name
        return small if small is not None and small.is_file() else mask

    found = [next((copy for copy in copies(each.file) if copy.is_file()), None) for each in photographs]
    if not any(found):
        return photographs
    lacking = [copies(each.file)[0] for each, copy in zip(photographs, found, strict=True) if copy is None]
    if lacking:
        fail(
            f"{len(lacking)} of {len(found)} images of the capture are missing:\n  {listed(lacking)}\nOthers have a "
            f"copy that is {downscale} times smaller: make the missing ones, or move that folder away to have all "
            "photographs reduced as they are read."
        )
    if len(set(found)) < len(set(each.file for each in photographs)):
        twins = sorted({each.file.relative_to(folder).as_posix() for each, copy in zip(photographs, found, strict=True)
                        if found.count(copy) > 1})  # fmt: skip
        fail(
            f"{listed(twins)} have the same names in different folders, but {found[0].parent} can have one of each "  # type: ignore[union-attr]
            "alone. Use the photographs as they are (`bitymi-data --downscale-factor 1`), or give them different names."
        )
    return [replace(each, file=copy, mask=mask_copy(each.mask), downscaled=True)
            for each, copy in zip(photographs, found, strict=True) if copy is not None]  # fmt: skip


def _camera(path: Path, meta: dict[str, Any], frame: dict[str, Any], file: Path) -> ColmapCamera:
    """Convert the camera of a frame to COLMAP's terms."""
    name = frame["file_path"]

    def value(*keys: str) -> tuple[str, float] | None:
        """The first of these that the frame has, else the file."""
        for holder, label in ((frame, f"of {name}"), (meta, "for all frames")):
            for key in keys:
                if key in holder:
                    return key, check_number(path, key, holder[key], label)
        return None

    width, height, cx, cy = (None if (found := value(key)) is None else found[1] for key in ("w", "h", "cx", "cy"))
    if width is None or height is None:
        size = image_size(file)
        if size is not None:
            width, height = width or size[0], height or size[1]
        else:  # reported where it is read; and what opens no photograph needs some size
            width, height = width or height or UNKNOWN_SIZE, height or width or UNKNOWN_SIZE
    if is_equirectangular(meta, frame):
        middle = (width / 2.0 if cx is None else cx, height / 2.0 if cy is None else cy)
        if max(abs(middle[0] - width / 2.0), abs(middle[1] - height / 2.0)) > 1.0:
            fail(
                f"{path}: {name} is EQUIRECTANGULAR, but its cx and cy are {middle[0]:g} and {middle[1]:g}, not the "
                f"middle of its {width} x {height} pixels. Remove them, or shift the picture and turn the pose."
            )
        return ColmapCamera(SPHERICAL_MODEL, int(width), int(height), (float(width), float(height)))
    sides = {"x": width, "y": height}
    focal: dict[str, float] = {}
    for axis, keys in FOCALS.items():
        found = value(*keys)
        if found is not None:
            focal[axis] = _focal_length(path, *found, sides[axis])
    if not focal:
        fail(
            f"{path} gives no focal length of {name}: neither fl_x nor camera_angle_x (radians) is in the frame or at "
            "the top of the file. Add one of them."
        )
    fx, fy = focal.get("x", focal.get("y", 0.0)), focal.get("y", focal.get("x", 0.0))
    pinhole = (fx, fy, width / 2.0 if cx is None else cx, height / 2.0 if cy is None else cy)
    model, coefficients = _distortion(path, meta, frame)
    return ColmapCamera(model, int(width), int(height), (*pinhole, *coefficients))


def _focal_length(path: Path, key: str, value: float, side: float) -> float:
    """Convert an entry of FOCALS to pixels; `side` of the picture in pixels."""
    if key.startswith("fl_"):
        return value
    angle = math.radians(value) if key.endswith("fov") else value
    if not 0.0 < angle < math.pi:
        degrees = f" ({value:g} degrees are {math.radians(value):.6g})" if math.pi <= value < 180.0 else ""
        fail(f"{path}: {key} is {value:g}, but lies between 0 and pi: it is in radians, not degrees{degrees}.")
    return 0.5 * side / math.tan(0.5 * angle)


def _distortion(path: Path, meta: dict[str, Any], frame: dict[str, Any]) -> tuple[str, tuple[float, ...]]:
    """Convert camera model and distortion of a frame; see `colmap_distortion`."""
    label = f"of {frame['file_path']}"
    model = stated_model(meta, frame)
    if not isinstance(model, str) or model not in CAMERA_MODEL_TO_TYPE:
        fail(
            f"{path}: the camera_model {model!r} {label} is unknown. nerfstudio knows "
            f"{', '.join(CAMERA_MODEL_TO_TYPE)}; for undistorted photographs write PINHOLE."
        )
    kind = CAMERA_MODEL_TO_TYPE[model]
    holder = frame if any(key in frame for key in DISTORTION) else meta
    stated = holder.get("distortion_params")
    if stated is None:
        values = [check_number(path, key, holder.get(key, 0.0), label) for key in COEFFICIENTS]
        values += [0.0] * (6 if kind == CameraType.FISHEYE624 else 0)
    else:
        values = [check_number(path, "distortion_params", each, label) for each in np.ravel(stated).tolist()]
    return colmap_distortion(kind, values, f"{label} in {path}")
