"""Checks of a capture before nerfstudio reads it, and its errors in plain words."""

from __future__ import annotations

import math
import struct
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanagerConfig
from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig
from nerfstudio.data.dataparsers.blender_dataparser import BlenderDataParserConfig
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.data.dataparsers.instant_ngp_dataparser import InstantNGPDataParserConfig
from nerfstudio.data.dataparsers.minimal_dataparser import MinimalDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.data.dataparsers.sdfstudio_dataparser import SDFStudioDataParserConfig
from PIL import Image, UnidentifiedImageError

from bitymi_ns.capture.recognise import PHOTOGRAPHS, Found, models_in
from bitymi_ns.plugin.console import fail, warn
from bitymi_ns.plugin.data import transforms
from bitymi_ns.plugin.data.bundle_cameras import BundleCamerasConfig
from bitymi_ns.plugin.data.colmap import check_model, options_for
from bitymi_ns.plugin.data.colmap_model import read_model
from bitymi_ns.plugin.data.colmap_views import mask_files
from bitymi_ns.plugin.data.dataparser import SCANNED, BitymiDataParserConfig
from bitymi_ns.plugin.data.images import MOST_PIXELS, check_sizes
from bitymi_ns.plugin.data.point_cloud import point_count, what_is_wrong_with
from bitymi_ns.plugin.data.poses import check_spread
from bitymi_ns.plugin.data.scanner_views import scanned
from bitymi_ns.plugin.data.transforms import HOW_TO_GET_ONE
from bitymi_ns.plugin.data.transforms_views import missing_photographs
from bitymi_ns.plugin.run.commands import folder_being_evaluated, how_to_say_where
from bitymi_ns.trust import json_of


class Cloud(NamedTuple):
    """A capture's points, as far as they are known before they are read.

    Attributes:
        points: how many there are; 0 where that cannot be told.
        file: the PLY file that nerfstudio reads them from; None for other files.
    """

    points: int = 0
    file: Path | None = None


def check_capture(config: FullImageDatamanagerConfig, images: bool = True) -> Cloud:
    """Stop with a clear message when there is no usable capture where the configuration points.

    Args:
        config: the data manager's.
        images: the photographs are needed, too.
    """
    dataparser = config.dataparser
    data = Path(config.data if config.data is not None else dataparser.data)
    if not data.exists():
        made = "" if folder_being_evaluated() else f" {HOW_TO_GET_ONE}"
        fail(f"the capture {data} does not exist. {how_to_say_where()}{made}")
    if isinstance(dataparser, BundleCamerasConfig):
        return Cloud()
    _check_options(dataparser)
    if isinstance(dataparser, BitymiDataParserConfig):
        dataparser.data = data
        return _check_own(dataparser, dataparser.find(), images)
    if isinstance(dataparser, NerfstudioDataParserConfig):
        return _check_transforms(data, dataparser, images)
    if isinstance(dataparser, ColmapDataParserConfig):
        return Cloud(check_model(data, dataparser))
    if isinstance(dataparser, BlenderDataParserConfig) and dataparser.ply_path is not None:
        return _check_cloud(data / dataparser.ply_path, "leave --ply-path out")
    return Cloud()


def _check_options(dataparser: DataParserConfig) -> None:
    """Stop at options of nerfstudio's readers that leave no capture, by their names on the command line."""
    mode = getattr(dataparser, "eval_mode", None)
    for name, used, within, what in (
        ("scale_factor", True, lambda value: 0.0 < value < math.inf, "above 0"),
        ("downscale_factor", True, lambda value: value is None or value >= 1, "1 or more"),
        ("train_split_fraction", mode == "fraction", lambda value: 0.0 < value <= 1.0, "above 0 and at most 1"),
        ("eval_interval", mode == "interval", lambda value: value >= 1, "1 or more"),
    ):
        if used and hasattr(dataparser, name) and not within(value := getattr(dataparser, name)):
            fail(f"--{name.replace('_', '-')} is {value}, but has to be {what}. Correct it, or leave it out.")


def _check_own(dataparser: BitymiDataParserConfig, found: Found, images: bool) -> Cloud:
    """The same for what the methods' own parser reads."""
    if found.format in ("photographs", "video"):
        return Cloud()  # there are no poses yet
    if found.format in SCANNED:
        photographs = scanned(found, images)
        if images:
            check_sizes([photograph.file for photograph in photographs])
        return Cloud()
    own = dataparser.points == "auto"
    if found.format == "colmap":
        source = dataparser.source(found, images)
        model = read_model(source.folder)
        if images:
            check_images(source.files(model))
            mask_files(source, model)
        return Cloud(len(model.xyz) if own else 0)
    read = dataparser.transforms(found, "transforms_train.json", images, announce=False)
    if images:
        missing_photographs(read.path, read.photographs)
        check_sizes([photograph.file for photograph in read.photographs])
    if dataparser.auto_scale_poses and found.format == "nerfstudio":
        check_spread(np.array([photograph.pose[:3, 3] for photograph in read.photographs]), str(read.path))
    if found.format == "blender":
        name, way_out = dataparser.ply_path, "leave --ply-path out"
    else:
        name, way_out = read.meta.get("ply_file_path"), f"remove ply_file_path from {read.path}"
    if not own or name is None:
        return Cloud()
    if isinstance(name, str) and not name or not isinstance(name, (str, Path)):
        fail(f"{read.path}: ply_file_path is {name!r}, not the name of a file. Correct it or remove it.")
    return Cloud(_check_cloud(found.folder / name, way_out).points)


def _check_transforms(data: Path, dataparser: NerfstudioDataParserConfig, images: bool) -> Cloud:
    path = data if data.suffix == ".json" else data / "transforms.json"
    if not path.is_file():
        if not data.is_dir():
            fail(f"{data} is neither a folder nor a transforms.json")
        if not any(data.iterdir()):
            fail(f"the capture folder {data} is empty. {HOW_TO_GET_ONE}")
        fail(f"{data} holds no transforms.json. {_what_it_is(data)}")
    meta = transforms.load(path, own_format=True, announce=False)
    frames = meta["frames"]
    folder = path.parent
    if images and dataparser.downscale_factor is None:  # else copies of another size are read
        check_images([folder / frame["file_path"] for frame in frames])
    places = np.array([frame["transform_matrix"] for frame in frames])[:, :3, 3]
    if dataparser.auto_scale_poses:
        check_spread(places, str(path))
    if not dataparser.load_3D_points:
        return Cloud()
    points = meta.get("ply_file_path")
    if points is not None:
        if not isinstance(points, str) or not points:
            fail(f"{path}: ply_file_path is {points!r}, not the name of a file. Correct it or remove it.")
        return _check_cloud(folder / points, f"remove ply_file_path from {path}")
    if (folder / "colmap/sparse/0").is_dir() and not _interactive():
        # nerfstudio would ask whether to convert the COLMAP points and wait for an answer for ever
        warn(
            f"{path} has no ply_file_path: its COLMAP points are not used and training starts from "
            "random points. Run once in a terminal to convert them."
        )
        dataparser.load_3D_points = False
    return Cloud()


def _what_it_is(data: Path) -> str:
    """What to do with a folder that has no transforms.json, by what lies in it."""
    models = models_in(data)
    if models:
        return f"It has a COLMAP model: give `{options_for(data, models[0])}` after the options of the method."
    if (data / "transforms_train.json").is_file():
        return f"It has a transforms_train.json: give `blender-data --data {data}` after the options of the method."
    photos = {p.parent for pattern in ("*", "*/*") for p in data.glob(pattern) if p.suffix.lower() in PHOTOGRAPHS}
    if photos:
        return (
            "It has photographs without poses. Find the poses with "
            f"`ns-process-data images --data {min(photos)} --output-dir <capture>` and train on that."
        )
    return (
        f"{HOW_TO_GET_ONE} A capture in another format needs its parser's name after the options, for example "
        "`... colmap --data <capture>` or `... blender-data --data <capture>`."
    )


def check_images(paths: Sequence[Path]) -> None:
    """Stop when images that the capture has poses for are not there, or beyond all sizes."""
    names = list(dict.fromkeys(paths))
    missing = [path for path in names if not path.is_file()]
    if not missing:
        check_sizes(names)
        return
    some = "\n  ".join(f"{path}{_instead(path)}" for path in missing[:3])
    fail(
        f"{len(missing)} of {len(names)} images of the capture are missing:\n  {some}\n"
        "Poses without images cannot be used: copy the images there, correct the names or remove the frames."
    )


def _instead(path: Path) -> str:
    """What lies in a missing file's place."""
    if path.is_symlink():
        return " (a link to nothing)"
    if path.exists():
        return " (not a file)"
    same = {path.name.lower(), path.stem.lower()}
    others = [p for p in path.parent.glob("*") if p.name.lower() == path.name.lower() or p.stem.lower() in same]
    return f" (but there is {min(others).name})" if others else ""


def _check_cloud(file: Path, way_out: str) -> Cloud:
    wrong = what_is_wrong_with(file) if file.is_file() else "does not exist"
    if wrong is not None:
        fail(f"the point cloud {file} {wrong}. Put it there again, or {way_out} to start from random points.")
    return Cloud(point_count(file), file)


def _interactive() -> bool:
    return sys.stdin is not None and sys.stdin.isatty()


def declares_box(dataparser: DataParserConfig) -> bool:
    """Whether the capture itself states the box that holds its scene. Other parsers' boxes are defaults of nerfstudio,
    which say nothing about the capture."""
    if isinstance(dataparser, BitymiDataParserConfig):
        found = dataparser.find()
        return found.format == "instant-ngp" and "aabb_scale" in json_of(found.path.read_bytes())
    if isinstance(dataparser, (MinimalDataParserConfig, SDFStudioDataParserConfig)):
        return True
    if isinstance(dataparser, InstantNGPDataParserConfig):
        path = dataparser.data if dataparser.data.suffix == ".json" else dataparser.data / "transforms.json"
        return "aabb_scale" in json_of(path.read_bytes())
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
    except EOFError as error:
        fail(
            f"the capture {_folder_of(config)} has no reduced photographs, and nerfstudio's question whether to make "
            "them found nobody to answer it. Give `--downscale-factor 1` after the parser's name (`colmap`) to read "
            "the photographs as they are, or run once in a terminal and answer.",
            error,
        )
    except Image.DecompressionBombError as error:  # nerfstudio looks into one photograph before they are checked
        fail(
            f"the capture {_folder_of(config)} has a photograph of more than {MOST_PIXELS:,} pixels: make it smaller",
            error,
        )
    except (
        AssertionError,
        OSError,
        LookupError,
        ValueError,
        TypeError,
        AttributeError,
        ArithmeticError,
        RuntimeError,
        struct.error,
    ) as error:
        detail = " ".join(str(error).split()).rstrip(".") or type(error).__name__
        if isinstance(error, KeyError):
            detail = f"the entry {detail} is missing"
        if isinstance(error, UnidentifiedImageError):
            detail += ". Save the photographs as PNG or JPEG"
        fail(f"the capture {_folder_of(config)} cannot be loaded: {detail}", error)


def _folder_of(config: Any) -> Any:
    return config.data if config.data is not None else config.dataparser.data
