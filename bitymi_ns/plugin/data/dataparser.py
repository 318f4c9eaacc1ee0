"""Parsers: `bitymi-data` reads a capture of any format; a bundle's cameras serve where the capture is gone."""

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import tyro
from nerfstudio.data.dataparsers.base_dataparser import DataParser, DataParserConfig, DataparserOutputs
from nerfstudio.utils.colors import get_color

from bitymi_ns.bundle import BundleError
from bitymi_ns.bundle.parts import CAMERAS
from bitymi_ns.bundle.read import read_cameras, read_manifest
from bitymi_ns.capture import splits
from bitymi_ns.capture.lens import Pinhole
from bitymi_ns.capture.read import Capture, CaptureOptions, read_capture
from bitymi_ns.capture.readings import WRITTEN
from bitymi_ns.capture.recognise import Found
from bitymi_ns.capture.types import OPENCV_AXES
from bitymi_ns.trust import inside
from ..console import as_input_error, fail
from .depth import DepthKind
from .facts import KEY, CaptureFacts
from .views import Views, make_views, pinhole_cameras


@dataclass
class BitymiDataParserConfig(CaptureOptions, DataParserConfig):
    """Parser of what --data holds: a transforms.json of nerfstudio or instant-ngp, a COLMAP project, a Blender data
    set, an export of Polycam, Record3D, 3D Scanner App, Stray Scanner or an RGB-D camera, photographs, or a video."""

    _target: type = field(default_factory=lambda: BitymiDataParser)
    alpha_color: Literal["white", "black"] | None = "white"
    """Color behind the transparent pictures of a Blender data set; None = that of the method."""
    depth: DepthKind = "auto"
    """Depth of the photographs: metric = one scale for all; relative = scale and shift of each, fitted to the points;
    auto = the one that agrees with the points; off = neither depth nor normals."""
    depth_unit_scale_factor: float | None = None
    """Metres per unit of depth; None = 0.001 for integers, 1 for floating-point numbers."""
    poses: tyro.conf.Suppress[Path | None] = None
    """Folder of the poses that a run was trained with; set where its data are read."""
    _parser: "BitymiDataParser | None" = field(default=None, init=False, repr=False, compare=False)

    def prepare(self, points: bool) -> "BitymiDataParser":
        """Make the parser that the next `setup` returns, unless there is one: a training reads its capture once, before
        its first file is written. `points`: read the points, too, for a scene that starts from them."""
        if self._parser is None or self._parser.points != points:
            self._parser = BitymiDataParser(self, points)
        return self._parser

    def setup(self, **kwargs: Any) -> "BitymiDataParser":
        parser, self._parser = self._parser or BitymiDataParser(self), None
        return parser

    def __getstate__(self) -> dict[str, Any]:
        """Return the options, for config.yml and copies."""
        return {name: value for name, value in vars(self).items() if name != "_parser"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Load a config.yml; one without poses_as is of a run that took the poses as written."""
        self.__dict__ |= {"poses_as": WRITTEN, **state}

    @as_input_error()
    def resolve_names(self) -> None:
        """Replace a file in `eval_names` by the names that it holds."""
        self.eval_names = splits.read_names(self.eval_names)


class BitymiDataParser(DataParser):
    config: BitymiDataParserConfig

    def __init__(self, config: BitymiDataParserConfig, points: bool = False) -> None:
        super().__init__(config)
        self.points = points
        self.downscale_factor: int | None = None  # set by nerfstudio where photographs are not needed

    @cached_property
    @as_input_error()
    def found(self) -> Found:
        return self.config.find()

    @cached_property
    def capture(self) -> Capture:
        return read_capture(self.config, self.downscale_factor is None, self.points, self.found)

    @cached_property
    @as_input_error()
    def outputs(self) -> dict[str, DataparserOutputs]:
        """Outputs by split: train, val, test."""
        color = self.config.alpha_color if self.capture.format == "blender" else None
        return make_views(self.capture, self.downscale_factor is None, None if color is None else get_color(color))

    def _generate_dataparser_outputs(self, split: str = "train", **kwargs: Any) -> DataparserOutputs:
        return self.outputs[split]


@dataclass
class BundleCamerasConfig(DataParserConfig):
    _target: type = field(default_factory=lambda: BundleCameras)
    data: Path = Path()  # Folder of the bundle.
    capture: Path = Path()  # Folder of the lost capture.
    gray: bool = False  # Photographs are grey, else refused.


class BundleCameras(DataParser):
    """Views with a bundle's cameras and without photographs."""

    config: BundleCamerasConfig
    downscale_factor = None  # set by nerfstudio

    def _generate_dataparser_outputs(self, split: str = "train", **kwargs: Any) -> DataparserOutputs:
        folder = Path(self.config.data)
        try:
            info, rows = read_manifest(folder), read_cameras(folder)
            files = {row.name: inside(Path(self.config.capture), row.name) for row in rows}
        except BundleError as error:
            fail(str(error), error)
        except ValueError as error:
            fail(f"{folder}, {CAMERAS}: {error}.", error)
        chosen = [row for row in rows if row.held_out == (split != "train")] or rows
        names, poses, pinholes = [files[row.name] for row in chosen], [], []
        for camera in (row.camera for row in chosen):
            poses.append((torch.linalg.inv(camera.viewmat.double()) @ torch.from_numpy(OPENCV_AXES)).float())
            fx, fy, cx, cy = camera.K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
            pinholes.append(Pinhole(fx, fy, cx, cy, camera.width, camera.height))
        return Views(
            image_filenames=names,
            cameras=pinhole_cameras(pinholes, torch.stack(poses)),
            dataparser_scale=float(info.world.scale),
            dataparser_transform=torch.tensor(np.asarray(info.world.transform, np.float64)[:3]),
            metadata={KEY: CaptureFacts(files=names, lost=True, gray=self.config.gray)},
        )


def has_cameras(bundle: Path) -> bool:
    """Test if a bundle states the cameras of its capture."""
    try:
        return bool(read_cameras(bundle))
    except BundleError as error:
        fail(str(error), error)
