"""COLMAP models: where they lie, and what is wrong with one, by file and entry."""

from __future__ import annotations

import functools
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.data.utils import colmap_parsing_utils as reader

from bitymi_ns.capture.recognise import is_model, models_in
from bitymi_ns.plugin.console import fail, listed, warn
from bitymi_ns.plugin.data.point_cloud import point_count
from bitymi_ns.plugin.data.poses import warn_of_far_off
from bitymi_ns.trust import leads_inside


def check_model(data: Path, dataparser: ColmapDataParserConfig) -> int:
    """Stop where there is no model or no photographs; without points, go on from random ones.

    Returns:
        How many points it has, as far as that can be told before they are read; else 0.
    """
    model = data / dataparser.colmap_path
    if not is_model(model):
        models = models_in(data)
        what = "has no cameras.bin or cameras.txt" if model.is_dir() else "does not exist"
        if not models:
            fail(
                f"the COLMAP model {model} {what}, and there is none in other folders of {data}. Give its folder, "
                "seen from the capture, with `--colmap-path` after `colmap`."
            )
        others = "" if len(models) == 1 else f" ({listed(models[1:])} would do, too)"
        fail(f"the COLMAP model {model} {what}. Give `{options_for(data, models[0])}`{others}.")
    photographs = data / dataparser.images_path
    reduced = photographs.with_name(f"{photographs.name}_{dataparser.downscale_factor}")
    if not photographs.is_dir() and not reduced.is_dir():  # nerfstudio reads the reduced ones where they are asked for
        fail(
            f"the folder of photographs {photographs} does not exist. Give it, seen from the capture, with "
            "`--images-path` after `colmap`."
        )
    if not dataparser.load_3D_points:
        return 0
    points = next((file for name in ("points3D.bin", "points3D.txt") if (file := model / name).is_file()), None)
    if points is None or _is_empty(points):
        what = "has no points3D.bin or points3D.txt" if points is None else f"has no points: {points.name} is empty"
        warn(f"The COLMAP model {model} {what}. Training starts from random points.")
        dataparser.load_3D_points = False
        return 0
    return point_count(points)


def _is_empty(points: Path) -> bool:
    if points.suffix == ".bin":
        return points.stat().st_size == 8 and point_count(points) == 0  # one that is cut off is named when it is read
    with open(points, "rb") as file:
        return not any(line.strip() and not line.startswith(b"#") for line in file)


def options_for(data: Path, model: Path) -> str:
    """What to write on the command line to train on a model."""
    return f"colmap --data {data} --colmap-path {model}"


@contextmanager
def checked_models(config: DataParserConfig) -> Iterator[None]:
    """While it lasts, nerfstudio's reader of COLMAP models stops at what is wrong with one, in words that name it.

    Each file is read once, not anew for every split.
    """
    if not isinstance(config, ColmapDataParserConfig):
        yield
        return
    cameras: dict[int, Any] = {}  # of the model, to which its images belong

    def check_and_keep(path: Path, found: dict[int, Any]) -> None:
        check_cameras(path, found)
        cameras.update(found)

    checks: dict[str, Callable[[Path, Any], None]] = {
        "cameras": check_and_keep,
        "images": lambda path, found: _check_images_of_stock(path, found, cameras),
        "points3D": lambda path, found: None,
    }
    kept = {}
    for name, check in ((f"read_{what}_{kind}", checks[what]) for what in checks for kind in ("text", "binary")):
        kept[name] = getattr(reader, name)
        setattr(reader, name, functools.cache(functools.partial(_read, kept[name], check)))
    try:
        yield
    finally:
        for name, original in kept.items():
            setattr(reader, name, original)


def _check_images_of_stock(path: Path, images: dict[int, Any], cameras: dict[int, Any]) -> None:
    check_images(path, images, cameras)
    for number, image in images.items():
        if not leads_inside(image.name):
            fail(
                f"{path}, image {number}: the name {image.name!r} leads elsewhere than to a file in the folder: "
                "correct it, or read the capture with `bitymi-data`, the default, which looks for the photograph there."
            )
    centers = [-(reader.qvec2rotmat(each.qvec / np.linalg.norm(each.qvec)).T @ each.tvec) for each in images.values()]
    warn_of_far_off(path, np.array(centers))


def _read(original: Callable[[Path], Any], check: Callable[[Path, Any], None], path: Path) -> Any:
    with reading(path):
        found = original(path)
    check(path, found)
    return found


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """While it lasts, a file of a model is read: errors name it."""
    try:
        yield
    except FileNotFoundError as error:
        fail(f"the COLMAP model lacks {path}. Copy the whole model: cameras, images and points3D.", error)
    except (struct.error, ValueError, LookupError, AssertionError, MemoryError, OverflowError) as error:
        what = "is cut off or damaged" if path.suffix == ".bin" else f"has a line that cannot be read ({error})"
        hint = " Each image has two lines; the second, of its 2D points, may be empty." * (path.name == "images.txt")
        fail(f"{path} {what}.{hint} Copy the model again, or write it anew from COLMAP.", error)


@functools.cache
def parameter_count(model: str) -> int | None:
    """How many parameters a camera model of COLMAP has; None where COLMAP has no such model."""
    if model not in pycolmap.CameraModelId.__members__ or model == "INVALID":
        return None
    return len(pycolmap.Camera.create_from_model_name(1, model, 1.0, 1, 1).params)


def check_cameras(path: Path, cameras: dict[int, Any]) -> None:
    """Stop at a camera whose parameters are no numbers, or do not go with its camera model."""
    for number, camera in cameras.items():
        count = parameter_count(camera.model)
        numbers = [camera.width, camera.height, *camera.params]
        if not np.isfinite(numbers).all() or min(camera.width, camera.height) < 1:
            written = " ".join(f"{value:g}" for value in numbers)
            fail(
                f"{path}{_line_of(path, number)}: camera {number} ({camera.model} {written}) cannot be used: its size "
                "has to be positive and all numbers finite. Correct it, or write the model anew from COLMAP."
            )
        if count is not None and len(camera.params) != count:
            fail(
                f"{path}: camera {number} has {len(camera.params)} parameters, but a {camera.model} has {count}. "
                "Correct its line."
            )


def _line_of(path: Path, number: int) -> str:
    """Words on where a text file states the camera or image of a number; empty for a binary one."""
    if path.suffix != ".txt":
        return ""
    with open(path, encoding="utf8", errors="replace") as file:
        lines = [i for i, line in enumerate(file, 1) if line.split()[:1] == [str(number)]]
    return f", line {lines[0]}" if lines else ""


def check_images(path: Path, images: dict[int, Any], cameras: dict[int, Any]) -> None:
    """Stop at images that have no pose, or no camera of the model."""
    if not images:
        fail(f"{path} lists no images: COLMAP found no poses. Give another model with `--colmap-path` after `colmap`.")
    for number, image in images.items():
        if cameras and image.camera_id not in cameras:
            fail(
                f"{path}: image {number} ({image.name}) was taken by camera {image.camera_id}, but the model has only "
                f"{listed(sorted(cameras))}. Correct its line, or copy the whole model again."
            )
        if not np.isfinite([*image.qvec, *image.tvec]).all() or not image.qvec.any():
            fail(
                f"{path}{_line_of(path, number)}: the pose of image {number} ({image.name}) is not finite, or its "
                "rotation is zero. Correct its line or remove the image."
            )
