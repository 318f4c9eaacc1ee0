"""Photographs, poses and points of a COLMAP model, in nerfstudio's frame."""

import os
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from bitymi_ns.trust import leads_inside, listed
from . import pycolmap
from .colmap_model import Model, read_model
from .find_files import FileFinder, report_renamed
from .folder_contents import images_of, photographs_below, photographs_in, result_in
from .image_files import image_size, in_proportion
from .masks import USUAL_FOLDERS
from .points import Points
from .recognise import Found
from .types import OPENCV_AXES, Photograph, Pose, SfmSettings, fail, warn

TO_Z_UP = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
"""[4, 4] from COLMAP's world (up about -y), as in nerfstudio's COLMAP parser."""


@dataclass(frozen=True)
class Origin:
    """Input of structure from motion, which a training run records; paths are relative to the capture."""

    kind: Literal["photographs", "video"]
    path: str  # folder of photographs, or video
    photographs: str | None  # their folder; None = temporary upright copies or frames
    settings: SfmSettings | None = None  # None = unknown


@dataclass(frozen=True)
class Source:
    """A COLMAP model and its photographs."""

    model: Model = field(repr=False, compare=False)
    folder: Path  # of the model
    photographs: Path  # to which names in the model are relative
    left_out: Mapping[str, str] = field(default_factory=dict)  # photographs without a pose, and known reasons
    report: Path | None = None  # folder of the report on structure from motion
    origin: Origin | None = None  # None = the capture came with the model

    def files(self) -> list[Path]:
        """Find the files of the model's images; missing ones have the stated path."""
        names = [image.name for image in self.model.images]
        finder = FileFinder(self.photographs)
        return [path or finder.missing(name) for path, name in zip(finder.find_all(names), names, strict=True)]

    def describe(self) -> str:
        model = self.model
        used = {image.camera_id for image in model.images}
        kinds = Counter(model.cameras[number].model for number in used)
        cameras = " and ".join(f"{count} {kind}" for kind, count in sorted(kinds.items()))
        text = f"COLMAP model {self.folder} ({len(model.images)} photographs, {cameras} camera"
        return f"{text}{'s' if len(used) > 1 else ''}, {len(model.xyz):,} points), photographs {self.photographs}"


def find_source(found: Found, images: Path | None, downscale: int, need_photos: bool) -> Source:
    """Read a COLMAP model, and find its photographs: at a stated path in the capture, else by searching it."""
    model = read_model(found.path)
    names = [image.name for image in model.images]
    photographs = _find_folder(names, found.path, found.folder, images, downscale, need_photos)
    factor = photographs.name.rpartition("_")[2]
    camera = model.cameras[model.images[0].camera_id]
    size = image_size(photographs / names[0]) if need_photos and factor.isdecimal() else None
    if size is not None and size != camera.size and in_proportion(size, camera.size) and factor != str(downscale):
        what = f"only copies of {size[0]} x {size[1]} pixels of the photographs of {found.path} are there, in"
        fail(f"{what} {photographs}: `bitymi-data --downscale-factor {factor}` uses them.")
    return Source(model, found.path, photographs)


def _find_folder(
    names: Sequence[str], folder: Path, capture: Path, stated: Path | None, downscale: int, need_photos: bool
) -> Path:
    """Find the folder with most of a model's photographs: `stated`, else in `capture`, and three levels above if that
    is the model's. Raises CaptureError: photographs are needed, and `stated` is missing or no folder has any."""
    if stated is not None:
        if not need_photos or (capture / stated).is_dir() or (capture / f"{stated}_{downscale}").is_dir():
            return capture / stated
        advice = f"Correct --images-path, which is seen from {capture}, or leave it out."
        fail(f"the folder of photographs {capture / stated} does not exist. {advice}")
    bases = [capture, *(path for path in folder.parents if path.is_relative_to(capture) and path != capture)]
    bases += folder.parents[:3] if folder == capture else ()
    folders = [*images_of(folder), *(base / name for base in bases for name in USUAL_FOLDERS)]
    folders += [path for path in sorted(capture.iterdir()) if path.is_dir() and not result_in(path)]
    folders += bases

    def most(path: Path, count: Callable[[Path], int]) -> int:
        copies = Path(f"{path}_{downscale}")
        return max((count(place) for place in (path, copies) if place.is_dir()), default=0)

    portable = [name for name in names if leads_inside(name)]
    exact = {path: most(path, lambda base: sum(os.path.isfile(base / name) for name in portable)) for path in folders}
    best = max(folders, key=exact.__getitem__)  # the first of equals
    if not need_photos or exact[best] == len(names):
        return best
    # a folder above the capture may be a whole disk
    searched = [path for path in exact if path.is_relative_to(capture) or path.name in USUAL_FOLDERS]
    counts = {path: most(path, lambda base: len({*FileFinder(base).find_all(names)} - {None})) for path in searched}
    fitting = max(counts, key=counts.__getitem__)
    if counts[fitting] > exact[best]:
        return fitting
    if exact[best] == 0:
        near = [hint for path in searched if path.is_dir() and (hint := FileFinder(path).nearest(names[0], names))]
        hint = f" ({near[0]})" if near else ""
        where = f"which are in none of the folders of {capture}{hint}"
        advice = "Copy them to its folder `images`, or give their folder: `bitymi-data --images-path`."
        fail(f"the COLMAP model {folder} is of {listed(names)}, {where}. {advice}")
    return best


def warn_left_out(source: Source) -> set[Path]:
    """Report photographs that the model lacks or names differently; return the paths of all."""
    files = source.files()
    stated, folder = [image.name for image in source.model.images], source.photographs
    report_renamed(f"The COLMAP model {source.folder}", stated, files, folder)
    used = {path.relative_to(folder).as_posix() if path.is_relative_to(folder) else path.name for path in files}
    nested = any("/" in name for name in used)
    there = (photographs_below if nested else photographs_in)(source.photographs)
    names = {path.relative_to(source.photographs).as_posix() for path in there}
    unused = sorted((names | source.left_out.keys()) - used)
    if unused:
        named = [f"{name} ({source.left_out[name]})" if name in source.left_out else name for name in unused]
        total = len(used) + len(unused)
        warn(f"{len(unused)} of {total} photographs have no pose in the model and are left out: {listed(named)}.")
    return {*files, *(source.photographs / name for name in names)}


def photographs_of(source: Source) -> list[Photograph]:
    model, photographs = source.model, []
    for image, file in zip(model.images, source.files(), strict=True):
        w, *xyz = image.qvec / np.linalg.norm(image.qvec)
        pose: Pose = np.eye(4)
        pose[:3] = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([*xyz, w])), image.tvec).inverse().matrix()
        pose = TO_Z_UP @ pose @ OPENCV_AXES
        label = f"camera {image.camera_id} of {source.folder}"
        photographs.append(Photograph(file, model.cameras[image.camera_id], pose, label, frame=image.frame))
    return photographs


def model_points(model: Model, frame: Pose) -> Points:
    return Points(model.xyz @ frame[:3, :3].T + frame[:3, 3], model.rgb)
