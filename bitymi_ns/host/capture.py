"""Checks of a capture before nerfstudio reads it, and its errors in plain words."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanagerConfig
from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig
from nerfstudio.data.dataparsers.blender_dataparser import BlenderDataParserConfig
from nerfstudio.data.dataparsers.instant_ngp_dataparser import InstantNGPDataParserConfig
from nerfstudio.data.dataparsers.minimal_dataparser import MinimalDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.data.dataparsers.sdfstudio_dataparser import SDFStudioDataParserConfig

from bitymi_ns.host.errors import fail, warn
from bitymi_ns.host.point_cloud import what_is_wrong_with

HOW_TO_GET_ONE = "Make one from photographs with `ns-process-data images --data <photos> --output-dir <capture>`."


def check_capture(config: FullImageDatamanagerConfig, images: bool = True) -> None:
    """Stop with a clear message when there is no usable capture where the configuration points.

    Args:
        config: the data manager's.
        images: the photographs are needed, too.
    """
    dataparser = config.dataparser
    data = Path(config.data if config.data is not None else dataparser.data)
    if not data.exists():
        fail(f"the capture {data} does not exist. Give its folder with --data. {HOW_TO_GET_ONE}")
    if isinstance(dataparser, NerfstudioDataParserConfig):
        _check_transforms(data, dataparser, images)
    elif isinstance(dataparser, BlenderDataParserConfig) and dataparser.ply_path is not None:
        _check_cloud(data / dataparser.ply_path, "leave --ply-path out")


def _check_transforms(data: Path, dataparser: NerfstudioDataParserConfig, images: bool) -> None:
    path = data if data.suffix == ".json" else data / "transforms.json"
    if not path.is_file():
        if not data.is_dir():
            fail(f"{data} is neither a folder nor a transforms.json")
        if not any(data.iterdir()):
            fail(f"the capture folder {data} is empty. {HOW_TO_GET_ONE}")
        fail(
            f"{data} holds no transforms.json. {HOW_TO_GET_ONE} A capture in another format needs its parser's name "
            "after the options, for example `... colmap --data <capture>` or `... blender-data --data <capture>`."
        )
    try:
        meta = json.loads(path.read_text("utf8"))
    except (ValueError, OSError) as error:
        fail(f"{path} cannot be read: {error}. {HOW_TO_GET_ONE}", error)
    frames = meta.get("frames") if isinstance(meta, dict) else None
    if not isinstance(frames, list) or not frames:
        fail(f"{path} lists no frames: the capture has no images with poses. {HOW_TO_GET_ONE}")
    if len(frames) == 1:
        fail(f"{path} has one image only. A scene cannot be learned from one view: take photographs from more sides.")
    for i, frame in enumerate(frames):
        if not isinstance(frame, dict) or not {"file_path", "transform_matrix"} <= frame.keys():
            fail(f"{path}: frame {i} has no file_path or no transform_matrix")
    folder = path.parent
    if images and dataparser.downscale_factor is None:  # else copies of another size are read
        check_images([folder / str(frame["file_path"]) for frame in frames])
    _check_poses(path, frames, dataparser)
    points = meta.get("ply_file_path")
    if points is not None and dataparser.load_3D_points:
        _check_cloud(folder / points, f"remove ply_file_path from {path}")
    if points is None and dataparser.load_3D_points and (folder / "colmap/sparse/0").is_dir() and not _interactive():
        # nerfstudio would ask whether to convert the COLMAP points and wait for an answer for ever
        warn(
            f"{path} has no ply_file_path: its COLMAP points are not used and training starts from "
            "random points. Run once in a terminal to convert them."
        )
        dataparser.load_3D_points = False


def check_images(paths: Sequence[Path]) -> None:
    """Stop when images that the capture has poses for are not there."""
    names = list(dict.fromkeys(paths))
    missing = [path for path in names if not path.is_file()]
    if missing:
        some = "\n  ".join(str(path) for path in missing[:3])
        fail(
            f"{len(missing)} of {len(names)} images of the capture are missing:\n  {some}\n"
            "Poses without images cannot be used: copy the images there or remove the frames."
        )


def _check_poses(path: Path, frames: list[dict[str, Any]], dataparser: NerfstudioDataParserConfig) -> None:
    """Stop at poses that nerfstudio would spread over all others, or stumble over."""
    places = []
    for frame in frames:
        try:
            pose = np.asarray(frame["transform_matrix"], dtype=np.float64)
        except (ValueError, TypeError):
            pose = np.zeros(0)
        if pose.shape not in ((3, 4), (4, 4)) or not np.isfinite(pose).all():
            fail(
                f"{path}: the transform_matrix of {frame['file_path']} is not a matrix of 4 x 4 finite numbers. "
                "Correct it or remove the frame."
            )
        places.append(pose[:3, 3])
    if dataparser.auto_scale_poses and not np.ptp(places, axis=0).any():
        fail(f"{path}: all cameras are at one place. Depth cannot be learned: take photographs from different places.")


def _check_cloud(cloud: Path, way_out: str) -> None:
    wrong = what_is_wrong_with(cloud) if cloud.is_file() else "does not exist"
    if wrong is not None:
        fail(f"the point cloud {cloud} {wrong}. Put it there again, or {way_out} to start from random points.")


def check_cameras(cameras: Cameras, names: Sequence[Path]) -> None:
    """Stop at cameras through which nothing can be seen."""
    for what, wrong in (
        ("its pose is not finite", ~cameras.camera_to_worlds.isfinite().flatten(1).all(1)),
        (
            "its focal lengths are not positive and finite",
            ~((cameras.fx > 0) & (cameras.fy > 0) & (cameras.fx + cameras.fy < 1e12)),
        ),
        ("its principal point is not finite", ~(cameras.cx + cameras.cy).isfinite()),
        ("its image size is not positive", (cameras.width < 1) | (cameras.height < 1)),
    ):
        if bool(wrong.any()):
            fail(
                f"the camera of {names[int(wrong.flatten().nonzero()[0])]} cannot be used: {what}. Correct the capture."
            )


def _interactive() -> bool:
    return sys.stdin is not None and sys.stdin.isatty()


def declares_box(dataparser: DataParserConfig) -> bool:
    """Whether the capture itself states the box that holds its scene. Other parsers' boxes are defaults of nerfstudio,
    which say nothing about the capture."""
    if isinstance(dataparser, (MinimalDataParserConfig, SDFStudioDataParserConfig)):
        return True
    if isinstance(dataparser, InstantNGPDataParserConfig):
        path = dataparser.data if dataparser.data.suffix == ".json" else dataparser.data / "transforms.json"
        return "aabb_scale" in json.loads(path.read_text("utf8"))
    return False


@contextmanager
def reporting_input_errors(config: Any) -> Iterator[None]:
    """Errors of nerfstudio's loaders as one clear message."""
    try:
        yield
    except ImportError as error:
        fail(
            f"nerfstudio's reader of this capture cannot be loaded: {error}. If that names a library (lib....so), "
            "install the system's package of it; if a module, install it with pip.",
            error,
        )
    except (AssertionError, OSError, LookupError, ValueError, TypeError, ArithmeticError, RuntimeError) as error:
        data = config.data if config.data is not None else config.dataparser.data
        detail = " ".join(str(error).split()) or type(error).__name__
        if isinstance(error, KeyError):
            detail = f"the entry {detail} is missing"
        fail(f"the capture {data} cannot be loaded: {detail}", error)
