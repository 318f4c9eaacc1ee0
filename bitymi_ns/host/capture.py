"""Checks of a capture before nerfstudio reads it, and its errors in plain words."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanagerConfig
from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig
from nerfstudio.data.dataparsers.instant_ngp_dataparser import InstantNGPDataParserConfig
from nerfstudio.data.dataparsers.minimal_dataparser import MinimalDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.data.dataparsers.sdfstudio_dataparser import SDFStudioDataParserConfig
from nerfstudio.utils.rich_utils import CONSOLE

from bitymi_ns.host.errors import fail

HOW_TO_GET_ONE = "Make one from photographs with `ns-process-data images --data <photos> --output-dir <capture>`."


def check_capture(config: FullImageDatamanagerConfig) -> None:
    """Stop with a clear message when there is no usable capture where the configuration points."""
    dataparser = config.dataparser
    data = Path(config.data if config.data is not None else dataparser.data)
    if not data.exists():
        fail(f"the capture {data} does not exist. Give its folder with --data. {HOW_TO_GET_ONE}")
    if isinstance(dataparser, NerfstudioDataParserConfig):
        _check_transforms(data, dataparser)


def _check_transforms(data: Path, dataparser: NerfstudioDataParserConfig) -> None:
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
    points = meta.get("ply_file_path")
    if points is not None and dataparser.load_3D_points and not (folder / points).is_file():
        fail(
            f"{path} names the point cloud {folder / points}, which does not exist. Put it there, or remove "
            "ply_file_path to start from random points."
        )
    if points is None and dataparser.load_3D_points and (folder / "colmap/sparse/0").is_dir() and not _interactive():
        # nerfstudio would ask whether to convert the COLMAP points and wait for an answer for ever
        CONSOLE.print(
            f"[bold yellow]{path} has no ply_file_path: its COLMAP points are not used and training starts from "
            "random points. Run once in a terminal to convert them."
        )
        dataparser.load_3D_points = False


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
    except (AssertionError, OSError, LookupError, ValueError, TypeError, ArithmeticError, RuntimeError) as error:
        data = config.data if config.data is not None else config.dataparser.data
        detail = " ".join(str(error).split()) or type(error).__name__
        if isinstance(error, KeyError):
            detail = f"the entry {detail} is missing"
        fail(f"the capture {data} cannot be loaded: {detail}", error)
