"""Read transforms.json of nerfstudio, instant-ngp and Blender. Entries of a frame go before those of the file."""

import math
import os
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bitymi_ns.safe_reading import read_json
from bitymi_ns.trust import listed
from . import find_files
from .image_files import image_size
from .lens import colmap_distortion
from .pose_checks import as_matrix, correct_poses
from .splits import NameLists
from .types import SPHERICAL_MODEL, ColmapCamera, Photograph, fail, parsing, say

HOW_TO_GET_ONE = "Give a folder of photographs or a video: their poses are found."
HOW_TO_CORRECT = "Correct it there (JSON has neither comments nor a comma behind the last entry), or write it again."
INTRINSICS = ("w", "h", "fl_x", "fl_y", "cx", "cy")
LISTS = {f"{split}_filenames": split for split in ("train", "val", "test")}  # of names of photographs
FILE_KEYS = ("file_path", "mask_path", "depth_file_path", "normal_file_path")
MODELS = {
    **dict.fromkeys(("latlong", "is_latlong"), "EQUIRECTANGULAR"),
    **dict.fromkeys(("is_fisheye", "fisheye"), "OPENCV_FISHEYE"),
}
"""instant-ngp's entries for camera models; latlong: with latitude and longitude along the pictures' sides."""
CAMERA_TYPES = {
    **dict.fromkeys(("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"), "PERSPECTIVE"),
    "OPENCV_FISHEYE": "FISHEYE", "EQUIRECTANGULAR": "EQUIRECTANGULAR", "FISHEYE624": "FISHEYE624",
}  # fmt: skip
"""nerfstudio's camera types by camera_model, of those that can be trained on."""
MAX_SIDE = 1 << 20  # largest plausible width or height of a picture, pixels
COEFFICIENTS = ("k1", "k2", "k3", "k4", "p1", "p2")
DISTORTION = (*COEFFICIENTS, "distortion_params")
FOCALS = ("fl_x", "camera_angle_x", "x_fov"), ("fl_y", "camera_angle_y", "y_fov")
"""Entries of a focal length, across and down: in pixels, or by the view angle in radians, or in degrees."""
OF_MATRIX = {"fl_x": (0, 0), "fl_y": (1, 1), "cx": (0, 2), "cy": (1, 2)}  # rows and columns of a camera matrix
EQUAL_AREA = ("equirectangular", "is_equirectangular")  # instant-ngp's entries for 360-degree rows of equal areas
USED = {
    "frames", *FILE_KEYS, "transform_matrix", "camera_model", "ply_file_path",
    *MODELS, *EQUAL_AREA, "applied_transform", "applied_scale", "orientation_override", "aabb_scale",
    *INTRINSICS, *DISTORTION, *FOCALS[0], *FOCALS[1],
}  # fmt: skip
IRRELEVANT = {"rotation", "sharpness", "colmap_im_id", "made_by"}  # unused entries that are not reported
UNKNOWN_SIZE = 800  # pixels along the sides of missing pictures, where none are needed


@dataclass(frozen=True)
class Transforms:
    path: Path
    meta: dict[str, Any]  # content
    photographs: list[Photograph]  # sorted by file name
    lists: NameLists  # of names for training and evaluation
    named: frozenset[Path]  # pictures, masks and maps


def read_transforms(path: Path, own_format: bool, need_photos: bool, use_masks: bool) -> Transforms:
    """Read a JSON file, make poses rotations, and find its photographs, maps and masks. Raises CaptureError."""
    if not os.path.lexists(path):
        fail(f"{path} does not exist. {HOW_TO_GET_ONE}")
    with parsing(path, HOW_TO_CORRECT if path.is_file() else HOW_TO_GET_ONE):
        meta = read_json(path)
        _drop_nulls(meta)
        _check_frames(path, meta, own_format)
        for holder in (meta, *meta["frames"]):
            _translate(path, holder)
        _check_applied(path, meta)
        for key in [key for key in LISTS if key in meta]:
            if not isinstance(meta[key], list) or not all(isinstance(name, str) for name in meta[key]):
                fail(f"{path}: {key} is {repr(meta[key])[:60]}, not a list of names. Correct it or remove it.")
        correct_poses(path, meta["frames"])
    frames = meta["frames"]
    lists = {split: meta.pop(key) for key, split in LISTS.items() if key in meta}
    names = [frame["file_path"] for frame in frames]
    files = find_files.find_photographs(path, names, need_photos)
    masked = [frame.get("mask_path") if use_masks else None for frame in frames]
    masks = find_files.find_masks(path.parent, masked, files, need_photos)
    maps = find_files.find_maps(path, frames, need_photos)
    cloud = meta.get("ply_file_path")
    if cloud is not None and (not isinstance(cloud, str) or not cloud):
        fail(f"{path}: ply_file_path is {cloud!r}, not the name of a file. Correct it or remove it.")
    if cloud and not os.path.isfile(path.parent / cloud):
        there = find_files.FileFinder(path.parent, extensions=(".ply",)).find(cloud)
        meta["ply_file_path"] = cloud if there is None else there.relative_to(path.parent).as_posix()
    if need_photos:
        find_files.report_files(path, names, files, masks)
    known = {*USED, *IRRELEVANT} - ({"aabb_scale"} if own_format else set())
    unused = [key for key in meta if key not in known]
    unused += [f"{key} of frames" for key in dict.fromkeys(k for f in frames for k in f) if key not in known]
    if unused:
        say(f"Entries of {path} that are not used: {listed(unused, most=12)}.")
    photographs = []
    for frame, file, mask, beside in zip(frames, files, masks, maps, strict=True):
        label = f"the camera of {frame['file_path']} in {path}"
        with parsing(label, "Correct its entries."):
            camera = _camera(path, meta, frame, file)
        pose = np.array(frame["transform_matrix"])
        photographs.append(Photograph(file, camera, pose, label, mask, maps=beside))
    photographs.sort(key=lambda photograph: photograph.file)
    used = [*files, *masks, *(file for each in maps for file in astuple(each))]
    named = frozenset(Path(os.path.normpath(file)) for file in used if file is not None)
    return Transforms(path, meta, photographs, NameLists(lists), named)


def _drop_nulls(meta: Any) -> None:
    """Remove null entries and empty names of masks and maps, which programs write for "none"."""
    frames = meta.get("frames") if isinstance(meta, dict) else None
    for holder in [meta, *frames] if isinstance(frames, list) else [meta]:
        for key, value in list(holder.items()) if isinstance(holder, dict) else ():
            if value is None or (value == "" and key in FILE_KEYS[1:]):
                del holder[key]


def _translate(path: Path, holder: dict[str, Any]) -> None:
    """Write camera entries of instant-ngp and NeuS2, of a frame or of all, as nerfstudio's."""
    matrix = holder.pop("intrinsic_matrix", None)
    for key, (i, j) in OF_MATRIX.items() if matrix else ():
        holder.setdefault(key, matrix[i][j])
    if "camera_model" in holder:
        return
    for key in filter(holder.get, EQUAL_AREA):
        what = f"{path}: {key} is set, which means rows of equal areas, which cannot be read"
        fail(f'{what}. For rows of equal angles write "camera_model": "EQUIRECTANGULAR" instead.')
    stated = [model if holder[key] else "OPENCV" for key, model in MODELS.items() if key in holder]
    if stated:
        holder["camera_model"] = min(stated, key="OPENCV".__eq__)


def _check_frames(path: Path, meta: Any, own_format: bool) -> None:
    """Fail if there are no frames, or one lacks an entry or names no file."""
    frames = meta.get("frames") if isinstance(meta, dict) else None
    if isinstance(frames, dict):
        fail(f"{path}: frames is an object, not a list. Write its values as a list, in brackets.")
    if not isinstance(frames, list) or not frames:
        advice = HOW_TO_GET_ONE if own_format else "Move a few frames there."
        fail(f"{path} lists no frames: the capture has no images with poses. {advice}")
    if own_format and len(frames) < 2:
        fail(f"{path} has one image only. A scene needs photographs from more sides.")
    for i, frame in enumerate(frames):
        there = frame.keys() if isinstance(frame, dict) else ()
        lacking = [key for key in ("file_path", "transform_matrix") if key not in there]
        if lacking:
            fail(f"{path}: frame {i} (counted from 0) has no {' and no '.join(lacking)}. Add that or remove the frame.")
        for key in FILE_KEYS:
            name = frame.get(key, "none")
            last = find_files.folded(name)[-1:] if isinstance(name, str) else ()
            if last in ((), ("..",)):  # of the folder itself or above
                fail(f"{path}: the {key} of frame {i} is {name!r}, not the name of a file")
            if key in frame and os.sep == "/" and not os.path.exists(path.parent / name):
                frame[key] = name.replace("\\", "/")
    without = [frame["file_path"] for frame in frames if "mask_path" not in frame]
    if 0 < len(without) < len(frames):
        advice = "Give every frame a mask (white where all counts), or none."
        fail(f"{path}: no mask_path for {listed(without)}, but other frames have one. {advice}")


def check_number(path: Path, key: str, value: Any, label: str) -> float | int:
    """Convert an entry, also in quotes, to a number. Raises CaptureError: it is none, or none of its kind."""
    try:
        number = float("" if isinstance(value, bool) else value)
    except (TypeError, ValueError, OverflowError):
        fail(f"{path}: {key} {label} is {value!r}, which is no number")
    if key.endswith("_scale") and not 0.0 < number < math.inf:
        fail(f"{path}: {key} is {value!r}, which is no positive number. Correct it or remove it.")
    if key not in ("w", "h"):
        return number  # what is not finite is refused with the cameras
    if not number.is_integer() or not 1 <= number <= MAX_SIDE:
        fail(f"{path}: {key} {label} is {value!r}, which is no number of pixels")
    return int(number)


def _check_applied(path: Path, meta: dict[str, Any]) -> None:
    """Check the transform [3, 4], made [4, 4] here, and the scale that were applied to the whole capture."""
    if "applied_transform" in meta:
        transform = as_matrix(meta["applied_transform"])
        if transform is None or abs(np.linalg.det(transform[:3, :3])) < 1e-12:
            fault = "is not a matrix of 3 x 4 finite numbers that can be undone"
            fail(f"{path}: applied_transform {fault}. Correct it, or remove it to export in this file's frame.")
        meta["applied_transform"] = transform
    if "applied_scale" in meta:
        meta["applied_scale"] = check_number(path, "applied_scale", meta["applied_scale"], "for all frames")


def _camera(path: Path, meta: dict[str, Any], frame: dict[str, Any], file: Path) -> ColmapCamera:
    name = frame["file_path"]

    def value(*keys: str) -> tuple[str, float] | None:
        """Find the first of these keys in the frame, else in the file."""
        for holder, label in ((frame, f"of {name}"), (meta, "for all frames")):
            for key in keys:
                if key in holder:
                    return key, check_number(path, key, holder[key], label)
        return None

    width, height, cx, cy = (None if (entry := value(key)) is None else entry[1] for key in ("w", "h", "cx", "cy"))
    if width is None or height is None:  # missing pictures are reported when they are read
        size = image_size(file) or (height or UNKNOWN_SIZE, width or UNKNOWN_SIZE)
        width, height = width or size[0], height or size[1]
    middle = (width / 2.0 if cx is None else cx, height / 2.0 if cy is None else cy)
    if frame.get("camera_model", meta.get("camera_model")) == "EQUIRECTANGULAR":
        if max(abs(middle[0] - width / 2.0), abs(middle[1] - height / 2.0)) > 1.0:
            what = f"its cx and cy are {middle[0]:g} and {middle[1]:g}, not the middle of its {width} x {height} pixels"
            fail(f"{path}: {name} is EQUIRECTANGULAR, but {what}. Remove them, or shift the picture.")
        return ColmapCamera(SPHERICAL_MODEL, int(width), int(height), (float(width), float(height)))
    stated = (value(*keys) for keys in FOCALS)
    fx, fy = (None if entry is None else _focal_length(path, *entry, side)
              for entry, side in zip(stated, (width, height), strict=True))  # fmt: skip
    fx, fy = (fy if fx is None else fx), (fx if fy is None else fy)
    if fx is None or fy is None:
        where = "neither fl_x nor camera_angle_x (radians) is in the frame or the file"
        fail(f"{path} gives no focal length of {name}: {where}. Add one of them.")
    model, coefficients = _distortion(path, meta, frame)
    return ColmapCamera(model, int(width), int(height), (fx, fy, *middle, *coefficients))


def _focal_length(path: Path, key: str, value: float, side: float) -> float:
    """Convert an entry of FOCALS to pixels; `side` of the picture is in pixels."""
    if key.startswith("fl_"):
        return value
    angle = math.radians(value) if key.endswith("fov") else value
    if not 0.0 < angle < math.pi:
        degrees = f" ({value:g} degrees are {math.radians(value):.6g})" if math.pi <= value < 180.0 else ""
        fail(f"{path}: {key} is {value:g}, but lies between 0 and pi: it is in radians, not degrees{degrees}.")
    return 0.5 * side / math.tan(0.5 * angle)


def _distortion(path: Path, meta: dict[str, Any], frame: dict[str, Any]) -> tuple[str, tuple[float, ...]]:
    label = f"of {frame['file_path']}"
    model = frame.get("camera_model", meta.get("camera_model", "OPENCV"))
    if not isinstance(model, str) or model not in CAMERA_TYPES:
        advice = f"Those known are {', '.join(CAMERA_TYPES)}; for undistorted photographs write PINHOLE."
        fail(f"{path}: the camera_model {model!r} {label} cannot be used. {advice}")
    kind = CAMERA_TYPES[model]
    holder = frame if any(key in frame for key in DISTORTION) else meta
    if "distortion_params" in holder:
        stated = np.ravel(holder["distortion_params"]).tolist()
        values = [check_number(path, "distortion_params", value, label) for value in stated]
    else:
        values = [check_number(path, key, holder.get(key, 0.0), label) for key in COEFFICIENTS]
        values += [0.0] * (6 if kind == "FISHEYE624" else 0)
    return colmap_distortion(kind, values, f"{label} in {path}")
