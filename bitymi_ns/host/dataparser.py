"""One parser for whatever a folder or file holds: `bitymi-data`, the methods' default.

It recognises the format, has nerfstudio's parser of it read it where there is one that does, and holds views out by one
rule for all.
"""

from __future__ import annotations

import dataclasses
import os
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import torch
import tyro
from nerfstudio.cameras.cameras import CameraType
from nerfstudio.data.dataparsers.base_dataparser import DataParser, DataParserConfig, DataparserOutputs
from nerfstudio.data.dataparsers.blender_dataparser import BlenderDataParserConfig
from nerfstudio.data.dataparsers.instant_ngp_dataparser import InstantNGPDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig

from bitymi_ns.capture.frame import read_frame
from bitymi_ns.capture.recognise import Found, NotRecognised, recognise
from bitymi_ns.capture.types import SfmSettings
from bitymi_ns.host import finding, holdout, kept_poses
from bitymi_ns.host.colmap_model import read_model
from bitymi_ns.host.colmap_views import (
    Place,
    Source,
    find_source,
    pinhole_cameras,
    points_of,
    tell_left_out,
    views,
)
from bitymi_ns.host.dataset import views_of
from bitymi_ns.host.errors import fail, listed, say, warn
from bitymi_ns.host.kept_poses import KeptPoses
from bitymi_ns.host.lens import lens
from bitymi_ns.host.transforms import (
    Lists,
    colmap_points,
    complete_instant_ngp,
    corrected_files,
    take_lists,
    without_endings,
)

WITH_MODEL = ("colmap", "photographs", "video")
"""Formats that are read as a COLMAP model, which is found for those that come without."""
USED_BY: dict[str, tuple[str, ...]] = {
    "colmap_path": ("colmap",),
    "images_path": ("colmap",),
    "masks_path": ("colmap", "photographs"),
    "downscale_factor": ("nerfstudio", *WITH_MODEL),
    "ply_path": ("blender",),
    "alpha_color": ("blender",),
    "scene_scale": ("nerfstudio", *WITH_MODEL),
    "orientation_method": ("nerfstudio", *WITH_MODEL),
    "center_method": ("nerfstudio", *WITH_MODEL),
    "auto_scale_poses": ("nerfstudio", *WITH_MODEL),
    "scale_factor": ("nerfstudio", *WITH_MODEL, "blender"),
    "load_3D_points": ("nerfstudio", *WITH_MODEL),
    "eval_names": ("nerfstudio", "instant-ngp", *WITH_MODEL),
    "sfm": ("photographs", "video"),
}
"""Formats that an option is for, where that is not all of them."""


@dataclass
class BitymiDataParserConfig(DataParserConfig):
    """Reads what --data holds: a transforms.json of nerfstudio or instant-ngp, a COLMAP project, a Blender data set, a
    folder of photographs, or a video."""

    _target: type = field(default_factory=lambda: BitymiDataParser)
    data: Path = Path()
    """Folder, or file: transforms.json or video."""
    format: Literal["auto", "nerfstudio", "instant-ngp", "blender", "colmap", "photographs", "video"] = "auto"
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
    """Points of a Blender data set, a PLY file seen from --data; not given: random ones."""
    alpha_color: Literal["white", "black"] | None = "white"
    """Colour behind the transparent pictures of a Blender data set; None = that of the method."""
    load_3D_points: bool = True
    """Start from the points of the capture; else from random ones."""
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
        self.eval_names = holdout.read_names(self.eval_names)

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

    def stock(self, found: Found) -> DataParserConfig | None:
        """The configuration of nerfstudio's parser that reads this, all views as one split; None = it has none."""
        if found.format == "nerfstudio":
            names = ("downscale_factor", "scale_factor", "scene_scale", "orientation_method", "center_method")
            kept = {name: getattr(self, name) for name in (*names, "auto_scale_poses")}
            # it would ask whether to convert COLMAP's points, which are read as they are
            points = self.load_3D_points and colmap_points(found.path) is None
            return NerfstudioDataParserConfig(
                data=Path(self.data), eval_mode="interval", eval_interval=1, load_3D_points=points, **kept
            )
        if found.format == "instant-ngp":
            return InstantNGPDataParserConfig(data=Path(self.data), eval_mode="interval", eval_interval=1)
        if found.format == "blender":
            options = {"scale_factor": self.scale_factor, "alpha_color": self.alpha_color, "ply_path": self.ply_path}
            return BlenderDataParserConfig(data=found.path, **options)
        return None

    def place(self) -> Place:
        """What is done with the frame of a COLMAP model."""
        return Place(**{each.name: getattr(self, each.name) for each in dataclasses.fields(Place)})

    def source(self, found: Found, look: bool = True) -> Source:
        """The COLMAP model and its photographs, found for photographs without poses; see `find_source`."""
        reduction = self.downscale_factor or 1
        if found.format == "colmap":
            return find_source(found.path, found.folder, self.images_path, self.masks_path, reduction, look=look)
        kept = self.kept()
        if kept is not None:
            return finding.source_of_run(found, kept, self.masks_path, reduction, look)
        if self.poses is not None:
            warn(f"The poses that the run was trained with are no longer in {self.poses}: others can be found now.")
        return finding.source_of(found, self.masks_path, reduction, self.sfm)


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
        if found.format == "blender":
            return self._blender(found)
        self.poses_report = None if read_frame(found.folder) is None else found.folder
        outputs, lists = self._colmap(found) if found.format in WITH_MODEL else self._transforms(found)
        split = self._holdout(outputs.image_filenames, lists, found)
        say(split.told(outputs.image_filenames))
        held_out = views_of(outputs, split.held_out)
        return {"train": views_of(outputs, split.train), "val": held_out, "test": held_out}

    def _generate_dataparser_outputs(self, split: str = "train", **kwargs: Any) -> DataparserOutputs:
        return self.splits[split]

    def _transforms(self, found: Found) -> tuple[DataparserOutputs, Lists]:
        """All views of a transforms.json, and its lists of photographs for training and evaluation."""
        lists: Lists = {}
        files: set[Path] = set()

        def adapt(path: Path, meta: Any) -> None:
            if found.format == "instant-ngp":
                complete_instant_ngp(path, meta)
            lists.update(take_lists(meta))
            files.update(Path(os.path.normpath(frame["file_path"])) for frame in meta["frames"])

        outputs = self._read(found, "val", adapt)
        _check_not_merged(files, outputs.image_filenames)
        what = f"{found.path} ({found.format}, {len(outputs.image_filenames)} photographs)"
        model = colmap_points(found.path) if found.format == "nerfstudio" and self.config.load_3D_points else None
        if model is not None:
            placed = points_of(read_model(model), outputs.dataparser_transform, outputs.dataparser_scale)
            outputs = dataclasses.replace(outputs, metadata={**outputs.metadata, **placed})
            what += f", points of {model}"
        self._tell(found, what)
        return outputs, lists

    def _read(self, found: Found, split: str, adapt: Callable[[Path, Any], None]) -> DataparserOutputs:
        """What nerfstudio's parser of this format gives."""
        stock = self.config.stock(found)
        assert stock is not None
        parser = stock.setup()
        if self.downscale_factor is not None:
            parser.downscale_factor = self.downscale_factor
        with corrected_files(stock, adapt):
            return _without_fisheyes(parser.get_dataparser_outputs(split), str(found.path))

    def _colmap(self, found: Found) -> tuple[DataparserOutputs, Lists]:
        """All views of a COLMAP model, and the lists of photographs beside it."""
        look = self.downscale_factor is None
        source = self.config.source(found, look)
        self.poses_report = source.report or self.poses_report
        self.found = None if source.origin is None else source
        model = read_model(source.folder)
        self._tell(found, source.told(model))
        if look:
            tell_left_out(source, model)
        return views(source, self.config.place(), self.config.load_3D_points, look), _lists_in(found.folder)

    def _blender(self, found: Found) -> dict[str, DataparserOutputs]:
        """The capture's own split; where one of its two files of held-out views is missing, the other stands for it."""
        there = [name for name in ("val", "test") if (found.path / f"transforms_{name}.json").is_file()]
        if not there:
            fail(
                f"{found.path} has a transforms_train.json, but neither a transforms_val.json nor a "
                "transforms_test.json of held-out views. Write one with a few of the frames."
            )
        splits = {name: self._read(found, name, without_endings) for name in ("train", *there)}
        counts = {name: len(outputs.image_filenames) for name, outputs in splits.items()}
        self._tell(found, f"{found.path / 'transforms_train.json'} (blender, {counts['train']} photographs)")
        held_out = " and ".join(f"{counts[name]} of transforms_{name}.json" for name in there)
        say(f"Held out for evaluation: {held_out}.")
        return {"val": splits[there[0]], "test": splits[there[-1]], **splits}

    def _tell(self, found: Found, what: str) -> None:
        text = f"Reading {what}. {found.how_to_choose()}"
        if found.format == "instant-ngp" and self.config.format == "auto":  # by a guess: both use one name
            text = f"{text.rstrip()} If nerfstudio wrote it: `bitymi-data --format nerfstudio`."
        say(text.rstrip())

    def _holdout(self, names: Sequence[Path], lists: Lists, found: Found) -> holdout.Split:
        config = self.config
        if config.eval_names:
            return holdout.by_names(names, config.eval_names, "--eval-names")
        if not lists:
            return holdout.by_mode(names, config.eval_mode, config.eval_interval, config.train_split_fraction)
        where = "the capture's own lists"
        full = set(names)

        def numbers(split: str) -> list[int]:  # reduced photographs lie in another folder than the lists say
            wanted = [name if found.folder / name in full else Path(name).name for name in lists.get(split, [])]
            return sorted(set(holdout.find(names, wanted, where)))

        held_out = sorted({*numbers("val"), *numbers("test")})
        rest = [i for i in range(len(names)) if i not in set(held_out)]
        return holdout.Split(numbers("train") if "train" in lists else rest, held_out, f"by {where}")


def _check_not_merged(files: set[Path], read: Sequence[Path]) -> None:
    """Stop where photographs of one name are taken for each other: nerfstudio looks for the reduced ones of all folders
    in one.

    Args:
        files: that the capture names.
        read: in their place.
    """
    if len(set(read)) >= len(files):
        return
    counts = Counter(path.name for path in files)
    twins = sorted(path.as_posix() for path in files if counts[path.name] > 1)
    fail(
        f"{listed(twins)} have the same names in different folders, but {read[0].parent} can have one of each alone. "
        "Use the photographs as they are (`bitymi-data --downscale-factor 1`), or give them different names."
    )


def _lists_in(folder: Path) -> Lists:
    """The names in train_list.txt, test_list.txt and validation_list.txt, which nerfstudio's COLMAP parser knows."""
    lists = {}
    for split, name in (("train", "train"), ("val", "val"), ("val", "validation"), ("test", "test")):
        path = folder / f"{name}_list.txt"
        if path.is_file():
            lists[split] = [line.strip() for line in path.read_text("utf8").splitlines() if line.strip()]
    return lists


def _without_fisheyes(outputs: DataparserOutputs, where: str) -> DataparserOutputs:
    """The views with those of fisheye cameras as pinhole pictures.

    nerfstudio would choose their size by what the whole picture needs, which is endless for one of 180 degrees.
    """
    cameras = outputs.cameras
    if not bool((cameras.camera_type == CameraType.FISHEYE.value).all()):
        return outputs
    columns = (cameras.fx, cameras.fy, cameras.cx, cameras.cy)
    rows = torch.cat([torch.cat([c.double() for c in columns], -1), cameras.distortion_params[:, :4].double()], -1)
    made, told, lenses = {}, [], []
    for row, size in zip(rows.tolist(), torch.cat([cameras.width, cameras.height], -1).tolist(), strict=True):
        key = (*row, *size)
        if key not in made:
            made[key], sentences = lens("OPENCV_FISHEYE", tuple(row), *size, tuple(size), f"the camera of {where}")
            told += sentences
        lenses.append(made[key])
    for sentence in told[:1]:
        say(f"{sentence[0].upper()}{sentence[1:]}")
    return dataclasses.replace(
        outputs,
        cameras=pinhole_cameras([each.pinhole for each in lenses], cameras.camera_to_worlds),
        metadata={**outputs.metadata, "lenses": lenses},
    )
