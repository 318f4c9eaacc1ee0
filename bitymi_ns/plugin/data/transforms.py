"""Load and check the JSON files of nerfstudio, instant-ngp and Blender captures."""

import math
import os
from pathlib import Path
from typing import Any

import numpy as np

from bitymi_ns.capture.recognise import is_model
from bitymi_ns.plugin.console import fail, listed, warn
from bitymi_ns.plugin.data.pose_checks import rotations
from bitymi_ns.plugin.data.splits import NameLists
from bitymi_ns.reading import read_json, reading

HOW_TO_GET_ONE = "Make one from photographs with `ns-process-data images --data <photos> --output-dir <capture>`."
HOW_TO_CORRECT = "Correct it there (JSON has neither comments nor a comma behind the last entry), or write it again."
INTRINSICS = ("w", "h", "fl_x", "fl_y", "cx", "cy")
FILE_KEYS = ("file_path", "mask_path", "depth_file_path", "normal_file_path")
LATLONG = ("latlong", "is_latlong")
"""Entries of instant-ngp's for pictures of all directions with latitude and longitude along their sides."""
MAX_SIDE = 1 << 20  # largest plausible width or height of a picture, pixels
COEFFICIENTS = ("k1", "k2", "k3", "k4", "p1", "p2")
DISTORTION = (*COEFFICIENTS, "distortion_params")
FOCALS = {"x": ("fl_x", "camera_angle_x", "x_fov"), "y": ("fl_y", "camera_angle_y", "y_fov")}
"""Entries that state a focal length: in pixels, or by the view angle in radians, or in degrees."""
STATED_BY = {"fl_x": FOCALS["x"], "fl_y": (*FOCALS["y"], *FOCALS["x"][1:])}
"""Entries that serve as another; an angle of one side is that of square pixels."""


def load_transforms(path: Path, own_format: bool) -> dict[str, Any]:
    """Load a file in any Unicode encoding, with or without byte order mark, and check its frames, poses and lists of
    names; poses become rotations. nerfstudio's own format states each camera in full.

    Raises:
        InputError: the file cannot be used; names the frame.
    """
    if not os.path.lexists(path):
        fail(f"{path} does not exist, which this kind of capture needs. {HOW_TO_GET_ONE}")
    with reading(path, fail, HOW_TO_CORRECT if path.is_file() else HOW_TO_GET_ONE):
        meta = read_json(path)
        _drop_nulls(meta)
        _check_frames(path, meta, own_format)
        if own_format:
            _check_intrinsics(path, meta)
            _warn_of_contradictions(path, meta)
        _check_applied(path, meta)
        _check_lists(path, meta)
        _correct_poses(path, meta["frames"])
        _check_repeated(path, meta["frames"])
    return meta


def _drop_nulls(meta: Any) -> None:
    """Remove entries that are null, and empty names of masks and maps, which programs write for "none"."""
    frames = meta.get("frames") if isinstance(meta, dict) else None
    for holder in [meta, *frames] if isinstance(frames, list) else [meta]:
        for key, value in list(holder.items()) if isinstance(holder, dict) else ():
            if value is None or (value == "" and key in FILE_KEYS[1:]):
                del holder[key]


def _check_frames(path: Path, meta: Any, own_format: bool) -> None:
    """Fail where there are no frames, or where one lacks an entry or has no name of a file."""
    frames = meta.get("frames") if isinstance(meta, dict) else None
    if isinstance(frames, dict):
        fail(f"{path}: frames is an object with names, not a list. Write its values as a list, in brackets.")
    if not isinstance(frames, list) or not frames:
        other = "This format needs some in each of its files, those of held-out views as well: move a few frames there."
        fail(f"{path} lists no frames: the capture has no images with poses. {HOW_TO_GET_ONE if own_format else other}")
    if own_format and len(frames) < 2:
        fail(f"{path} has one image only. A scene cannot be learned from one view: take photographs from more sides.")
    for i, frame in enumerate(frames):
        there = frame.keys() if isinstance(frame, dict) else ()
        lacking = [key for key in ("file_path", "transform_matrix") if key not in there]
        if lacking:
            fail(f"{path}: frame {i} (counted from 0) has no {' and no '.join(lacking)}. Add that or remove the frame.")
        for key in FILE_KEYS:
            name = frame.get(key, "none")
            if not isinstance(name, str) or not name:
                fail(f"{path}: the {key} of frame {i} is {name!r}, not the name of a file")
            if key in frame and os.sep == "/" and not (path.parent / name).exists():
                frame[key] = name.replace("\\", "/")
    without = [frame["file_path"] for frame in frames if "mask_path" not in frame]
    if 0 < len(without) < len(frames):
        fail(
            f"{path}: {listed(without)} has no mask_path, but other frames have one. Give every frame a mask (a white "
            "picture lets all pixels count), or none."
        )


def _check_intrinsics(path: Path, meta: dict[str, Any]) -> None:
    """Fail where neither a frame nor the file states an entry of nerfstudio's cameras."""
    frames = meta["frames"]
    for key in INTRINSICS:
        keys = STATED_BY.get(key, (key,))
        lacking = [frame["file_path"] for frame in frames if not any(key in meta or key in frame for key in keys)
                   and (key in ("w", "h") or not is_equirectangular(meta, frame))]  # fmt: skip
        if lacking:
            add = f"Add it once at the top of the file{'' if len(lacking) == len(frames) else ', or to each frame'}"
            fail(f"{path} gives no {key} for {listed(lacking)}: it is neither in the frame nor at the top. {add}.")


def is_equirectangular(meta: dict[str, Any], frame: dict[str, Any]) -> bool:
    """Test if a frame is a picture of all directions, which has no focal length: so stated in nerfstudio's words, or by
    an entry of instant-ngp's."""
    return stated_model(meta, frame) == "EQUIRECTANGULAR"


def stated_model(meta: dict[str, Any], frame: dict[str, Any]) -> Any:
    """Return nerfstudio's name of the camera model of a frame, whose entries go before those of the file."""
    for holder in (frame, meta):
        if "camera_model" in holder:
            return holder["camera_model"]
        if any(holder.get(key) for key in LATLONG):
            return "EQUIRECTANGULAR"
        if any(key in holder for key in ("is_fisheye", "fisheye")):
            return "OPENCV_FISHEYE" if holder.get("is_fisheye") or holder.get("fisheye") else "OPENCV"
    return "OPENCV"


def _warn_of_contradictions(path: Path, meta: dict[str, Any]) -> None:
    """Warn where frames state another camera than the file does for all; the frame's is used."""
    differing: list[str] = []
    for group in (*((key,) for key in INTRINSICS), DISTORTION):
        common = {key: meta[key] for key in group if key in meta}
        own = [{key: frame[key] for key in group if key in frame} for frame in meta["frames"]]
        if common and any(values not in ({}, common) for values in own):
            differing.extend(common)
    if differing:
        warn(f"{path} gives {', '.join(differing)} for all frames and for single ones: those of the frame are used.")


def check_number(path: Path, key: str, value: Any, label: str) -> float | int:
    """Convert an entry, which may be in quotes, to a number; `label` is for the message.

    Raises:
        InputError: it is no number, or for w and h no number of pixels.
    """
    try:
        number = float(None if isinstance(value, bool) else value)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        fail(f"{path}: {key} {label} is {value!r}, which is no number")
    if key not in ("w", "h"):
        return number  # what is not finite is refused with the cameras
    if not number.is_integer() or not 1 <= number <= MAX_SIDE:
        fail(f"{path}: {key} {label} is {value!r}, which is no number of pixels")
    return int(number)


def _check_applied(path: Path, meta: dict[str, Any]) -> None:
    """Check the transform [3, 4] and the scale that were applied to the capture as a whole."""
    if "applied_transform" in meta:
        transform = _matrix(meta["applied_transform"])
        singular = "maps the capture to a plane, a line or a point, which cannot be undone"
        if transform is None or abs(np.linalg.det(transform[:3, :3])) < 1e-12:
            fault = "is not a matrix of 3 x 4 finite numbers" if transform is None else singular
            fail(
                f"{path}: applied_transform {fault}. Correct it, or remove it: then exports are in the frame of this "
                "file."
            )
        meta["applied_transform"] = transform[:3].tolist()
    if "applied_scale" in meta:
        scale = check_number(path, "applied_scale", meta["applied_scale"], "for all frames")
        if not 0.0 < scale < math.inf:
            fail(f"{path}: applied_scale is {scale}, which is no positive number. Correct it or remove it.")


def _check_lists(path: Path, meta: dict[str, Any]) -> None:
    """Check the lists of names for training and evaluation: all of them or none."""
    keys = [f"{split}_filenames" for split in ("train", "val", "test")]
    stated = [key for key in keys if key in meta]
    if not stated:
        return
    for key in stated:
        if not isinstance(meta[key], list) or not all(isinstance(name, str) for name in meta[key]):
            fail(f"{path}: {key} is {repr(meta[key])[:60]}, not a list of names. Correct it or remove it.")
    if stated[0] != keys[0] or len(stated) == 1:
        fail(
            f"{path} has {', '.join(stated)}, but a split needs train_filenames and val_filenames (or test_filenames). "
            "Add what is missing, or remove the lists to have views held out by --eval-mode."
        )
    for key, other in ((keys[1], keys[2]), (keys[2], keys[1])):
        meta.setdefault(key, meta.get(other))


def take_lists(meta: dict[str, Any]) -> NameLists:
    """Remove the lists of names for training and evaluation from `meta` and return them."""
    found = {split: meta.pop(f"{split}_filenames", None) for split in ("train", "val", "test")}
    return {split: names for split, names in found.items() if names is not None}


def colmap_points(path: Path) -> Path | None:
    """Find the COLMAP model with the points of a transforms.json that names none, as earlier versions of nerfstudio's
    tool left it; None = there is none."""
    model = path.parent / "colmap/sparse/0"
    if not is_model(model):
        return None
    try:
        meta = read_json(path)
    except (OSError, ValueError):
        return None  # reported where it is read
    return None if not isinstance(meta, dict) or meta.get("ply_file_path") is not None else model


def applied_transform(meta: dict[str, Any], folder: Path) -> np.ndarray | None:
    """Read [4, 4] that was applied to a nerfstudio capture before its file was written; None = unknown."""
    rows = meta.get("applied_transform")
    if rows is None and (folder / "colmap/sparse/0").is_dir():
        rows = [[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]]  # nerfstudio's tool applied it before it stated that
    return None if rows is None else np.vstack([np.array(rows, float)[:3], [0.0, 0.0, 0.0, 1.0]])


def _correct_poses(path: Path, frames: list[dict[str, Any]]) -> None:
    """Fail at matrices that are no poses; recover rotations, see `rotations`."""
    names = [frame["file_path"] for frame in frames]
    poses = []
    for frame, name in zip(frames, names, strict=True):
        pose = _matrix(frame["transform_matrix"])
        if pose is None:
            fail(
                f"{path}: the transform_matrix of {name} is not a matrix of 4 x 4 finite numbers. "
                "Correct it or remove the frame."
            )
        if np.abs(pose[3] - (0.0, 0.0, 0.0, 1.0)).max() > 1e-6:
            row = " ".join(f"{x:g}" for x in pose[3])
            fail(
                f"{path}: the last row of the transform_matrix of {name} is {row}, not 0 0 0 1. A matrix whose "
                "position stands in its last row has to be transposed."
            )
        poses.append(pose)
    matrices = np.stack(poses)
    matrices[:, :3, :3] = rotations(matrices[:, :3, :3], names, str(path))
    for frame, pose in zip(frames, matrices, strict=True):
        frame["transform_matrix"] = pose.tolist()


def _check_repeated(path: Path, frames: list[dict[str, Any]]) -> None:
    """Fail where one photograph has two poses."""
    first: dict[str, int] = {}
    for i, frame in enumerate(frames):
        name = os.path.normpath(frame["file_path"])
        before = first.setdefault(name, i)
        poses = [np.asarray(frames[j]["transform_matrix"]) for j in (before, i)]
        if before != i and not np.allclose(*poses, rtol=1e-5, atol=1e-5):
            fail(
                f"{path}: frames {before} and {i} (counted from 0) are both of {name}, but with different poses. "
                "Correct the name of one of them or remove it."
            )


def _matrix(value: Any) -> np.ndarray | None:
    """Convert 3 x 4 or 4 x 4 finite numbers to [4, 4]; None for anything else."""
    try:
        matrix = np.asarray(value, dtype=np.float64)
    except (ValueError, TypeError, OverflowError):
        return None
    if matrix.shape not in ((3, 4), (4, 4)) or not np.isfinite(matrix).all():
        return None
    return matrix if len(matrix) == 4 else np.concatenate([matrix, [[0.0, 0.0, 0.0, 1.0]]])
