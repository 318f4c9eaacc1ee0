"""transforms.json and its relatives: read, checked, and made into what nerfstudio's readers expect."""

from __future__ import annotations

import copy
import functools
import math
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from nerfstudio.cameras.cameras import CAMERA_MODEL_TO_TYPE
from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig

from bitymi_ns.capture.recognise import is_model
from bitymi_ns.plugin.console import fail, listed, warn
from bitymi_ns.plugin.data.poses import rotations, warn_of_far_off
from bitymi_ns.trust import json_of, leads_inside

HOW_TO_GET_ONE = "Make one from photographs with `ns-process-data images --data <photos> --output-dir <capture>`."
HOW_TO_MEND = "Correct it there (JSON has neither comments nor a comma behind the last entry), or write the file anew."
SIZES = ("w", "h")
OPTIONAL = (
    "mask_path", "depth_file_path", "ply_file_path", "applied_transform", "applied_scale", "orientation_override",
    "distortion_params",
)  # fmt: skip
"""Entries that may be null, which is as if they were not there."""
INTRINSICS = (*SIZES, "fl_x", "fl_y", "cx", "cy")
LONGEST_SIDE = 1 << 20
"""Largest width or height of a picture that is believed, in pixels."""
COEFFICIENTS = ("k1", "k2", "k3", "k4", "p1", "p2")
DISTORTION = (*COEFFICIENTS, "distortion_params")
ANGLES = {"fl_x": ("camera_angle_x", "x_fov"), "fl_y": ("camera_angle_y", "y_fov", "camera_angle_x", "x_fov")}
"""What may stand for a focal length: the angle that a picture spans."""


Lists = dict[str, list[str]]
"""Names of photographs by split: train, val, test."""


@contextmanager
def corrected_files(config: DataParserConfig) -> Iterator[None]:
    """While it lasts, nerfstudio's reader of this kind of capture gets its JSON files as `load` gives them.

    The poses have to be right before nerfstudio orients, centres and scales the capture by them.
    """
    module = sys.modules[config._target.__module__]
    original = getattr(module, "load_from_json", None)
    if original is None:  # a reader of other files
        yield
        return
    own_format = isinstance(config, NerfstudioDataParserConfig)

    @functools.cache  # each split reads the file; what is wrong is said once
    def once(path: Path) -> Any:
        return load(path, own_format)

    module.load_from_json = lambda path: copy.deepcopy(once(Path(path)))  # type: ignore[attr-defined]
    try:
        yield
    finally:
        module.load_from_json = original  # type: ignore[attr-defined]


def load(path: Path, own_format: bool, announce: bool = True, stock: bool = True) -> Any:
    """What a JSON file of a capture says, with poses that are rotations.

    Args:
        path: the file, in any Unicode encoding, with or without byte order mark.
        own_format: it is a transforms.json in nerfstudio's own format, of which more is known.
        announce: say what was corrected.
        stock: it is for nerfstudio's reader, which knows less of what a file may say than that of this package.

    Raises:
        InputError: the file cannot be used; the message names the frame.
    """
    try:
        meta = json_of(path.read_bytes())
    except FileNotFoundError as error:
        fail(f"{path} does not exist, which this kind of capture needs. {HOW_TO_GET_ONE}", error)
    except (ValueError, OSError) as error:
        fail(f"{path} cannot be read: {error}. {HOW_TO_MEND if path.is_file() else HOW_TO_GET_ONE}", error)
    _drop_nulls(meta)
    if own_format:
        _check_frames(path, meta, least=2)
        _check_camera(path, meta, stock)
        _distribute(path, meta, announce)
    elif isinstance(meta, dict):
        _check_other_format(path, meta)
        if not stock:
            _check_frames(path, meta, least=1)
    if own_format or (not stock and isinstance(meta, dict)):
        _check_transform(path, meta)
        _check_lists(path, meta)
    frames = meta.get("frames") if isinstance(meta, dict) else None
    if stock and announce and isinstance(frames, list):
        keys = ("file_path", "mask_path", "depth_file_path")
        names = [frame.get(key) for frame in frames if isinstance(frame, dict) for key in keys]
        tell_outside(path, [name for name in names if isinstance(name, str) and not leads_inside(name)])
    if isinstance(frames, list) and all(isinstance(f, dict) and "transform_matrix" in f for f in frames):
        _correct_poses(path, frames, announce)
        _check_repeated(path, frames)
        if stock and announce and frames:
            warn_of_far_off(path, np.array([frame["transform_matrix"] for frame in frames])[:, :3, 3])
    return meta


def _drop_nulls(meta: Any) -> None:
    """Remove entries that say nothing: programs write null, or an empty name, for what a frame does not have."""
    frames = meta.get("frames") if isinstance(meta, dict) else None
    holders = [meta, *frames] if isinstance(frames, list) else [meta]
    for holder in (each for each in holders if isinstance(each, dict)):
        for key, value in list(holder.items()):
            if (value is None and key in OPTIONAL) or (value == "" and key in ("mask_path", "depth_file_path")):
                del holder[key]


def _check_frames(path: Path, meta: Any, least: int) -> None:
    frames = meta.get("frames") if isinstance(meta, dict) else None
    if isinstance(frames, dict):
        fail(f"{path}: frames is an object with names, not a list. Write its values as a list, in brackets.")
    if not isinstance(frames, list) or not frames:
        fail(f"{path} lists no frames: the capture has no images with poses. {HOW_TO_GET_ONE}")
    if len(frames) < least:
        fail(f"{path} has one image only. A scene cannot be learned from one view: take photographs from more sides.")
    for i, frame in enumerate(frames):
        there = frame.keys() if isinstance(frame, dict) else ()
        lacking = [key for key in ("file_path", "transform_matrix") if key not in there]
        if lacking:
            fail(f"{path}: frame {i} (counted from 0) has no {' and no '.join(lacking)}. Add that or remove the frame.")
        for key in ("file_path", "mask_path", "depth_file_path"):
            if key in frame:
                frame[key] = _file_name(path, i, key, frame[key])
    without = [frame["file_path"] for frame in frames if "mask_path" not in frame]
    if 0 < len(without) < len(frames):
        fail(
            f"{path}: {listed(without)} has no mask_path, but other frames have one. Give every frame a mask (a white "
            "picture lets all pixels count), or none."
        )


def tell_outside(path: Path, outside: Sequence[object]) -> None:
    """Name pictures that lie elsewhere: they are read there, and what is made of the capture shows them."""
    if outside:
        warn(f"{path} names pictures outside of its folder, which are read there: {listed(outside)}.")


def _file_name(path: Path, i: int, key: str, name: Any) -> str:
    if not isinstance(name, str) or not name:
        fail(f"{path}: the {key} of frame {i} is {name!r}, not the name of a file")
    portable = name.replace("\\", "/")
    return portable if os.sep == "/" and not (path.parent / name).exists() else name


def _check_other_format(path: Path, meta: dict[str, Any]) -> None:
    """What Blender's files and instant-ngp's have in common."""
    if "frames" in meta and (not isinstance(meta["frames"], list) or not meta["frames"]):
        fail(
            f"{path} lists no frames, but the reader of this format needs some in each of its files, those of held-out "
            "views as well. Move a few frames there."
        )
    for key in ("camera_angle_x", "camera_angle_y"):
        if key not in meta or f"fl_{key[-1]}" in meta:
            continue  # nothing reads it
        angle = meta[key] = check_number(path, key, meta[key], "for all frames")
        if not 0.0 < angle < math.pi:
            converted = f" ({angle:g} degrees are {math.radians(angle):.6g})" if math.pi <= angle < 180.0 else ""
            fail(f"{path}: {key} is {angle:g}, but lies between 0 and pi: it is in radians, not degrees{converted}.")


def _check_lists(path: Path, meta: dict[str, Any]) -> None:
    """The lists of photographs for training and evaluation: all of them or none."""
    keys = [f"{split}_filenames" for split in ("train", "val", "test")]
    given = [key for key in keys if key in meta]
    if not given:
        return
    for key in given:
        if not isinstance(meta[key], list) or not all(isinstance(name, str) for name in meta[key]):
            fail(f"{path}: {key} is {repr(meta[key])[:60]}, not a list of names. Correct it or remove it.")
    if given[0] != keys[0] or len(given) == 1:
        fail(
            f"{path} has {', '.join(given)}, but a split needs train_filenames and val_filenames (or test_filenames). "
            "Add what is missing, or remove the lists to have views held out by --eval-mode."
        )
    for key, other in ((keys[1], keys[2]), (keys[2], keys[1])):
        meta.setdefault(key, meta.get(other))


def colmap_points(path: Path) -> Path | None:
    """The COLMAP model whose points belong to a transforms.json that names no points, as earlier versions of
    nerfstudio's tool left it; None = there is none."""
    model = path.parent / "colmap/sparse/0"
    if not is_model(model):
        return None
    try:
        meta = json_of(path.read_bytes())
    except (OSError, ValueError):
        return None  # what is wrong is said where it is read
    return None if not isinstance(meta, dict) or meta.get("ply_file_path") is not None else model


def take_lists(meta: dict[str, Any]) -> Lists:
    """The lists of photographs for training and evaluation, which the file has no more afterwards."""
    found = {split: meta.pop(f"{split}_filenames", None) for split in ("train", "val", "test")}
    return {split: names for split, names in found.items() if names is not None}


def _check_repeated(path: Path, frames: list[dict[str, Any]]) -> None:
    """One photograph has one pose."""
    first: dict[str, int] = {}
    for i, frame in enumerate(frames):
        name = os.path.normpath(str(frame.get("file_path", f"frame {i}")))
        before = first.setdefault(name, i)
        poses = [np.asarray(frames[j]["transform_matrix"]) for j in (before, i)]
        if before != i and not np.allclose(*poses, rtol=1e-5, atol=1e-5):
            fail(
                f"{path}: frames {before} and {i} (counted from 0) are both of {name}, but with different poses. "
                "Correct the name of one of them or remove it."
            )


def _check_camera(path: Path, meta: dict[str, Any], stock: bool) -> None:
    """Numbers are numbers, and every frame has all that it needs."""
    frames = meta["frames"]
    for holder in (meta, *frames):
        whose = f"of {holder['file_path']}" if "file_path" in holder else "for all frames"
        for key in (*INTRINSICS, *COEFFICIENTS):
            if key in holder:
                holder[key] = check_number(path, key, holder[key], whose)
    for key in INTRINSICS:
        ways = (key,) if stock else (key, *ANGLES.get(key, ()))
        lacking = [frame["file_path"] for frame in frames if not any(way in meta or way in frame for way in ways)]
        if lacking:
            way_out = f"Add it once at the top of the file{'' if len(lacking) == len(frames) else ', or to each frame'}"
            if stock and "camera_angle_x" in meta:
                way_out = (
                    "It has camera_angle_x, as files for instant-ngp and Blender's have: give the name of their "
                    "reader, `... instant-ngp-data --data <capture>` or `... blender-data --data <capture>`"
                )
            fail(f"{path} gives no {key} for {listed(lacking)}: it is neither in the frame nor at the top. {way_out}.")
    if not stock:
        return
    own = {repr(frame["camera_model"]) for frame in frames if "camera_model" in frame}
    if own and (len(own) > 1 or any("camera_model" not in frame for frame in frames)):
        fail(
            f"{path} has frames with a camera_model of their own ({', '.join(sorted(own))}), but nerfstudio's reader "
            "takes one for all frames, from the top of the file. Read it with `bitymi-data`, the default."
        )
    if own:  # which it would not see
        meta["camera_model"] = frames[0]["camera_model"]
    model = meta.get("camera_model", "OPENCV")
    if model not in CAMERA_MODEL_TO_TYPE:
        fail(
            f"{path}: the camera_model {model!r} is unknown. nerfstudio knows {', '.join(CAMERA_MODEL_TO_TYPE)}; "
            "for undistorted photographs write PINHOLE."
        )


def check_number(path: Path, key: str, value: Any, whose: str) -> float | int:
    """The number that an entry is, also in quotes; stops where it is none. `whose` it is, for the message."""
    try:
        number = float(None if isinstance(value, bool) else value)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        fail(f"{path}: {key} {whose} is {value!r}, which is no number")
    if key not in SIZES:
        return number  # what is not finite is refused with the cameras
    if not number.is_integer() or number > LONGEST_SIDE:
        fail(f"{path}: {key} {whose} is {value!r}, which is no number of pixels")
    return int(number)


def _distribute(path: Path, meta: dict[str, Any], announce: bool) -> None:
    """What frames say of their own camera goes before what the file says for all, which nerfstudio would take."""
    frames = meta["frames"]
    differing = []
    for group in (*((key,) for key in INTRINSICS), DISTORTION):
        common = {key: meta[key] for key in group if key in meta}
        own = [{key: frame[key] for key in group if key in frame} for frame in frames]
        if not common or not any(own):
            continue
        if any(values not in ({}, common) for values in own):
            differing.extend(common)
        for frame, values in zip(frames, own, strict=True):
            if not values:
                frame.update(common)
        for key in common:
            del meta[key]
    if announce and differing:
        warn(f"{path} gives {', '.join(differing)} for all frames and for single ones: those of the frame are used.")


def _check_transform(path: Path, meta: dict[str, Any]) -> None:
    """The transform that was applied to the capture as a whole, [3, 4]."""
    if "applied_transform" in meta:
        transform = _matrix(meta["applied_transform"])
        if transform is None:
            fail(
                f"{path}: applied_transform is not a matrix of 3 x 4 finite numbers. Correct it, or remove it: then "
                "exports are in the frame of this file."
            )
        if abs(np.linalg.det(transform[:3, :3])) < 1e-12:
            fail(
                f"{path}: applied_transform maps the capture to a plane, a line or a point, which cannot be undone. "
                "Correct it, or remove it: then exports are in the frame of this file."
            )
        meta["applied_transform"] = transform[:3].tolist()
    if "applied_scale" in meta:
        scale = check_number(path, "applied_scale", meta["applied_scale"], "for all frames")
        if not 0.0 < scale < math.inf:
            fail(f"{path}: applied_scale is {scale}, which is no positive number. Correct it or remove it.")


def _correct_poses(path: Path, frames: list[dict[str, Any]], announce: bool) -> None:
    """Stop at poses that nerfstudio would spread over all others, or stumble over; correct what is meant well."""
    names = [frame.get("file_path", f"frame {i}") for i, frame in enumerate(frames)]
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
    if not poses:
        return
    whole = np.stack(poses)
    whole[:, :3, :3] = rotations(whole[:, :3, :3], names, str(path), announce)
    for frame, pose in zip(frames, whole, strict=True):
        frame["transform_matrix"] = pose.tolist()


def _matrix(value: Any) -> np.ndarray | None:
    """[4, 4] from 3 x 4 or 4 x 4 finite numbers; None from anything else."""
    try:
        matrix = np.asarray(value, dtype=np.float64)
    except (ValueError, TypeError):
        return None
    if matrix.shape not in ((3, 4), (4, 4)) or not np.isfinite(matrix).all():
        return None
    return matrix if len(matrix) == 4 else np.concatenate([matrix, [[0.0, 0.0, 0.0, 1.0]]])
