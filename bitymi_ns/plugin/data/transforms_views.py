"""Photographs, cameras and poses as JSON files state them: nerfstudio's transforms.json, instant-ngp's, and Blender's.

The three differ in what they call a focal length and where photographs lie; every entry is read wherever it stands, in
a frame before the top of the file. What is read by nothing is named.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from nerfstudio.cameras.cameras import CAMERA_MODEL_TO_TYPE, CameraType

from bitymi_ns.capture.panorama import PANORAMAS
from bitymi_ns.plugin.console import fail, listed, say
from bitymi_ns.plugin.data.colmap_model import ModelCamera
from bitymi_ns.plugin.data.names import Files, renamed
from bitymi_ns.plugin.data.transforms import (
    COEFFICIENTS,
    DISTORTION,
    INTRINSICS,
    Lists,
    check_number,
    load,
    take_lists,
    tell_outside,
)
from bitymi_ns.plugin.data.views import Photograph, size_of

FOCALS = {"x": ("fl_x", "camera_angle_x", "x_fov"), "y": ("fl_y", "camera_angle_y", "y_fov")}
"""What says a focal length: in pixels, or by the angle that a picture spans in radians, or in degrees."""
USED = {
    "frames", "file_path", "mask_path", "transform_matrix", "camera_model", "is_fisheye", "fisheye", "ply_file_path",
    "applied_transform", "applied_scale", "orientation_override", "aabb_scale",
    *INTRINSICS, *DISTORTION, *FOCALS["x"], *FOCALS["y"],
}  # fmt: skip
SILENT = {"rotation", "sharpness", "colmap_im_id", "made_by"}
"""Entries that say nothing about the scene: a turntable's step, how sharp a picture is, a number in another file, a
program."""
PANORAMIC = ("equirectangular", "is_equirectangular", "latlong", "is_latlong")
FISHEYE624 = "RAD_TAN_THIN_PRISM_FISHEYE"
"""COLMAP's name for Project Aria's camera, nerfstudio's FISHEYE624."""


@dataclass(frozen=True)
class Transforms:
    """A file with its photographs in the order of their names.

    Attributes:
        path: the file.
        meta: what it says.
        photographs: with cameras and poses.
        lists: of photographs for training and evaluation.
    """

    path: Path
    meta: dict[str, Any]
    photographs: list[Photograph]
    lists: Lists


def read_transforms(
    path: Path, own_format: bool, reduction: int = 1, look: bool = True, announce: bool = True
) -> Transforms:
    """Read and check a file, and find its photographs.

    Args:
        path: the file.
        own_format: it is in nerfstudio's format, in which every frame states its camera.
        reduction: use copies that are so many times smaller, where there are some.
        look: the photographs are needed; else they may be missing.
        announce: say what was corrected, found elsewhere, or is not used.

    Raises:
        InputError: the file cannot be used, or lacks photographs.
    """
    meta = load(path, own_format, announce, stock=False)
    frames = meta["frames"]
    for holder in (meta, *frames):
        for key in PANORAMIC:
            if holder.get(key):
                fail(f"{path}: {key} is set. {PANORAMAS}")
    lists = take_lists(meta)
    names = [frame["file_path"] for frame in frames]
    files = _files(path, names, look)
    if announce and look:
        other = renamed(names, files, path.parent)
        if other:
            say(f"{path}: {other}")
    masks = _masks(path.parent, [frame.get("mask_path") for frame in frames], files, look)
    cloud = meta.get("ply_file_path")
    if isinstance(cloud, str) and cloud and not (path.parent / cloud).is_file():
        there = Files(path.parent, endings=(".ply",)).find(cloud)
        meta["ply_file_path"] = cloud if there is None else there.relative_to(path.parent).as_posix()
    if announce and look:
        folder = os.path.normpath(path.parent)
        pictures = [Path(os.path.normpath(file)) for file in (*files, *masks) if file is not None]
        outside = [file for file in dict.fromkeys(pictures) if not file.is_relative_to(folder)]
        tell_outside(path, [file for file in outside if file.is_file()])
    photographs = []
    made: dict[tuple[Any, ...], ModelCamera] = {}
    for frame, file, mask in zip(frames, files, masks, strict=True):
        photographs.append(
            Photograph(
                file=file,
                camera=_camera(path, meta, frame, file, made),
                pose=np.array(frame["transform_matrix"]),
                whose=f"the camera of {frame['file_path']} in {path}",
                mask=mask,
            )
        )
    photographs.sort(key=lambda photograph: photograph.file)
    if announce:
        _name_unused(path, meta, own_format)
    if reduction > 1:
        photographs = _smaller(photographs, path.parent, reduction)
    return Transforms(path, meta, photographs, lists)


def _name_unused(path: Path, meta: dict[str, Any], own_format: bool) -> None:
    """Say which entries nothing reads."""
    known = USED | SILENT
    unused = [key for key in meta if key not in known]
    unused += [f"{key} of frames" for key in dict.fromkeys(k for f in meta["frames"] for k in f) if key not in known]
    if own_format and "aabb_scale" in meta:
        unused.append("aabb_scale")
    if unused:
        say(f"Entries of {path} that are not used: {listed(unused, most=12)}.")


def _files(path: Path, names: Sequence[str], look: bool) -> list[Path]:
    """The photographs of a file; those that are missing under the names that it has for them.

    Raises:
        InputError: a name without its ending is that of several.
    """
    folder = path.parent
    files = Files(folder, outside=True)
    found = files.find_all(names)
    if look and None in found:
        images = Files(folder / "images").find_all(names) if (folder / "images").is_dir() else [None] * len(names)
        taken = set(found)
        found = [one or (other if other not in taken else None) for one, other in zip(found, images, strict=True)]
    for i, (name, file) in enumerate(zip(names, found, strict=True)):
        several = files.ambiguous(name) if look and file is None else []
        if several:
            fail(f"{path}: frame {i} is of {name}, but there are {listed(several)}. Write the ending of the right one.")
    return [Path(os.path.normpath(file or folder / name)) for name, file in zip(names, found, strict=True)]


def _masks(folder: Path, names: Sequence[str | None], photographs: Sequence[Path], look: bool) -> list[Path | None]:
    """The masks of these names; those that are missing under the names that the file has for them. One may serve
    several photographs."""
    files = Files(folder, outside=True)
    found = {name: files.find(name) if look else None for name in dict.fromkeys(names) if name is not None}
    taken = set(photographs)
    paths = {name: folder / name if path is None or path in taken else path for name, path in found.items()}
    return [None if name is None else paths[name] for name in names]


def missing_photographs(path: Path, photographs: Iterable[Photograph]) -> None:
    """Stop where photographs of a file are missing, naming files with nearly their names."""
    files = list(dict.fromkeys(photograph.file for photograph in photographs))
    missing = [file for file in files if not file.is_file()]
    if not missing:
        return
    some = "\n  ".join(f"{file}{_instead(path.parent, file)}" for file in missing[:3])
    fail(
        f"{len(missing)} of {len(files)} photographs of {path} are missing:\n  {some}\n"
        "Copy them there, correct the names or remove the frames."
    )


def _instead(folder: Path, file: Path) -> str:
    if file.is_symlink():
        return " (a link to nothing)"
    if file.exists():
        return " (not a file)"
    near = Files(file.parent if file.parent.is_dir() else folder).nearest(file.name)
    return f" ({near})" if near else ""


def _smaller(photographs: list[Photograph], folder: Path, reduction: int) -> list[Photograph]:
    """The photographs as copies that are smaller already where there are such; else they are reduced as they are read.

    Copies lie in `images_2` beside `images`, under the same names or, as nerfstudio's tool writes them, without
    folders.
    """

    def copies(file: Path) -> list[Path]:
        inside = file.relative_to(folder).parts if file.is_relative_to(folder) else (file.parent.name, file.name)
        beside = folder.joinpath(f"{inside[0]}_{reduction}", *inside[1:]) if len(inside) > 1 else None
        flat = folder / f"images_{reduction}" / file.name
        return [flat] if beside is None else list(dict.fromkeys((beside, flat)))

    found = [next((copy for copy in copies(each.file) if copy.is_file()), None) for each in photographs]
    if not any(found):
        return photographs
    lacking = [copies(each.file)[0] for each, copy in zip(photographs, found, strict=True) if copy is None]
    if lacking:
        fail(
            f"{len(lacking)} of {len(found)} images of the capture are missing:\n  {listed(lacking)}\nOthers have a "
            f"copy that is {reduction} times smaller: make the missing ones, or move that folder away to have all "
            "photographs reduced as they are read."
        )
    if len(set(found)) < len(set(each.file for each in photographs)):
        twins = sorted({each.file.relative_to(folder).as_posix() for each, copy in zip(photographs, found, strict=True)
                        if found.count(copy) > 1})  # fmt: skip
        fail(
            f"{listed(twins)} have the same names in different folders, but {found[0].parent} can have one of each "  # type: ignore[union-attr]
            "alone. Use the photographs as they are (`bitymi-data --downscale-factor 1`), or give them different names."
        )
    return [replace(each, file=copy, mask=_smaller_mask(each.mask, folder, reduction), smaller=True)
            for each, copy in zip(photographs, found, strict=True) if copy is not None]  # fmt: skip


def _smaller_mask(mask: Path | None, folder: Path, reduction: int) -> Path | None:
    if mask is None:
        return None
    small = folder / f"masks_{reduction}" / mask.name
    return small if small.is_file() else mask


def _camera(
    path: Path, meta: dict[str, Any], frame: dict[str, Any], file: Path, made: dict[tuple[Any, ...], ModelCamera]
) -> ModelCamera:
    """The camera of a frame, in the terms of COLMAP."""
    name = frame["file_path"]
    whose = f"of {name}"

    def value(*keys: str) -> tuple[str, float] | None:
        """The first of these that the frame has, else the file."""
        for holder in (frame, meta):
            for key in keys:
                if holder.get(key) is not None:
                    return key, check_number(path, key, holder[key], whose)
        return None

    def either(key: str) -> float | None:
        found = value(key)
        return None if found is None else found[1]

    width, height = either("w"), either("h")
    if width is None or height is None:
        size = size_of(file)
        if size is not None:
            width, height = width or size[0], height or size[1]
        else:  # what is wrong is said where it is read; and what opens no photograph needs some size
            width, height = width or height or UNKNOWN_SIZE, height or width or UNKNOWN_SIZE
    sides = {"x": width, "y": height}
    focal: dict[str, float] = {}
    for axis, keys in FOCALS.items():
        found = value(*keys)
        if found is not None:
            focal[axis] = _focal(path, *found, sides[axis])
    if not focal:
        fail(
            f"{path} gives no focal length of {name}: neither fl_x nor camera_angle_x (radians) is in the frame or at "
            "the top of the file. Add one of them."
        )
    fx, fy = focal.get("x", focal.get("y", 0.0)), focal.get("y", focal.get("x", 0.0))
    cx, cy = either("cx"), either("cy")
    pinhole = (fx, fy, width / 2.0 if cx is None else cx, height / 2.0 if cy is None else cy)
    model, more = _lens(path, meta, frame, whose)
    camera = ModelCamera(model, int(width), int(height), (*pinhole, *more))
    return made.setdefault(camera, camera)


UNKNOWN_SIZE = 800
"""Pixels along a side of a picture of which neither the file states it, nor is there a photograph."""


def _focal(path: Path, key: str, value: float, side: float) -> float:
    """A focal length in pixels."""
    if key.startswith("fl_"):
        return value
    angle = math.radians(value) if key.endswith("fov") else value
    if not 0.0 < angle < math.pi:
        degrees = f" ({value:g} degrees are {math.radians(value):.6g})" if math.pi <= value < 180.0 else ""
        fail(f"{path}: {key} is {value:g}, but lies between 0 and pi: it is in radians, not degrees{degrees}.")
    return 0.5 * side / math.tan(0.5 * angle)


def _lens(path: Path, meta: dict[str, Any], frame: dict[str, Any], whose: str) -> tuple[str, tuple[float, ...]]:
    """COLMAP's camera model of a frame, and its parameters beyond focal lengths and principal point."""
    model = frame.get("camera_model", meta.get("camera_model"))
    if model is None:
        fisheye = any(frame.get(key, meta.get(key)) for key in ("is_fisheye", "fisheye"))
        model = "OPENCV_FISHEYE" if fisheye else "OPENCV"
    if model not in CAMERA_MODEL_TO_TYPE:
        fail(
            f"{path}: the camera_model {model!r} {whose} is unknown. nerfstudio knows "
            f"{', '.join(CAMERA_MODEL_TO_TYPE)}; for undistorted photographs write PINHOLE."
        )
    kind = CAMERA_MODEL_TO_TYPE[model]
    if kind not in (CameraType.PERSPECTIVE, CameraType.FISHEYE, CameraType.FISHEYE624):
        remedy = PANORAMAS if kind == CameraType.EQUIRECTANGULAR else "Correct the capture."
        fail(
            f"the camera {whose} in {path} cannot be used: it is neither a perspective nor a fisheye camera, which are "
            f"the kinds that can be trained on, but {kind.name}. {remedy}"
        )
    holder = frame if any(key in frame for key in DISTORTION) else meta
    listed_ones = holder.get("distortion_params")
    if listed_ones is not None:
        values = [check_number(path, "distortion_params", each, whose) for each in np.ravel(listed_ones).tolist()]
        wanted = {CameraType.PERSPECTIVE: (6,), CameraType.FISHEYE: (4, 6), CameraType.FISHEYE624: (12,)}[kind]
        if len(values) not in wanted:
            needs = {CameraType.PERSPECTIVE: "perspective cameras need six: k1, k2, k3, k4, p1, p2",
                     CameraType.FISHEYE: "fisheye cameras need four: k1, k2, k3, k4",
                     CameraType.FISHEYE624: "FISHEYE624 needs twelve"}[kind]  # fmt: skip
            fail(f"{path}: the camera {whose} has {len(values)} distortion_params; {needs}. Correct the capture.")
    else:
        values = [check_number(path, key, holder.get(key, 0.0), whose) for key in COEFFICIENTS]
    if kind == CameraType.FISHEYE624:
        return FISHEYE624, tuple(values)
    if kind == CameraType.FISHEYE:
        return "OPENCV_FISHEYE", tuple(values[:4])
    k1, k2, k3, k4, p1, p2 = values
    if k4 != 0.0:
        fail(
            f"the camera {whose} in {path} cannot be used: its k4 is {k4:g}, but perspective cameras are undistorted "
            "by k1, k2, k3, p1 and p2 alone. For a fisheye write camera_model OPENCV_FISHEYE; else undistort the "
            "photographs first (COLMAP's image_undistorter)."
        )
    if k3 != 0.0:
        return "FULL_OPENCV", (k1, k2, p1, p2, k3, 0.0, 0.0, 0.0)
    return ("OPENCV", (k1, k2, p1, p2)) if any((k1, k2, p1, p2)) else ("PINHOLE", ())
