"""`bitymi-data`, the methods' default parser: recognizes the format of a folder or file, reads it as photographs with
cameras and poses, and splits these by one rule for all formats."""

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import tyro
from nerfstudio.data.dataparsers.base_dataparser import DataParser, DataParserConfig, DataparserOutputs
from nerfstudio.utils.colors import get_color

from bitymi_ns.capture.frame import read_frame
from bitymi_ns.capture.recognise import Format, Found, NotRecognised, recognise
from bitymi_ns.capture.types import SfmSettings
from bitymi_ns.plugin.console import fail, listed, say, warn
from bitymi_ns.plugin.data import splits
from bitymi_ns.plugin.data.colmap_model import read_model
from bitymi_ns.plugin.data.colmap_views import (
    TO_NERFSTUDIO,
    Source,
    find_source,
    model_photographs,
    model_points,
    warn_of_left_out,
)
from bitymi_ns.plugin.data.depth import DepthKind
from bitymi_ns.plugin.data.find_files import check_photographs_exist, name_unused
from bitymi_ns.plugin.data.initial_points import (
    COLMAP_CONVENTIONS,
    JSON_CONVENTIONS,
    Choice,
    check_conventions,
    initial_points,
    points_wanted,
    read_colored_points,
    with_colors,
)
from bitymi_ns.plugin.data.mask_files import check_masks, with_masks
from bitymi_ns.plugin.data.scanner_views import scanner_photographs
from bitymi_ns.plugin.data.sfm_poses import KeptPoses, find_sfm_source, kept_source, read_kept_poses
from bitymi_ns.plugin.data.splits import NameLists, Split
from bitymi_ns.plugin.data.transforms import applied_transform, check_number, colmap_points
from bitymi_ns.plugin.data.transforms_views import Transforms, read_transforms
from bitymi_ns.plugin.data.views import (
    FrameOptions,
    Orientation,
    Photograph,
    Views,
    fit_scale,
    make_views,
    photograph_files,
    select_views,
)

WITH_MODEL = ("colmap", "photographs", "video")  # formats that are read as a COLMAP model
SCANNED = ("polycam", "record3d", "3d-scanner", "stray-scanner", "pose-files")  # with poses of scanners
OPTION_FORMATS: dict[str, tuple[str, ...]] = {
    "colmap_path": ("colmap",),
    "images_path": ("colmap",),
    "masks_path": ("colmap", "photographs"),
    "ply_path": ("blender",),
    "alpha_color": ("blender",),
    "scene_scale": ("nerfstudio", *WITH_MODEL, *SCANNED),
    "orientation_method": ("nerfstudio", *WITH_MODEL, *SCANNED),
    "center_method": ("nerfstudio", *WITH_MODEL, *SCANNED),
    "auto_scale_poses": ("nerfstudio", *WITH_MODEL, *SCANNED),
    "scale_factor": ("nerfstudio", *WITH_MODEL, *SCANNED, "blender"),
    "eval_names": ("nerfstudio", "instant-ngp", *WITH_MODEL, *SCANNED),
    "sfm": ("photographs", "video"),
}
"""Formats that an option is for, where that is not all of them."""
NGP_SCALE = 0.3333  # factor on positions of instant-ngp's captures, as in nerfstudio's reader
BLENDER_SIDE = 1.5  # half the side of the box of a Blender data set, as in nerfstudio's reader


@dataclass
class BitymiDataParserConfig(FrameOptions, DataParserConfig):
    """Reads what --data holds: a transforms.json of nerfstudio or instant-ngp, a COLMAP project, a Blender data set,
    an export of Polycam, Record3D, 3D Scanner App, Stray Scanner or an RGB-D camera, photographs, or a video."""

    _target: type = field(default_factory=lambda: BitymiDataParser)
    data: Path = Path()
    """Folder, or file: transforms.json or video."""
    format: Format | Literal["auto"] = "auto"
    """Format to read where there are several; auto = one with poses before one without."""
    downscale_factor: int | None = None
    """Use photographs that are smaller by this factor: those in images_2, images_4, ... where that folder exists."""
    images_path: Path | None = None
    """Folder of the photographs of a COLMAP model, relative to --data; None = find it."""
    masks_path: Path | None = None
    """Folder of masks for a COLMAP model or photographs, relative to --data; None = `masks` beside the photographs, in
    their folder or in that of the data."""
    use_masks: bool = True
    """Use the masks of the capture: those that it names, or those beside its photographs."""
    colmap_path: Path | None = None
    """Folder of the COLMAP model, relative to --data; None = find it."""
    ply_path: Path | None = None
    """Points of a Blender data set, a PLY file relative to --data; None = see --points."""
    alpha_color: Literal["white", "black"] | None = "white"
    """Color behind the transparent pictures of a Blender data set; None = that of the method."""
    points: Choice = "auto"
    """Points to start from: those of the capture, triangulated ones where it has none (auto); triangulated ones in any
    case; or random ones."""
    depth: DepthKind = "auto"
    """Depth of the photographs, where the capture has it: metric, or relative (scale and shift fitted to the points),
    as the points say (auto); off = neither depth nor normals are used."""
    depth_unit_scale_factor: float | None = None
    """Metres of a unit of depth; None = 0.001 for integers, 1 for floating-point numbers."""
    eval_mode: Literal["fraction", "filename", "interval", "all"] = "interval"
    """Photographs to hold out: evenly spaced ones, those with eval in their names, every n-th, or none (all are used
    for both)."""
    eval_interval: int = 8
    """Hold out every n-th photograph by name, with --eval-mode interval."""
    train_split_fraction: float = 0.9
    """Share of the photographs to train on, with --eval-mode fraction."""
    eval_names: tuple[str, ...] = ()
    """Names of photographs to hold out, or a text file (.txt) with one per line; overrides --eval-mode."""
    sfm: SfmSettings = SfmSettings()  # noqa: RUF009 - it is frozen
    """Structure from motion for photographs and videos."""
    poses: tyro.conf.Suppress[Path | None] = None
    """Folder of the poses that an existing run was trained with. Not in the help: set where its data are read."""

    def find(self) -> Found:
        """Recognize what there is to read.

        Raises:
            InputError: nothing, or an option is for another format.
        """
        kept = self.kept()
        try:
            found = recognise(Path(self.data), self.format, self.colmap_path) if kept is None else kept.found(self.data)
        except NotRecognised as error:
            fail(str(error), error)
        for name, formats in OPTION_FORMATS.items():
            default = type(self).__dataclass_fields__[name].default
            if found.format not in formats and getattr(self, name) != default:
                fail(
                    f"--{name.replace('_', '-')} is not for {found.path}, which is read as {found.format}, but for "
                    f"{', '.join(formats)}. Leave it out, or give --format."
                )
        return found

    def kept(self) -> KeptPoses | None:
        """Read the poses that the run was trained with; None = it keeps none."""
        return None if self.poses is None else read_kept_poses(Path(self.poses))

    def resolve_names(self) -> None:
        """Replace the name of a file of names by its content, so that config.yml stands on its own."""
        self.eval_names = splits.read_names(self.eval_names)

    def transforms(self, found: Found, name: str, need_photos: bool) -> Transforms:
        """Read a JSON file of a nerfstudio, instant-ngp or Blender capture; `name` of the file for the latter. See
        `read_transforms`."""
        path = found.folder / name if found.format == "blender" else found.path
        own_format, downscale = found.format == "nerfstudio", self.downscale_factor or 1
        return read_transforms(path, own_format, downscale, need_photos, self.use_masks)

    def source(self, found: Found, need_photos: bool = True) -> Source:
        """Find the COLMAP model and its photographs, by structure from motion for photographs without poses."""
        source = self._source(found, need_photos)
        return source if self.use_masks else replace(source, masks=None)

    def _source(self, found: Found, need_photos: bool) -> Source:
        downscale = self.downscale_factor or 1
        if found.format == "colmap":
            return find_source(found.path, found.folder, self.images_path, self.masks_path, downscale, need_photos)
        kept = self.kept()
        if kept is not None:
            return kept_source(found, kept, self.masks_path, downscale, need_photos)
        if self.poses is not None:
            warn(f"The poses that the run was trained with are no longer in {self.poses}: others can be found now.")
        return find_sfm_source(found, self.masks_path, downscale, self.sfm, self.use_masks)


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
    def outputs(self) -> dict[str, DataparserOutputs]:
        """Outputs by split: train, val, test; read once."""
        found = self.config.find()
        if found.unread:
            named = listed([f"{path.name} ({program})" for path, program in found.unread])
            warn(
                f"{found.folder} holds poses that cannot be read: {named}. Poses are computed from the photographs. "
                "To have those used, export a COLMAP model, or convert them with `ns-process-data`."
            )
        if found.format == "blender":
            return self._blender(found)
        self.poses_report = None if read_frame(found.folder) is None else found.folder
        readers = dict.fromkeys(WITH_MODEL, self._colmap) | dict.fromkeys(SCANNED, self._scanned)
        views, lists = readers.get(found.format, self._transforms)(found)
        return self._split(views, lists)

    def _split(self, views: DataparserOutputs, lists: NameLists) -> dict[str, DataparserOutputs]:
        config = self.config
        photographs: list[int] = views.metadata["photographs"]
        names = list(dict(zip(photographs, photograph_files(views), strict=True)).values())
        frames = list(dict(zip(photographs, views.metadata["frames"], strict=True)).values())
        if config.eval_names:
            split = splits.by_names(names, config.eval_names, "--eval-names")
            held = {frames[i] for i in split.held_out}
            split = splits.of_members(Split(sorted(set(frames) - held), sorted(held), split.rule), frames)
        elif lists:
            split = splits.by_lists(names, lists)
        else:
            first = sorted(set(frames))
            of_first = [names[i] for i in first]
            split = splits.by_mode(of_first, config.eval_mode, config.eval_interval, config.train_split_fraction)
            sides = ([first[i] for i in side] for side in (split.train, split.held_out))
            split = splits.of_members(Split(*sides, split.rule), frames)
        say(split.describe(names))
        of_views = splits.of_members(split, photographs)
        train, held_out = (select_views(views, some) for some in (of_views.train, of_views.held_out))
        return {"train": train, "val": held_out, "test": held_out}

    def _generate_dataparser_outputs(self, split: str = "train", **kwargs: Any) -> DataparserOutputs:
        return self.outputs[split]

    @property
    def _need_photos(self) -> bool:
        return self.downscale_factor is None

    def _transforms(self, found: Found) -> tuple[Views, NameLists]:
        """Read all views of a transforms.json, and its lists of names."""
        config, need_photos = self.config, self._need_photos
        read = config.transforms(found, "", need_photos)
        if need_photos:
            check_photographs_exist(read.path, read.files)
            check_masks(read.photographs)
        meta, frame = read.meta, config
        if found.format == "instant-ngp":  # whose scale is that of its bounding box
            half = 0.5 * check_number(read.path, "aabb_scale", meta.get("aabb_scale", 1), "for all frames")
            if not 0.0 < half < math.inf:
                fail(f"{read.path}: aabb_scale is {meta['aabb_scale']}, which is no positive number. Correct it.")
            frame = FrameOptions(NGP_SCALE, "none", "none", auto_scale_poses=False, scene_scale=half)
            frame = fit_scale(frame, read.photographs, str(read.path))
        elif "orientation_override" in meta:
            if meta["orientation_override"] not in get_args(Orientation):
                allowed = ", ".join(get_args(Orientation))
                fail(f"{read.path}: orientation_override is {meta['orientation_override']!r}, none of {allowed}.")
            frame = replace(frame, orientation_method=meta["orientation_override"])
            say(f"{read.path} asks for the orientation method {frame.orientation_method}.")
        model = colmap_points(found.path)
        applied = applied_transform(meta, found.folder)
        what = f"{found.path} ({found.format}, {len(read.photographs)} photographs)"
        own = None
        if config.points == "auto":
            if "ply_file_path" in meta:
                hint = f"remove ply_file_path from {read.path}"
                own = read_colored_points(found.folder / meta["ply_file_path"], hint, read.photographs)
            elif model is not None:
                own = model_points(read_model(model), np.eye(4) if applied is None else applied)
                own = with_colors(own, read_model(model).without_colors, read.photographs, model)
                what += f", points of {model}"
        self._report(found, what)
        if need_photos:
            name_unused(found.folder, read.named, config.downscale_factor)
        if own is not None and need_photos and points_wanted():
            check_conventions(own, read.photographs, JSON_CONVENTIONS, str(found.path))
        views = make_views(
            read.photographs,
            frame,
            initial_points(own, config.points, read.photographs, found.folder, str(found.path)),
            str(found.path),
            config.downscale_factor or 1,
            need_photos,
            applied=applied,
            applied_scale=float(meta.get("applied_scale", 1.0)),
        )
        return views, read.lists

    def _colmap(self, found: Found) -> tuple[Views, NameLists]:
        """Read all views of a COLMAP model, and the lists of names beside it."""
        config, need_photos = self.config, self._need_photos
        source = config.source(found, need_photos)
        self.poses_report = source.report or self.poses_report
        self.sfm_source = None if source.origin is None else source
        model = source.model
        if need_photos and found.format == "colmap":
            check_photographs_exist(found.path, source.files())
        self._report(found, source.describe())
        named = warn_of_left_out(source) if need_photos else set()
        photographs, where = model_photographs(source, need_photos), str(source.folder)
        if need_photos:
            check_masks(photographs)
        if need_photos and found.format == "colmap":
            name_unused(found.folder, {*named, *(each.mask for each in photographs)}, config.downscale_factor)
        own = model_points(model, TO_NERFSTUDIO)
        if need_photos and points_wanted() and config.points == "auto":
            own = with_colors(own, model.without_colors, photographs, source.folder)
            check_conventions(own, photographs, COLMAP_CONVENTIONS, where, TO_NERFSTUDIO)
        points = initial_points(own, config.points, photographs, found.folder, where)
        views = make_views(photographs, config, points, where, source.downscale, need_photos, applied=TO_NERFSTUDIO)
        return views, splits.list_files(found.folder)

    def _scanned(self, found: Found) -> tuple[Views, NameLists]:
        """Read all views of a scanning program."""
        config, need_photos = self.config, self._need_photos
        photographs = scanner_photographs(found, need_photos)
        self._report(found, f"{found.path} ({found.format}, {len(photographs)} photographs with their poses)")
        if need_photos:
            if config.use_masks:
                photographs = with_masks(photographs, found.folder)
            check_masks(photographs)
            name_unused(found.folder, {file for each in photographs for file in (each.file, each.mask)})
        points = initial_points(None, config.points, photographs, found.folder, str(found.path))
        downscale = config.downscale_factor or 1
        return make_views(photographs, config, points, str(found.path), downscale, need_photos), {}

    def _blender(self, found: Found) -> dict[str, DataparserOutputs]:
        """Read the capture's own split. Where one of its two files of held-out views is missing, or all its photographs
        are, the other stands for it; where both are, training views are held out."""
        config, need_photos = self.config, self._need_photos
        train = config.transforms(found, "transforms_train.json", need_photos)
        if need_photos:
            check_photographs_exist(train.path, train.files)
        parts: dict[str, list[Photograph]] = {"train": train.photographs}
        named = set(train.named)
        for name in ("val", "test"):
            if (found.path / f"transforms_{name}.json").is_file():
                part = config.transforms(found, f"transforms_{name}.json", need_photos)
                parts[name] = _existing(part) if need_photos else part.photographs
                named |= part.named
        there = [name for name in ("val", "test") if parts.get(name)]
        self._report(found, f"{train.path} (blender, {len(train.photographs)} photographs)")
        if need_photos:
            check_masks([each for part in parts.values() for each in part])
            name_unused(found.folder, named, config.downscale_factor)
        own = None
        if config.ply_path is not None and config.points == "auto":
            own = read_colored_points(found.path / config.ply_path, "leave --ply-path out", train.photographs)
        frame = FrameOptions(config.scale_factor, "none", "none", auto_scale_poses=False, scene_scale=BLENDER_SIDE)
        if config.scale_factor == 1.0:  # else the user has chosen it
            frame = fit_scale(frame, train.photographs, str(train.path))
        views = make_views(
            [each for part in parts.values() for each in part],
            frame,
            initial_points(own, config.points, train.photographs, found.folder, str(train.path)),
            str(train.path),
            config.downscale_factor or 1,
            need_photos,
            alpha_color=None if config.alpha_color is None else get_color(config.alpha_color),
        )
        selected, start = {}, 0
        for name, part in parts.items():
            of_part = range(start, start + len(part))
            selected[name] = select_views(
                views, [i for i, n in enumerate(views.metadata["photographs"]) if n in of_part]
            )
            start += len(part)
        if not there:
            return self._split(selected["train"], {})
        held_out = " and ".join(f"{len(parts[name])} of transforms_{name}.json" for name in there)
        say(f"Held out for evaluation: {held_out}.")
        return {"train": selected["train"], "val": selected[there[0]], "test": selected[there[-1]]}

    def _report(self, found: Found, what: str) -> None:
        text = f"Reading {what}. {found.how_to_choose()}"
        if found.format == "instant-ngp" and self.config.format == "auto":  # a guess: both use one name
            text = f"{text.rstrip()} If nerfstudio wrote it: `bitymi-data --format nerfstudio`."
        say(text.rstrip())


def _existing(part: Transforms) -> list[Photograph]:
    """Photographs of a file of held-out views that exist, with a warning on the others."""
    there = [each for each in part.photographs if each.file.is_file()]
    lacking = [each.file for each in part.photographs if not each.file.is_file()]
    if lacking:
        what = "all" if not there else str(len(lacking))
        warn(f"{part.path} lacks {what} of its {len(part.photographs)} photographs, left out: {listed(lacking)}.")
    return there
