"""Read a capture of any format: photographs with cameras, poses and masks, and points."""

import math
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from bitymi_ns.exit_messages import line_of
from bitymi_ns.trust import listed
from .colmap_model import read_model
from .colmap_views import TO_Z_UP, Source, find_source, model_points, photographs_of, warn_left_out
from .find_files import check_photographs_exist, downscaled, name_unused
from .folder_contents import photo_folder
from .frame import read_frame
from .image_files import check_sizes
from .kinds import NSVF
from .masks import check_masks, with_masks
from .points import Points, cloud_beside, read_cloud, with_colors
from .pose_checks import fit_scale
from .readings import AUTO, WRITTEN, Reading, as_meant
from .recognise import SPLITS, Format, Found, is_model, recognise
from .scanner_views import Y_UP, scanner_photographs
from .sfm_poses import find_sfm_source, kept_source, read_kept_poses
from .splits import NameLists, SplitOptions, choose_split, lists_by_name, read_split_lists
from .transforms import Transforms, check_number, read_transforms
from .types import FrameOptions, Orientation, Photograph, Pose, SfmSettings, fail, say, warn

Choice = Literal["auto", "triangulate", "random"]  # auto: the capture's, else triangulated
WITH_MODEL = ("colmap", "photographs", "video")  # formats read as a COLMAP model
SCANNED = ("polycam", "record3d", "3d-scanner", "stray-scanner", "pose-files")  # with poses of scanners
FRAMED = ("nerfstudio", *WITH_MODEL, *SCANNED)  # whose poses are oriented, centered and scaled
OPTION_FORMATS: dict[str, tuple[str, ...]] = {
    "colmap_path": ("colmap",),
    "images_path": ("colmap",),
    "alpha_color": ("blender",),
    **dict.fromkeys(("scene_scale", "orientation_method", "center_method", "auto_scale_poses"), FRAMED),
    "scale_factor": (*FRAMED, "blender"),
    "eval_names": ("nerfstudio", "instant-ngp", *WITH_MODEL, *SCANNED),
    "sfm": ("photographs", "video"),
    "poses_as": ("nerfstudio", "instant-ngp", "blender", "colmap", *SCANNED),
}
"""Formats of options that are not for all."""
CONVENTIONS: dict[str, tuple[Reading, Pose]] = {
    "colmap": (Reading("opencv", "w2c", "wxyz"), TO_Z_UP), "pose-files": (Reading("opencv"), np.eye(4)),
    "polycam": (Reading(), Y_UP), "record3d": (Reading(order="xyzw"), Y_UP), "3d-scanner": (Reading(), Y_UP),
    "stray-scanner": (Reading("opencv", "c2w", "xyzw"), Y_UP),
}  # fmt: skip
"""Conventions of poses, with the transform of their world; others are camera to world with OpenGL axes."""
OF_EARLIER_TOOL = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]])
NGP_SCALE = 0.3333  # factor on positions, as in nerfstudio's reader
BLENDER_SIDE = 1.5  # half the box's side, as in nerfstudio's reader


def check_options(options: Any, call: Callable[[str], str] = str) -> None:
    """Check the options that a reader of captures has; `call` names one in messages. Raises CaptureError."""
    mode = getattr(options, "eval_mode", None)
    for name, used, is_valid, what in (
        ("scale_factor", True, lambda value: 0.0 < value < math.inf, "above 0"),
        ("downscale_factor", True, lambda value: value is None or value >= 1 and value % 1 == 0, "1 or more"),
        ("train_split_fraction", mode == "fraction", lambda value: 0.0 < value <= 1.0, "above 0 and at most 1"),
        ("eval_interval", mode == "interval", lambda value: value >= 1, "1 or more"),
        ("points", isinstance(options, CaptureOptions), lambda value: value in get_args(Choice), "one of its choices"),
    ):
        if used and hasattr(options, name) and not is_valid(value := getattr(options, name)):
            fail(f"{call(name)} is {value}, but has to be {what}. Correct it, or leave it out.")


@contextmanager
def _naming_files() -> Iterator[None]:
    """Convert an OSError to a CaptureError that names the file."""
    try:
        yield
    except OSError as error:
        fail(line_of(error) or str(error), error)


@dataclass
class CaptureOptions(SplitOptions, FrameOptions):
    """Options of reading a capture."""

    data: Path = Path()
    """Folder, or file: transforms.json or video."""
    format: Format | Literal["auto"] = "auto"
    """Format to read where there are several; auto = one with poses before one without."""
    downscale_factor: int | None = None
    """Use photographs that are smaller by this factor: those in images_2, images_4, ... where that folder exists."""
    images_path: Path | None = None  # Folder of a COLMAP model's photographs, relative to --data; None = find it.
    masks_path: Path | None = None
    """Folder of masks, relative to --data; None = masks beside the photographs, or the folder `masks` beside theirs,
    in it or in that of the data."""
    use_masks: bool = True  # Use the masks of the capture: those that it names, or those beside its photographs.
    colmap_path: Path | None = None  # Folder of the COLMAP model, relative to --data; None = find it.
    ply_path: Path | None = None  # PLY file of points to start from, relative to --data; None = see --points.
    points: Choice = "auto"
    """Points to start from: those of the capture, else triangulated ones (auto); triangulated; or random ones."""
    sfm: SfmSettings = SfmSettings()  # noqa: RUF009 - it is frozen
    """Structure from motion for photographs and videos."""
    poses_as: str = AUTO
    """How to read the poses: as the photographs show (auto), as the file states (written), or by the name of a reading
    that a message states."""
    poses: Path | None = None  # Folder of the poses that a run was trained with.

    @_naming_files()
    def find(self) -> Found:
        """Recognize the capture. Raises CaptureError: there is none, or an option is for another format."""
        kept, data = read_kept_poses(self.poses), Path(self.data)
        found = recognise(data, self.format, self.colmap_path) if kept is None else kept.found(data)
        for name, formats in OPTION_FORMATS.items():
            default = getattr(type(self).__dataclass_fields__.get(name), "default", None)
            if found.format not in formats and getattr(self, name, default) != default:
                read_as = f"{found.path}, which is read as {found.format}, but for {', '.join(formats)}"
                fail(f"--{name.replace('_', '-')} is not for {read_as}. Leave it out, or give --format.")
        return found


@dataclass
class Capture:
    """A capture in the frame that its files state; up of a COLMAP model (-y) becomes z."""

    format: Format
    source: str  # names it in messages
    photographs: list[Photograph]  # by name, Blender's train, val and test after one another
    points: Points | None  # to start from; None = random ones
    frame: FrameOptions
    lists: NameLists = field(default_factory=lambda: NameLists({}))  # its own
    parts: dict[str, Sequence[int]] = field(default_factory=dict)  # of "train", and of held out "val" and "test"
    downscale: int = 1
    applied: Pose | None = None  # [4, 4], as its files state
    applied_scale: float = 1.0
    declares_box: bool = False  # its files state the box of the scene
    poses_as: str = AUTO  # name of the reading of its poses
    report: Path | None = None  # on structure from motion
    model: Source | None = None  # found by structure from motion; None = the capture came with poses


@_naming_files()
def read_capture(
    options: CaptureOptions, need_photos: bool = True, want_points: bool = True, found: Found | None = None
) -> Capture:
    """Read a capture of any format, and check all that its files state. `need_photos`: fail if photographs are missing,
    else open none; `want_points`: color and triangulate points; `found`: result of `options.find`. Raises CaptureError:
    it cannot be used; names the file and the entry, and says what to do."""
    return _Reader(options, found or options.find(), need_photos, want_points).read()


@dataclass
class _Reader:
    options: CaptureOptions
    found: Found
    need_photos: bool
    want_points: bool
    poses_as: str = AUTO
    mirror: Pose = field(default_factory=lambda: np.eye(4))  # reflection of a left-handed world

    def read(self) -> Capture:
        found = self.found
        if found.unread:
            unread = listed(found.unread, most=12)
            warn(f"{found.folder} holds poses that are not read: {unread}. Poses are computed from the photographs.")
        readers = dict.fromkeys(WITH_MODEL, self._colmap) | dict.fromkeys(SCANNED, self._scanned)
        capture = {**readers, "blender": self._blender}.get(found.format, self._transforms)()
        capture.downscale, capture.poses_as = self.downscale, self.poses_as
        if capture.report is None and read_frame(found.folder) is not None:
            capture.report = found.folder
        there = [name for name in ("val", "test") if capture.parts.get(name)]
        if there:
            held_out = " and ".join(f"{len(capture.parts[name])} of transforms_{name}.json" for name in there)
            say(f"Held out for evaluation: {held_out}.")
            capture.parts |= {"val": capture.parts[there[0]], "test": capture.parts[there[-1]]}
        else:
            split = choose_split(capture.photographs, capture.lists, self.options)
            say(split.describe([photograph.file for photograph in capture.photographs]))
            capture.parts = {"train": split.train, "val": split.held_out, "test": split.held_out}
        return capture

    @property
    def downscale(self) -> int:
        return self.options.downscale_factor or 1

    def _read_transforms(self, path: Path) -> Transforms:
        read = read_transforms(path, self.found.format == "nerfstudio", self.need_photos, self.options.use_masks)
        base = path.parent if path.name in SPLITS else None
        return replace(read, photographs=self._prepared(read.photographs, path.parent, base))

    def _prepared(
        self, photographs: list[Photograph], folder: Path, base: Path | None = None, images: Path | None = None
    ) -> list[Photograph]:
        """Add masks, and replace photographs by smaller copies; see `with_masks` and `downscaled`."""
        stated = self.options.masks_path
        masked = self.options.use_masks and (stated is not None or not any(each.mask for each in photographs))
        if self.need_photos and masked and self.found.format != "video":
            photographs = with_masks(photographs, self.found.folder, base, stated, self.downscale, images)
        return downscaled(photographs, folder, self.downscale) if self.downscale > 1 else photographs

    def _transforms(self) -> Capture:
        options, found = self.options, self.found
        read, source = self._read_transforms(found.path), str(found.path)
        meta, frame, auto, own = read.meta, options, options.points == "auto", None
        earlier = found.folder / "colmap/sparse/0"  # points of nerfstudio's tool before it stated either
        applied = meta.get("applied_transform", OF_EARLIER_TOOL if earlier.is_dir() else None)
        model = read_model(earlier) if auto and "ply_file_path" not in meta and is_model(earlier) else None
        with_points = "" if model is None else f", points of {earlier}"
        what = f"{source} ({found.format}, {len(read.photographs)} photographs){with_points}"
        photographs = self._checked(what, read.photographs, read.named, source)
        if found.format == "instant-ngp":  # whose scale is that of its bounding box
            half = 0.5 * check_number(read.path, "aabb_scale", meta.get("aabb_scale", 1), "for all frames")
            frame = FrameOptions(NGP_SCALE, "none", "none", auto_scale_poses=False, scene_scale=half)
            frame = fit_scale(frame, photographs, source)
        elif "orientation_override" in meta:
            method = meta["orientation_override"]
            if method not in get_args(Orientation):
                fail(f"{read.path}: orientation_override is {method!r}, none of {', '.join(get_args(Orientation))}.")
            frame = replace(frame, orientation_method=method)
            say(f"{read.path} asks for the orientation method {method}.")
        if auto and "ply_file_path" in meta:
            hint = "Put it there again, or start from random points: `bitymi-data --points random`."
            path = found.folder / meta["ply_file_path"]
            own = self._colored(*read_cloud(path, hint), photographs, path)
        elif model is not None and applied is not None:
            own = self._colored(model_points(model, applied), model.without_colors, photographs, earlier)
        points = self._points(own, photographs, source)
        boxed = found.format == "instant-ngp" and "aabb_scale" in meta
        of_file = {"applied": applied, "applied_scale": meta.get("applied_scale", 1.0), "declares_box": boxed}
        return Capture(found.format, source, photographs, points, frame, read.lists, **of_file)

    def _colmap(self) -> Capture:
        """Read a COLMAP model, which structure from motion may find, and lists of names beside it."""
        options, found, need_photos = self.options, self.found, self.need_photos
        if found.format == "colmap":
            source = find_source(found, options.images_path, self.downscale, need_photos)
        elif (kept := read_kept_poses(options.poses)) is not None:
            source = kept_source(found, kept, need_photos)
        else:
            if gone := options.poses:
                warn(f"The poses that the run was trained with are no longer in {gone}: others can be found now.")
            source = find_sfm_source(found, options.masks_path, options.sfm, options.use_masks)
        model = source.model
        named = warn_left_out(source) if need_photos else set()
        photographs, where = photographs_of(source), str(source.folder)
        base = source.photographs if found.format == "colmap" else photo_folder(found.path)
        photographs = self._prepared(photographs, source.photographs.parent, base, source.photographs)
        photographs = self._checked(source.describe(), photographs, named, where)
        own = model_points(model, TO_Z_UP)
        if need_photos and self.want_points and options.points == "auto":
            own = self._colored(own, model.without_colors, photographs, source.folder)
        points = self._points(own, photographs, where)
        lists = read_split_lists(found.folder, source.folder, [each.file for each in photographs])
        sfm = {"report": source.report, "model": None if source.origin is None else source}
        return Capture(found.format, where, photographs, points, options, lists, applied=TO_Z_UP, **sfm)

    def _scanned(self) -> Capture:
        found = self.found
        photographs, source = scanner_photographs(found), str(found.path)
        photographs = self._prepared(photographs, found.folder)
        what = f"{source} ({found.format}, {len(photographs)} photographs with their poses)"
        photographs = self._checked(what, photographs, (), source)
        points = self._points(None, photographs, source)
        files = [each.file for each in photographs] if found.format == "pose-files" else []
        lists = lists_by_name(files, NSVF, "NSVF's names")
        return Capture(found.format, source, photographs, points, self.options, lists)

    def _blender(self) -> Capture:
        """Read a Blender data set. If its val or test file is missing, or lacks all its photographs, the other serves
        for both."""
        options, found, need_photos = self.options, self.found, self.need_photos
        train = self._read_transforms(found.folder / SPLITS[0])
        every, named, source = list(train.photographs), set(train.named), str(train.path)
        parts: dict[str, Sequence[int]] = {"train": range(len(every))}
        for name in ("val", "test"):
            if (found.path / f"transforms_{name}.json").is_file():
                part = self._read_transforms(found.folder / f"transforms_{name}.json")
                there = [each for each in part.photographs if not need_photos or os.path.isfile(each.file)]
                if lacking := [each.file for each in part.photographs if each not in there]:
                    count = len(lacking) if there else "all"
                    left = f"left out: {listed(lacking)}"
                    warn(f"{part.path} lacks {count} of its {len(part.photographs)} photographs, {left}.")
                parts[name] = range(len(every), len(every) + len(there))
                every += there
                named |= part.named
        every = self._checked(f"{source} (blender, {len(train.photographs)} photographs)", every, named, source)
        trained = every[: len(train.photographs)]
        frame = FrameOptions(options.scale_factor, "none", "none", auto_scale_poses=False, scene_scale=BLENDER_SIDE)
        if options.scale_factor == 1.0:  # else the user has chosen it
            frame = fit_scale(frame, trained, source)
        points = self._points(None, trained, source)
        return Capture(found.format, source, every, points, frame, parts=parts)

    def _checked(
        self, what: str, photographs: Sequence[Photograph], named: Iterable[Path | None], source: str
    ) -> list[Photograph]:
        """Report what is read; fail if photographs or masks are missing. If it came with poses, report pictures beside
        them that are not `named`, and give photographs the poses that they are meant to have (`as_meant`)."""
        text = [f"Reading {what}.", self.found.how_to_choose()]
        if self.found.format == "instant-ngp" and self.options.format == "auto":  # a guess: both use one name
            text.append("If nerfstudio wrote it: `bitymi-data --format nerfstudio`.")
        say(" ".join(filter(None, text)))
        if self.need_photos:
            check_photographs_exist(Path(source), [each.file for each in photographs])
            check_masks(photographs)
            check_sizes(photographs)
        if self.found.format in ("photographs", "video"):
            return list(photographs)
        if self.need_photos:
            named = (*named, *(each.file for each in photographs))
            masks = [each.mask for each in photographs]
            name_unused(self.found, named, masks, self.options.downscale_factor)
        convention = CONVENTIONS.get(self.found.format, (Reading(), np.eye(4)))
        asked = self.options.poses_as
        asked = asked if asked != AUTO or self.need_photos else WRITTEN
        meant, self.mirror, self.poses_as = as_meant(photographs, *convention, source, asked)
        return meant

    def _colored(self, points: Points, without: str, photographs: Sequence[Photograph], source: Path) -> Points:
        points = self._placed(points)
        return with_colors(points, without, photographs, source) if self.want_points else points

    def _placed(self, points: Points) -> Points:
        """Mirror points as the poses are."""
        return points._replace(xyz=points.xyz @ self.mirror[:3, :3].T + self.mirror[:3, 3])

    def _points(self, own: Points | None, photographs: Sequence[Photograph], source: str) -> Points | None:
        """Choose the points to start from: of --ply-path, the capture's `own`, those of a PLY file beside it that shows
        the same surfaces as triangulated ones, or these; None = random ones."""
        auto, folder = self.options.points == "auto", self.found.folder
        if self.options.points == "random":
            return None
        if auto and self.options.ply_path is not None:
            path = folder / self.options.ply_path
            cloud = read_cloud(path, "Put it there again, or leave --ply-path out.")
            return self._colored(*cloud, photographs, path)
        if auto and own is not None and len(own.xyz):
            return own
        if not self.want_points:
            return None
        from .known_poses import triangulated  # slow to import, and seldom needed

        points = triangulated(photographs, folder, source)
        return (cloud_beside(folder, points, photographs, self._placed) if auto else None) or points
