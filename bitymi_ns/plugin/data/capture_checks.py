"""Check a capture before time is spent on it, and report errors of nerfstudio's loaders."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from typing import Any

from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanagerConfig
from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig
from nerfstudio.data.dataparsers.blender_dataparser import BlenderDataParserConfig
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.data.dataparsers.instant_ngp_dataparser import InstantNGPDataParserConfig
from nerfstudio.data.dataparsers.minimal_dataparser import MinimalDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.data.dataparsers.sdfstudio_dataparser import SDFStudioDataParserConfig
from PIL import Image, UnidentifiedImageError

from bitymi_ns.capture.image_files import MAX_PIXELS
from bitymi_ns.capture.read import Capture, check_options
from bitymi_ns.capture.recognise import Format
from bitymi_ns.capture.transforms import HOW_TO_GET_ONE
from bitymi_ns.capture.types import CaptureError
from bitymi_ns.exit_messages import line_of
from bitymi_ns.safe_reading import read_json, why
from ..console import as_input_error, fail
from .dataparser import BitymiDataParserConfig
from .views import MOVED

STOCK_FORMATS: dict[type[DataParserConfig], Format] = {
    NerfstudioDataParserConfig: "nerfstudio",
    InstantNGPDataParserConfig: "instant-ngp",
    BlenderDataParserConfig: "blender",
    ColmapDataParserConfig: "colmap",
}
"""nerfstudio's parsers that `bitymi-data` replaces."""
STOCK_IGNORED = ("_target", "depths_path", "max_2D_matches_per_3D_point",
                 "downscale_rounding_mode", "load_3D_points")  # fmt: skip
"""Their options that change nothing here, or are translated."""


def bitymi_parser(config: DataParserConfig) -> DataParserConfig:
    """Translate one of nerfstudio's parsers to `bitymi-data`, if that has its format and the options that are set."""
    format = STOCK_FORMATS.get(type(config))
    if format is None:
        return config
    ours = {option.name for option in fields(BitymiDataParserConfig)} - {"_target"}
    if format == "instant-ngp":
        ours -= {"scale_factor", "scene_scale"}  # there scene_scale multiplies the positions
    options, stock = {}, type(config)()
    for name in (option.name for option in fields(config)):
        value = getattr(config, name)
        if name in ours:
            options[name] = value
        elif name not in STOCK_IGNORED and value != getattr(stock, name):
            return config
    if not getattr(config, "load_3D_points", options.get("ply_path") is not None):
        options["points"] = "random"
    return BitymiDataParserConfig(format=format, **options)


@as_input_error()
def check_capture(config: FullImageDatamanagerConfig, trains: bool = True) -> None:
    """Check that there is a capture at the data manager's path, and prepare its parser; `trains`: with points. Raises
    InputError: there is none, or an option is out of range."""
    config.dataparser = dataparser = bitymi_parser(config.dataparser)
    data = Path(config.data if config.data is not None else dataparser.data)
    if not data.exists():
        advice = f"Correct --data. {HOW_TO_GET_ONE}" if trains else MOVED
        fail(f"the capture {data} does not exist. {advice}")
    check_options(dataparser, lambda name: f"--{name.replace('_', '-')}")
    if isinstance(dataparser, BitymiDataParserConfig):
        dataparser.data = data
        dataparser.prepare(points=trains)


@as_input_error()
def read_early(config: FullImageDatamanagerConfig) -> Capture | None:
    """Read a checked capture for a training if it comes with poses; else None."""
    if not isinstance(config.dataparser, BitymiDataParserConfig):
        return None
    parser = config.dataparser.prepare(points=True)
    if parser.found.format in ("photographs", "video"):
        return None
    with reporting_input_errors(config):
        _ = parser.outputs
    return parser.capture


def declares_box(dataparser: DataParserConfig) -> bool:
    """Test if a capture that nerfstudio's parser reads states its scene's box; else that is a default."""
    if isinstance(dataparser, InstantNGPDataParserConfig):
        path = dataparser.data if dataparser.data.suffix == ".json" else dataparser.data / "transforms.json"
        return "aabb_scale" in read_json(path)
    return isinstance(dataparser, (MinimalDataParserConfig, SDFStudioDataParserConfig))


@contextmanager
def reporting_input_errors(config: Any) -> Iterator[None]:
    """Report errors of nerfstudio's loaders in one line."""
    capture = f"the capture {config.data if config.data is not None else config.dataparser.data}"
    try:
        yield
    except ImportError as error:
        fail(f"nerfstudio's reader of this capture cannot be loaded: {error}. Install what is missing.", error)
    except Image.DecompressionBombError as error:
        fail(f"{capture} has a photograph of more than {MAX_PIXELS:,} pixels: make it smaller", error)
    except (CaptureError, NameError, AssertionError):  # clear, or no fault of the capture
        raise
    except Exception as error:
        detail = (isinstance(error, OSError) and line_of(error)) or why(error)
        if isinstance(error, UnidentifiedImageError):
            detail += ". Save the photographs as PNG or JPEG"
        fail(f"{capture} cannot be loaded: {detail}", error)
