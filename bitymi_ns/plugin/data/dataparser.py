"""`bitymi-data`, the methods' default parser: reads a folder or file of any format as views, and splits these by one
rule for all formats."""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import tyro
from nerfstudio.data.dataparsers.base_dataparser import DataParser, DataParserConfig, DataparserOutputs
from nerfstudio.utils.colors import get_color

from bitymi_ns.capture import splits
from bitymi_ns.capture.colmap_views import Source
from bitymi_ns.capture.read import CaptureOptions, read_capture
from bitymi_ns.plugin.console import as_input_error
from bitymi_ns.plugin.data.depth import DepthKind
from bitymi_ns.plugin.data.views import make_views, select_views

_want_points: ContextVar[bool] = ContextVar("want_points", default=False)


@contextmanager
def reading_points(wanted: bool) -> Iterator[None]:
    """Read captures for a scene that starts from points, if `wanted`. Evaluation and the viewer spend no time on
    them."""
    token = _want_points.set(wanted)
    try:
        yield
    finally:
        _want_points.reset(token)


@dataclass
class BitymiDataParserConfig(CaptureOptions, DataParserConfig):
    """Reads what --data holds: a transforms.json of nerfstudio or instant-ngp, a COLMAP project, a Blender data set,
    an export of Polycam, Record3D, 3D Scanner App, Stray Scanner or an RGB-D camera, photographs, or a video."""

    _target: type = field(default_factory=lambda: BitymiDataParser)
    alpha_color: Literal["white", "black"] | None = "white"
    """Color behind the transparent pictures of a Blender data set; None = that of the method."""
    depth: DepthKind = "auto"
    """Depth of the photographs, where the capture has it: metric, or relative (scale and shift fitted to the points),
    as the points say (auto); off = neither depth nor normals are used."""
    depth_unit_scale_factor: float | None = None
    """Metres of a unit of depth; None = 0.001 for integers, 1 for floating-point numbers."""
    poses: tyro.conf.Suppress[Path | None] = None
    """Folder of the poses that an existing run was trained with. Not in the help: set where its data are read."""

    @as_input_error()
    def resolve_names(self) -> None:
        """Replace the name of a file of names by its content, so that config.yml stands on its own."""
        self.eval_names = splits.read_names(self.eval_names)


class BitymiDataParser(DataParser):
    """Views of a capture in any format.

    Attributes:
        downscale_factor: set by nerfstudio where photographs are not needed, so that none is opened; else None.
        poses_report: folder of the report on structure from motion, once the views are read; None = none.
        sfm_source: model by structure from motion, once the views are read; None = the capture came with its poses.
    """

    config: BitymiDataParserConfig

    def __init__(self, config: BitymiDataParserConfig) -> None:
        super().__init__(config)
        self.downscale_factor: int | None = None
        self.poses_report: Path | None = None
        self.sfm_source: Source | None = None

    @cached_property
    @as_input_error()
    def outputs(self) -> dict[str, DataparserOutputs]:
        """Outputs by split: train, val, test; read once."""
        need_photos, color = self.downscale_factor is None, self.config.alpha_color
        capture = read_capture(self.config, need_photos, _want_points.get())
        self.poses_report, self.sfm_source = capture.report, capture.model
        views = make_views(capture, need_photos)
        if capture.format == "blender" and color is not None:
            views.alpha_color = get_color(color)
        of = views.metadata["photographs"]
        parts = {name: set(part) for name, part in capture.parts.items()}
        return {name: select_views(views, [i for i, n in enumerate(of) if n in part]) for name, part in parts.items()}

    def _generate_dataparser_outputs(self, split: str = "train", **kwargs: Any) -> DataparserOutputs:
        return self.outputs[split]
