"""The views of a COLMAP model: its photographs found on disk, its cameras as pinholes, its points, in nerfstudio's
frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from nerfstudio.data.utils.colmap_parsing_utils import qvec2rotmat

from bitymi_ns.capture.masks import USUAL_FOLDERS, mask_folder, mask_of, smaller_masks
from bitymi_ns.capture.recognise import is_photograph, photographs_below
from bitymi_ns.capture.types import CaptureError, SfmSettings
from bitymi_ns.plugin.console import fail, listed, say, warn
from bitymi_ns.plugin.data.colmap_model import Model, read_model
from bitymi_ns.plugin.data.names import Files, renamed
from bitymi_ns.plugin.data.ply import Points
from bitymi_ns.plugin.data.views import OPENCV_AXES, Photograph
from bitymi_ns.trust import leads_inside


@dataclass(frozen=True)
class Origin:
    """Of what a model was found here, so that a run can keep it.

    Attributes:
        kind: of what.
        path: the folder that was searched for photographs, or the video, seen from the capture.
        photographs: folder of the photographs, seen from the capture; None = those of the model are upright copies or
            frames, in a folder that can go.
        settings: with which the poses were found; None = they are not known.
    """

    kind: Literal["photographs", "video"]
    path: str
    photographs: str | None
    settings: SfmSettings | None = None


@dataclass(frozen=True)
class Source:
    """A COLMAP model and the photographs that belong to it.

    Attributes:
        folder: of the model.
        photographs: folder to which the names in the model are relative.
        masks: folder of masks; None = there are none.
        reduction: the photographs are so many times smaller than those of the model.
        reduced: folder of photographs that are that much smaller already; None = they are made so when they are read.
        left_out: photographs that the model lacks, with reasons where they are known.
        report: folder of the report on how the poses were found; None = there is none.
        origin: of what the model was found here; None = the capture came with it.
    """

    folder: Path
    photographs: Path
    masks: Path | None = None
    reduction: int = 1
    reduced: Path | None = None
    left_out: Mapping[str, str] = field(default_factory=dict)
    report: Path | None = None
    origin: Origin | None = None

    @property
    def read(self) -> Path:
        """Folder of the files that are read."""
        return self.reduced or self.photographs

    def files(self, model: Model) -> list[Path]:
        """The photographs of the model's images, missing ones under the names that the model has for them."""
        names = [image.name for image in model.images]
        files = Files(self.read)
        return [path or files.missing(name) for path, name in zip(files.find_all(names), names, strict=True)]

    def told(self, model: Model) -> str:
        """What it is."""
        kinds: dict[str, int] = {}
        for number in {image.camera_id for image in model.images}:
            kinds[model.cameras[number].model] = kinds.get(model.cameras[number].model, 0) + 1
        cameras = " and ".join(f"{count} {kind}" for kind, count in sorted(kinds.items()))
        text = f"COLMAP model {self.folder} ({len(model.images)} photographs, {cameras} camera"
        text += f"{'s' if sum(kinds.values()) > 1 else ''}, {len(model.xyz):,} points), photographs {self.read}"
        if self.masks is not None:
            text += f", masks {self.masks}"
        if self.reduction > 1 and self.reduced is None:
            text += f", reduced {self.reduction} times as they are read"
        return text


def find_source(
    folder: Path,
    capture: Path,
    images_path: Path | None = None,
    masks_path: Path | None = None,
    reduction: int = 1,
    left_out: Mapping[str, str] | None = None,
    look: bool = True,
) -> Source:
    """Find a model's photographs and masks.

    Args:
        folder: of the model.
        capture: folder to which the paths are relative, and below which photographs are looked for; where it is that of
            the model, the folders above it, too.
        images_path, masks_path: where they are, if that is known.
        reduction: use photographs that are so many times smaller.
        left_out: what is known of photographs that the model lacks.
        look: the photographs are needed; else they may be missing.

    Raises:
        InputError: no folder has the model's photographs, or the masks are not whole.
    """
    names = [image.name for image in read_model(folder).images]
    photographs = _photographs(names, folder, capture, images_path, reduction, look)
    masks = masks_of_capture(photographs, capture, masks_path, reduction)
    return source_in(folder, photographs, masks, reduction, left_out)


def source_in(
    folder: Path,
    photographs: Path,
    masks: Path | None = None,
    reduction: int = 1,
    left_out: Mapping[str, str] | None = None,
) -> Source:
    """A model whose photographs and masks are in known folders; those of reduced ones, as `images_2` and `masks_2`, are
    used where they are there."""
    smaller = photographs.with_name(f"{photographs.name}_{reduction}")
    reduced = smaller if reduction > 1 and smaller.is_dir() else None
    if masks is not None and reduction > 1 and (reduced is not None or not masks.is_dir()):
        small = smaller_masks(masks, reduction)
        masks = small if small.is_dir() else masks  # which are reduced as they are read
    return Source(folder, photographs, masks, reduction, reduced, dict(left_out or {}))


def _photographs(
    names: Sequence[str], folder: Path, capture: Path, given: Path | None, reduction: int, look: bool
) -> Path:
    """The folder that has the most of these photographs."""
    if given is not None:
        if not look or (capture / given).is_dir() or (capture / f"{given}_{reduction}").is_dir():
            return capture / given
        fail(
            f"the folder of photographs {capture / given} does not exist. Give it, seen from {capture}, with "
            "--images-path, or leave that out to have it found."
        )
    bases = [capture]
    if folder.is_relative_to(capture):
        bases += [path for path in folder.parents if path.is_relative_to(capture) and path != capture]
    if folder == capture:
        bases += folder.parents[:3]
    folders = [base / name for base in bases for name in USUAL_FOLDERS]
    folders += [path for base in bases[:1] for path in sorted(base.iterdir()) if path.is_dir()]
    folders += bases

    def both(place: Path) -> list[Path]:
        return [each for each in (place, place.with_name(f"{place.name}_{reduction}")) if each.is_dir()]

    usual = [name for name in names if leads_inside(name)]

    def present(place: Path) -> int:
        return max((sum((each / name).is_file() for name in usual) for each in both(place)), default=0)

    def alike(place: Path) -> int:
        found = (Files(each).find_all(names) for each in both(place))
        return max((sum(path is not None for path in files) for files in found), default=0)

    best = max(folders, key=present)  # the first of equals
    if not look or present(best) == len(names):
        return best
    # a folder above the capture may be the root of a disk, which is not searched
    searched = [each for each in folders if each.is_relative_to(capture) or each.name in USUAL_FOLDERS]
    counts = {each: alike(each) for each in dict.fromkeys(searched)}
    other = max(counts, key=counts.__getitem__)
    if counts[other] > present(best):
        return other
    if present(best) == 0:
        near = [hint for each in searched if each.is_dir() and (hint := Files(each).nearest(names[0]))]
        hint = f" ({near[0]})" if near else ""
        fail(
            f"the COLMAP model {folder} is of {listed(names)}, which are in none of the folders of {capture}{hint}. "
            "Copy the photographs to its folder `images`, or give their folder, seen from there: `bitymi-data "
            "--images-path`."
        )
    return best


def masks_of_capture(photographs: Path, capture: Path, given: Path | None, reduction: int = 1) -> Path | None:
    """The folder of masks by the rule of `mask_folder`.

    Args:
        photographs: their folder.
        capture: the folder of the data.
        given: the folder of masks, seen from the capture; None = it is found.
        reduction: photographs that are so many times smaller may be used.

    Raises:
        InputError: the given one is not there.
    """
    try:
        return mask_folder(photographs, capture, None if given is None else capture / given, reduction)
    except CaptureError as error:
        fail(f"{error}. Give it, seen from {capture}, with --masks-path.", error)


def mask_files(source: Source, model: Model) -> list[Path] | None:
    """The masks of the model's images, by the names of the photographs; see `mask_of`."""
    if source.masks is None:
        return None
    names = [_name_in(source.read, path) for path in source.files(model)]
    found = {name: mask_of(source.masks, name) for name in names}
    missing = [name for name, file in found.items() if file is None]
    if missing:
        fail(
            f"{source.masks} has no mask of {listed(missing)}, but of others. Give every photograph a mask of its name "
            "with .png (a white picture lets all pixels count), or move the folder away."
        )
    return [file for name in names if (file := found[name]) is not None]


def _name_in(folder: Path, path: Path) -> str:
    return path.relative_to(folder).as_posix() if path.is_relative_to(folder) else path.name


def tell_left_out(source: Source, model: Model) -> None:
    """Name the photographs that the model lacks, and those that have other names than it says."""
    files = source.files(model)
    other = renamed([image.name for image in model.images], files, source.read)
    if other:
        say(f"The COLMAP model {source.folder}: {other}")
    used = {_name_in(source.read, path) for path in files}
    nested = any("/" in name for name in used)
    there = photographs_below(source.photographs) if nested else filter(is_photograph, source.photographs.glob("*"))
    names = {path.relative_to(source.photographs).as_posix() for path in there}
    unused = sorted((names | source.left_out.keys()) - used)
    if unused:
        named = [f"{name} ({source.left_out[name]})" if name in source.left_out else name for name in unused]
        warn(
            f"{len(unused)} of {len(used) + len(unused)} photographs have no pose in the model and are left out: "
            f"{listed(named)}."
        )


def photographs_of(source: Source, look: bool) -> list[Photograph]:
    """The photographs of a model in the order of their names, with cameras and poses.

    Args:
        source: the model and its photographs.
        look: the photographs are needed; else they may be missing.
    """
    model = read_model(source.folder)
    files = source.files(model)
    masks = mask_files(source, model) if look else None
    return [
        Photograph(
            file=file,
            camera=model.cameras[image.camera_id],
            pose=TO_NERFSTUDIO @ _camera_to_world(image.qvec, image.tvec),
            whose=f"camera {image.camera_id} of {source.folder}",
            mask=None if masks is None else masks[i],
            smaller=source.reduced is not None,
        )
        for i, (image, file) in enumerate(zip(model.images, files, strict=True))
    ]


def points_of(model: Model, turn: np.ndarray) -> Points:
    """A model's points in another frame, [4, 4] float64 from its own."""
    return Points(model.xyz @ turn[:3, :3].T + turn[:3, 3], model.rgb)


TO_NERFSTUDIO = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
"""[4, 4] COLMAP's world, in which up is about -y, to nerfstudio's with z up; nerfstudio's parser does the same."""


def _camera_to_world(qvec: np.ndarray, tvec: np.ndarray) -> np.ndarray:
    """[4, 4] camera to world, of a camera with nerfstudio's axes (x right, y up, z backward)."""
    rotation = qvec2rotmat(qvec / np.linalg.norm(qvec))
    c2w = np.eye(4)
    c2w[:3, :3], c2w[:3, 3] = rotation.T, -rotation.T @ tvec
    return c2w @ OPENCV_AXES
