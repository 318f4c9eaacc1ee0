"""One parser for whatever a folder or file holds: `bitymi-data`, the methods' default.

It recognises the format, reads it as photographs with cameras and poses, and holds views out by one rule for all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro
from nerfstudio.data.dataparsers.base_dataparser import DataParser, DataParserConfig, DataparserOutputs
from nerfstudio.utils.colors import get_color

from bitymi_ns.capture.frame import read_frame
from bitymi_ns.capture.recognise import Format, Found, NotRecognised, passed_over, recognise
from bitymi_ns.capture.types import SfmSettings
from bitymi_ns.files import encoding_of
from bitymi_ns.plugin.console import fail, listed, say, warn
from bitymi_ns.plugin.data import conventions, kept_poses, sfm_poses, splits
from bitymi_ns.plugin.data.colmap_model import read_model
from bitymi_ns.plugin.data.colmap_views import (
    TO_NERFSTUDIO,
    Source,
    find_source,
    photographs_of,
    points_of,
    tell_left_out,
)
from bitymi_ns.plugin.data.dataset import views_of
from bitymi_ns.plugin.data.initial_points import Choice, are_wanted, starting_points
from bitymi_ns.plugin.data.kept_poses import KeptPoses
from bitymi_ns.plugin.data.point_colors import points_of_file, with_colours
from bitymi_ns.plugin.data.scanner_views import scanned
from bitymi_ns.plugin.data.transforms import Lists, colmap_points
from bitymi_ns.plugin.data.transforms_views import Transforms, missing_photographs, read_transforms
from bitymi_ns.plugin.data.views import Photograph, Place, Views, in_proportion, views_of_capture

WITH_MODEL = ("colmap", "photographs", "video")
"""Formats that are read as a COLMAP model, which is found for those that come without."""
SCANNED = ("polycam", "record3d", "pose-files")
"""Formats of scanning programs, with their poses."""
USED_BY: dict[str, tuple[str, ...]] = {
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
NGP_SCALE = 0.3333
"""Factor on positions of instant-ngp's captures, as in nerfstudio's reader."""
BLENDER_SIDE = 1.5
"""Half the side of the box of a Blender data set, as in nerfstudio's reader."""


@dataclass
class BitymiDataParserConfig(DataParserConfig):
    """Reads what --data holds: a transforms.json of nerfstudio or instant-ngp, a COLMAP project, a Blender data set,
    what Polycam, Record3D or an RGB-D camera wrote, a folder of photographs, or a video."""

    _target: type = field(default_factory=lambda: BitymiDataParser)
    data: Path = Path()
    """Folder, or file: transforms.json or video."""
    format: Format | Literal["auto"] = "auto"
    """What to read where there is more than one thing; auto = what has poses before what has none."""
    downscale_factor: int | None = None
    """Use photographs that are so many times smaller: those of images_2, images_4, ... where there is such a folder."""
    images_path: Path | None = None
    """Folder of the photographs of a COLMAP model, seen from --data; not given: it is found."""
    masks_path: Path | None = None
    """Folder of masks for a COLMAP model or photographs, seen from --data; not given: `masks` beside the
    photographs, in their folder or in that of the data."""
    colmap_path: Path | None = None
    """Folder of the COLMAP model, seen from --data; not given: it is found."""
    ply_path: Path | None = None
    """Points of a Blender data set, a PLY file seen from --data; not given: see --points."""
    alpha_color: Literal["white", "black"] | None = "white"
    """Colour behind the transparent pictures of a Blender data set; None = that of the method."""
    points: Choice = "auto"
    """Points to start from: those of the capture, triangulated ones where it has none (auto); triangulated ones in any
    case; or random ones."""
    eval_mode: Literal["fraction", "filename", "interval", "all"] = "interval"
    """Which photographs are held out: evenly spaced ones, those with eval in their names, every n-th, or none (all are
    used for both)."""
    eval_interval: int = 8
    """Every which photograph is held out with --eval-mode interval, by name."""
    train_split_fraction: float = 0.9
    """Share of the photographs that is trained on with --eval-mode fraction."""
    eval_names: tuple[str, ...] = ()
    """Names of the photographs to hold out, or a text file (.txt) with one per line; goes before --eval-mode."""
    scale_factor: float = 1.0
    """Factor on the positions of the cameras."""
    scene_scale: float = 1.0
    """Half the side of the box in which random points are placed."""
    orientation_method: Literal["pca", "up", "vertical", "none"] = "up"
    """How the capture is turned: up = the cameras' mean up is z."""
    center_method: Literal["poses", "focus", "none"] = "poses"
    """What becomes the origin: the middle of the cameras, or what they look at."""
    auto_scale_poses: bool = True
    """Scale the capture so that the cameras fit into a box from -1 to 1."""
    sfm: SfmSettings = SfmSettings()  # noqa: RUF009 - it is frozen
    """How the poses of photographs and videos are found."""
    poses: tyro.conf.Suppress[Path | None] = None
    """Folder of the poses that an earlier run was trained with. Not in the help: the host sets it where the data of an
    existing run are read."""

    def kept(self) -> KeptPoses | None:
        """The poses that the run was trained with; None = they are not kept."""
        return None if self.poses is None else kept_poses.read(Path(self.poses))

    def settle(self) -> None:
        """Replace the name of a list of photographs by what is in it, so that config.yml stands on its own."""
        self.eval_names = splits.read_names(self.eval_names)

    def find(self) -> Found:
        """What there is to read.

        Raises:
            InputError: nothing, or an option that is not for what there is.
        """
        kept = self.kept()
        try:
            found = recognise(Path(self.data), self.format, self.colmap_path) if kept is None else kept.found(self.data)
        except NotRecognised as error:
            fail(str(error), error)
        for name, formats in USED_BY.items():
            default = type(self).__dataclass_fields__[name].default
            if found.format not in formats and getattr(self, name) != default:
                fail(
                    f"--{name.replace('_', '-')} is not for {found.path}, which is read as {found.format}, but for "
                    f"{', '.join(formats)}. Leave it out, or give --format."
                )
        return found

    def transforms(self, found: Found, name: str, look: bool, announce: bool = True) -> Transforms:
        """A JSON file of a capture; see `read_transforms`.

        Args:
            found: nerfstudio, instant-ngp or blender.
            name: of the file.
            look, announce: see there.
        """
        path = found.folder / name if found.format == "blender" else found.path
        return read_transforms(path, found.format == "nerfstudio", self.downscale_factor or 1, look, announce)

    def place(self) -> Place:
        """What is done with the frame of a COLMAP model."""
        return Place(**{each.name: getattr(self, each.name) for each in fields(Place)})

    def source(self, found: Found, look: bool = True) -> Source:
        """The COLMAP model and its photographs, found for photographs without poses; see `find_source`."""
        reduction = self.downscale_factor or 1
        if found.format == "colmap":
            return find_source(found.path, found.folder, self.images_path, self.masks_path, reduction, look=look)
        kept = self.kept()
        if kept is not None:
            return sfm_poses.source_of_run(found, kept, self.masks_path, reduction, look)
        if self.poses is not None:
            warn(f"The poses that the run was trained with are no longer in {self.poses}: others can be found now.")
        return sfm_poses.source_of(found, self.masks_path, reduction, self.sfm)


class BitymiDataParser(DataParser):
    """Views of a capture in any format.

    Attributes:
        downscale_factor: set by nerfstudio where photographs are not needed, so that none is opened; else None.
        poses_report: folder of the report on how the poses were found, once the views are read; None = there is none.
        found: the model that was found here, once the views are read; None = the capture came with its poses.
    """

    config: BitymiDataParserConfig

    def __init__(self, config: BitymiDataParserConfig) -> None:
        super().__init__(config)
        self.downscale_factor: int | None = None
        self.poses_report: Path | None = None
        self.found: Source | None = None

    @cached_property
    def splits(self) -> dict[str, DataparserOutputs]:
        """Training and held-out views (val, test), read once."""
        found = self.config.find()
        if found.unread:
            named = listed([f"{path.name} ({program})" for path, program in found.unread])
            warn(
                f"{found.folder} holds poses that cannot be read: {named}. Poses are found anew from the photographs. "
                "To have those used, export a COLMAP model, or convert them with `ns-process-data`."
            )
        if found.format == "blender":
            return self._blender(found)
        self.poses_report = None if read_frame(found.folder) is None else found.folder
        readers = dict.fromkeys(WITH_MODEL, self._colmap) | dict.fromkeys(SCANNED, self._scanned)
        outputs, lists = readers.get(found.format, self._transforms)(found)
        return self._split(outputs, lists, found)

    def _split(self, outputs: Views, lists: Lists, found: Found) -> dict[str, DataparserOutputs]:
        split = self._holdout(outputs.image_filenames, lists, found)
        say(split.told(outputs.image_filenames))
        held_out = views_of(outputs, split.held_out)
        return {"train": views_of(outputs, split.train), "val": held_out, "test": held_out}

    def _generate_dataparser_outputs(self, split: str = "train", **kwargs: Any) -> DataparserOutputs:
        return self.splits[split]

    @property
    def _look(self) -> bool:
        """Whether photographs are needed."""
        return self.downscale_factor is None

    def _transforms(self, found: Found) -> tuple[Views, Lists]:
        """All views of a transforms.json, and its lists of photographs for training and evaluation."""
        config, look = self.config, self._look
        read = config.transforms(found, "", look)
        if look:
            missing_photographs(read.path, read.photographs)
        meta, place = read.meta, config.place()
        if found.format == "instant-ngp":  # whose scale is that of its bounding box
            half = 0.5 * float(meta.get("aabb_scale", 1))
            place = Place(NGP_SCALE, "none", "none", auto_scale_poses=False, scene_scale=half)
            place = in_proportion(place, read.photographs, str(read.path))
        elif "orientation_override" in meta:
            place = replace(place, orientation_method=meta["orientation_override"])
            say(f"{read.path} asks for the orientation method {place.orientation_method}.")
        model = colmap_points(found.path)
        before = _applied(meta, found.folder)
        what = f"{found.path} ({found.format}, {len(read.photographs)} photographs)"
        own = None
        if config.points == "auto":
            if meta.get("ply_file_path"):
                own = points_of_file(found.folder / meta["ply_file_path"], read.photographs)
            elif model is not None:
                own = points_of(read_model(model), np.eye(4) if before is None else before)
                own = with_colours(own, read_model(model).without_colours, read.photographs, model)
                what += f", points of {model}"
        self._tell(found, what)
        if own is not None and look and are_wanted():
            conventions.check_conventions(own, read.photographs, conventions.JSON, str(found.path))
        points = starting_points(own, config.points, read.photographs, found.folder, str(found.path))
        outputs = views_of_capture(
            read.photographs,
            place,
            points,
            str(found.path),
            config.downscale_factor or 1,
            look,
            before=before,
            before_scale=float(meta.get("applied_scale", 1.0)),
        )
        return outputs, read.lists

    def _colmap(self, found: Found) -> tuple[Views, Lists]:
        """All views of a COLMAP model, and the lists of photographs beside it."""
        config, look = self.config, self._look
        source = config.source(found, look)
        self.poses_report = source.report or self.poses_report
        self.found = None if source.origin is None else source
        model = read_model(source.folder)
        self._tell(found, source.told(model))
        if look:
            tell_left_out(source, model)
        photographs = photographs_of(source, look)
        own = points_of(model, TO_NERFSTUDIO)
        if look and are_wanted() and config.points == "auto":
            own = with_colours(own, model.without_colours, photographs, source.folder)
            conventions.check_conventions(own, photographs, conventions.COLMAP, str(source.folder), TO_NERFSTUDIO)
        points = starting_points(own, config.points, photographs, found.folder, str(source.folder))
        outputs = views_of_capture(
            photographs, config.place(), points, str(source.folder), source.reduction, look, before=TO_NERFSTUDIO
        )
        return outputs, _lists_in(found.folder)

    def _scanned(self, found: Found) -> tuple[Views, Lists]:
        """All views of what a scanning program wrote."""
        config, look = self.config, self._look
        photographs = scanned(found, look)
        self._tell(found, f"{found.path} ({found.format}, {len(photographs)} photographs with their poses)")
        others = passed_over(found.path)
        if others and look:
            say(f"Not taken for photographs: {listed(others)}.")
        points = starting_points(None, config.points, photographs, found.folder, str(found.path))
        reduction = config.downscale_factor or 1
        return views_of_capture(photographs, config.place(), points, str(found.path), reduction, look), {}

    def _blender(self, found: Found) -> dict[str, DataparserOutputs]:
        """The capture's own split. Where one of its two files of held-out views is missing, or all its photographs are,
        the other stands for it; where both are, views are held out of those for training."""
        config, look = self.config, self._look
        train = config.transforms(found, "transforms_train.json", look)
        if look:
            missing_photographs(train.path, train.photographs)
        parts: dict[str, list[Photograph]] = {"train": train.photographs}
        for name in ("val", "test"):
            if (found.path / f"transforms_{name}.json").is_file():
                part = config.transforms(found, f"transforms_{name}.json", look)
                parts[name] = _present(part) if look else part.photographs
        there = [name for name in ("val", "test") if parts.get(name)]
        self._tell(found, f"{train.path} (blender, {len(train.photographs)} photographs)")
        own = None if config.ply_path is None else points_of_file(found.path / config.ply_path, train.photographs)
        points = starting_points(own, config.points, train.photographs, found.folder, str(train.path))
        place = Place(config.scale_factor, "none", "none", auto_scale_poses=False, scene_scale=BLENDER_SIDE)
        if config.scale_factor == 1.0:  # else somebody has decided
            place = in_proportion(place, train.photographs, str(train.path))
        outputs = views_of_capture(
            [each for part in parts.values() for each in part],
            place,
            points,
            str(train.path),
            config.downscale_factor or 1,
            look,
            alpha_color=None if config.alpha_color is None else get_color(config.alpha_color),
        )
        numbers, at = {}, 0
        for name, part in parts.items():
            numbers[name] = list(range(at, at + len(part)))
            at += len(part)
        if not there:
            return self._split(views_of(outputs, numbers["train"]), {}, found)
        held_out = " and ".join(f"{len(parts[name])} of transforms_{name}.json" for name in there)
        say(f"Held out for evaluation: {held_out}.")
        splits = {name: views_of(outputs, numbers[name]) for name in ("train", *there)}
        return {"val": splits[there[0]], "test": splits[there[-1]], **splits}

    def _tell(self, found: Found, what: str) -> None:
        text = f"Reading {what}. {found.how_to_choose()}"
        if found.format == "instant-ngp" and self.config.format == "auto":  # by a guess: both use one name
            text = f"{text.rstrip()} If nerfstudio wrote it: `bitymi-data --format nerfstudio`."
        say(text.rstrip())

    def _holdout(self, names: Sequence[Path], lists: Lists, found: Found) -> splits.Split:
        config = self.config
        if config.eval_names:
            return splits.by_names(names, config.eval_names, "--eval-names")
        if not lists:
            return splits.by_mode(names, config.eval_mode, config.eval_interval, config.train_split_fraction)
        where = "the capture's own lists"

        def numbers(split: str) -> list[int]:  # reduced photographs lie in another folder than the lists say
            return sorted(set(splits.find(names, lists.get(split, []), where, anywhere=True)))

        held_out = sorted({*numbers("val"), *numbers("test")})
        rest = [i for i in range(len(names)) if i not in set(held_out)]
        return splits.Split(numbers("train") if "train" in lists else rest, held_out, f"by {where}")


def _applied(meta: dict[str, Any], folder: Path) -> np.ndarray | None:
    """[4, 4] that was applied to a capture of nerfstudio's before its file was written; None = nothing is known."""
    rows = meta.get("applied_transform")
    if rows is None and (folder / "colmap/sparse/0").is_dir():
        rows = [[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]]  # what its tool applied before it stated that
    return None if rows is None else np.vstack([np.array(rows, float)[:3], [0.0, 0.0, 0.0, 1.0]])


def _present(part: Transforms) -> list[Photograph]:
    """The photographs of a file of held-out views that are there; the others are named."""
    there = [each for each in part.photographs if each.file.is_file()]
    lacking = [each.file for each in part.photographs if not each.file.is_file()]
    if lacking:
        what = "all" if not there else str(len(lacking))
        warn(f"{part.path} lacks {what} of its {len(part.photographs)} photographs, left out: {listed(lacking)}.")
    return there


def _lists_in(folder: Path) -> Lists:
    """The names in train_list.txt, test_list.txt and validation_list.txt, which nerfstudio's COLMAP parser knows."""
    lists = {}
    for split, name in (("train", "train"), ("val", "val"), ("val", "validation"), ("test", "test")):
        path = folder / f"{name}_list.txt"
        if path.is_file():
            lists[split] = [line.strip() for line in path.read_text(encoding_of(path)).splitlines() if line.strip()]
    return lists
