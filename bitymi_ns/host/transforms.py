"""transforms.json and its relatives: read, checked, and made into what nerfstudio's readers expect."""

from __future__ import annotations

import copy
import functools
import glob
import math
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from nerfstudio.cameras.cameras import CAMERA_MODEL_TO_TYPE
from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig

from bitymi_ns.capture.recognise import PHOTOGRAPHS, is_model
from bitymi_ns.host.cameras import PANORAMAS
from bitymi_ns.host.errors import fail, listed, warn
from bitymi_ns.host.poses import rotations
from bitymi_ns.trust import json_of, leads_inside

HOW_TO_GET_ONE = "Make one from photographs with `ns-process-data images --data <photos> --output-dir <capture>`."
SIZES = ("w", "h")
INTRINSICS = (*SIZES, "fl_x", "fl_y", "cx", "cy")
LONGEST_SIDE = 1 << 20
"""Largest width or height of a picture that is believed, in pixels."""
COEFFICIENTS = ("k1", "k2", "k3", "k4", "p1", "p2")
DISTORTION = (*COEFFICIENTS, "distortion_params")


Lists = dict[str, list[str]]
"""Names of photographs by split: train, val, test."""


@contextmanager
def corrected_files(
    config: DataParserConfig, adapt: Callable[[Path, Any], None] = lambda path, meta: None
) -> Iterator[None]:
    """While it lasts, nerfstudio's reader of this kind of capture gets its JSON files as `load` gives them, changed by
    `adapt`.

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
        meta = load(path, own_format)
        adapt(path, meta)
        return meta

    module.load_from_json = lambda path: copy.deepcopy(once(Path(path)))  # type: ignore[attr-defined]
    try:
        yield
    finally:
        module.load_from_json = original  # type: ignore[attr-defined]


def load(path: Path, own_format: bool, announce: bool = True) -> Any:
    """What a JSON file of a capture says, with poses that are rotations.

    Args:
        path: the file, in any Unicode encoding, with or without byte order mark.
        own_format: it is a transforms.json in nerfstudio's own format, of which more is known.
        announce: say what was corrected.

    Raises:
        InputError: the file cannot be used; the message names the frame.
    """
    try:
        meta = json_of(path.read_bytes())
    except FileNotFoundError as error:
        fail(f"{path} does not exist, which this kind of capture needs. {HOW_TO_GET_ONE}", error)
    except (ValueError, OSError) as error:
        fail(f"{path} cannot be read: {error}. {HOW_TO_GET_ONE}", error)
    if own_format:
        _check_frames(path, meta)
        _check_camera(path, meta)
        _distribute(path, meta, announce)
        _check_transform(path, meta)
        _check_lists(path, meta)
    elif isinstance(meta, dict):
        _check_other_format(path, meta)
    frames = meta.get("frames") if isinstance(meta, dict) else None
    if announce and isinstance(frames, list):
        _tell_outside(path, frames)
    if isinstance(frames, list) and all(isinstance(f, dict) and "transform_matrix" in f for f in frames):
        _correct_poses(path, frames, announce)
        _check_repeated(path, frames)
    return meta


def _check_frames(path: Path, meta: Any) -> None:
    frames = meta.get("frames") if isinstance(meta, dict) else None
    if not isinstance(frames, list) or not frames:
        fail(f"{path} lists no frames: the capture has no images with poses. {HOW_TO_GET_ONE}")
    if len(frames) == 1:
        fail(f"{path} has one image only. A scene cannot be learned from one view: take photographs from more sides.")
    for i, frame in enumerate(frames):
        if not isinstance(frame, dict) or not {"file_path", "transform_matrix"} <= frame.keys():
            fail(f"{path}: frame {i} has no file_path or no transform_matrix")
        for key in ("file_path", "mask_path", "depth_file_path"):
            if key in frame:
                frame[key] = _file_name(path, i, key, frame[key])
    without = [frame["file_path"] for frame in frames if "mask_path" not in frame]
    if 0 < len(without) < len(frames):
        fail(
            f"{path}: {listed(without)} has no mask_path, but other frames have one. Give every frame a mask (a white "
            "picture lets all pixels count), or none."
        )


def _tell_outside(path: Path, frames: list[Any]) -> None:
    """Name pictures that lie elsewhere: nerfstudio reads them there, and what is made of the capture shows them."""
    keys = ("file_path", "mask_path", "depth_file_path")
    names = [frame.get(key) for frame in frames if isinstance(frame, dict) for key in keys]
    outside = [name for name in names if isinstance(name, str) and not leads_inside(name)]
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
        angle = meta[key] = _number(path, key, meta[key], "for all frames")
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
    return None if not isinstance(meta, dict) or "ply_file_path" in meta else model


def take_lists(meta: dict[str, Any]) -> Lists:
    """The lists of photographs for training and evaluation, which the file has no more afterwards."""
    found = {split: meta.pop(f"{split}_filenames", None) for split in ("train", "val", "test")}
    return {split: names for split, names in found.items() if names is not None}


def without_endings(path: Path, meta: dict[str, Any]) -> None:
    """Names of a Blender file as its reader expects them: it adds .png itself."""
    for frame in meta["frames"]:
        name = str(frame.get("file_path", ""))
        if name.lower().endswith(".png") and (path.parent / name).is_file():
            frame["file_path"] = name[: -len(".png")]


def complete_instant_ngp(path: Path, meta: dict[str, Any]) -> None:
    """What the format allows and its reader does not know: photographs of any ending or none, and two focal lengths.

    Frames are put in the order of their names, so that the same photographs are held out as from other formats.
    """
    for key in ("equirectangular", "is_equirectangular", "latlong", "is_latlong"):
        if meta.get(key):
            fail(f"{path}: {key} is set. {PANORAMAS}")
    frames = meta["frames"]
    for i, frame in enumerate(frames):
        if not isinstance(frame, dict) or not {"file_path", "transform_matrix"} <= frame.keys():
            fail(f"{path}: frame {i} has no file_path or no transform_matrix")
        name = os.path.normpath(_file_name(path, i, "file_path", frame["file_path"]))
        fitting = [name] if (path.parent / name).is_file() else _with_endings(path.parent, name)
        if len(fitting) > 1:
            fail(f"{path}: frame {i} is of {name}, but there are {listed(fitting)}. Write the ending of the right one.")
        frame["file_path"] = fitting[0] if fitting else name
    missing = [frame["file_path"] for frame in frames if not (path.parent / frame["file_path"]).is_file()]
    if missing:
        fail(
            f"{path}: {len(missing)} of {len(frames)} photographs are missing: {listed(missing)}. Copy them there, "
            "correct the names or remove the frames."
        )
    frames.sort(key=lambda frame: path.parent / frame["file_path"])
    if "fl_y" in meta or "camera_angle_y" in meta or "y_fov" in meta:  # its reader looks for both or takes fl_x
        meta.setdefault("camera_angle_y", math.radians(meta.get("y_fov", 0.0)))
        meta.setdefault("y_fov", math.degrees(meta["camera_angle_y"]))


def _with_endings(folder: Path, name: str) -> list[str]:
    """Photographs of this name without its ending, seen from the folder."""
    place = folder / name
    return sorted(
        path.relative_to(folder).as_posix()
        for path in place.parent.glob(f"{glob.escape(place.name)}.*")
        if path.suffix.lower() in PHOTOGRAPHS and path.stem == place.name
    )


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


def _check_camera(path: Path, meta: dict[str, Any]) -> None:
    """Numbers are numbers, and every frame has all that it needs."""
    frames = meta["frames"]
    for holder in (meta, *frames):
        whose = f"of {holder['file_path']}" if "file_path" in holder else "for all frames"
        for key in (*INTRINSICS, *COEFFICIENTS):
            if key in holder:
                holder[key] = _number(path, key, holder[key], whose)
    for key in INTRINSICS:
        lacking = [frame["file_path"] for frame in frames if key not in meta and key not in frame]
        if lacking:
            way_out = f"Add it once at the top of the file{'' if len(lacking) == len(frames) else ', or to each frame'}"
            if "camera_angle_x" in meta:
                way_out = (
                    "It has camera_angle_x, as files for instant-ngp and Blender's have: give the name of their "
                    "reader, `... instant-ngp-data --data <capture>` or `... blender-data --data <capture>`"
                )
            fail(f"{path} gives no {key} for {listed(lacking)}: it is neither in the frame nor at the top. {way_out}.")
    model = meta.get("camera_model", "OPENCV")
    if model not in CAMERA_MODEL_TO_TYPE:
        fail(
            f"{path}: the camera_model {model!r} is unknown. nerfstudio knows {', '.join(CAMERA_MODEL_TO_TYPE)}; "
            "for undistorted photographs write PINHOLE."
        )


def _number(path: Path, key: str, value: Any, whose: str) -> float | int:
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
        meta["applied_transform"] = transform[:3].tolist()
    if "applied_scale" in meta:
        scale = _number(path, "applied_scale", meta["applied_scale"], "for all frames")
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
