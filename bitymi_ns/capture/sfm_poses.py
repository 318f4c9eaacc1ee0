"""Poses found by structure from motion, and the copy that a training run keeps."""

import json
import os
import shutil
from collections.abc import Mapping
from dataclasses import asdict, fields
from pathlib import Path
from typing import NamedTuple

from pydantic import TypeAdapter

from bitymi_ns.files import copy_files
from bitymi_ns.safe_reading import read_json
from bitymi_ns.trust import Refused, leads_inside, listed
from .cache import keep_work_folder
from .colmap_model import read_model
from .colmap_views import Origin, Source
from .frame import gps_line
from .image_files import image_size, in_threads
from .recognise import Found
from .types import SfmOptions, SfmSettings, fail, parsing, say, warn

MODEL = Path("sparse/0")
IMAGES = "images"
ORIGIN = "origin.json"  # of the model's `Origin`


class KeptPoses(NamedTuple):
    folder: Path  # holds MODEL, the report, and IMAGES if these are upright copies or frames
    origin: Origin  # its photographs are IMAGES if it names no folder
    left_out: Mapping[str, str]  # photographs without a pose, and why

    def found(self, data: Path) -> Found:
        """Return the capture at `data` as the run recognized it, whatever lies beside it by now."""
        folder = data if data.is_dir() else data.parent
        return Found(self.origin.kind, folder / self.origin.path, folder)


def find_sfm_source(found: Found, masks_path: Path | None, settings: SfmSettings, use_masks: bool = True) -> Source:
    """Find poses of photographs or a video; `masks_path` is relative to the capture. Raises CaptureError."""
    from bitymi_ns.progress import rich_progress
    from .poses import find_poses  # slow to import

    masks = None if masks_path is None else found.folder / masks_path
    with rich_progress() as progress:
        options = SfmOptions(**asdict(settings), masks=masks, use_masks=use_masks)
        poses = find_poses(found.path, options, progress, warn, found.folder)
    keep_work_folder(poses.report.parent)
    placed = f"Poses of {poses.registered} of {poses.given} photographs of {found.path}"
    say(f"{placed}, to {poses.reprojection_error:.2f} pixels; report: {poses.report}.")
    if by_gps := gps_line(poses.report):
        say(by_gps)
    if poses.doubt:
        warn(poses.doubt)
    made = poses.images.is_relative_to(poses.report.parent)  # upright copies and frames are in the work folder
    photographs = None if made else os.path.relpath(poses.images, found.folder)
    assert found.format in ("photographs", "video")
    origin = Origin(found.format, os.path.relpath(found.path, found.folder), photographs, settings)
    return Source(read_model(poses.model), poses.model, poses.images, poses.left_out, poses.report, origin)


def kept_source(found: Found, kept: KeptPoses, need_photos: bool) -> Source:
    """Return the model of a run. Raises CaptureError: needed photographs are missing, or have another size."""
    photographs = kept.origin.photographs
    images = kept.folder / IMAGES if photographs is None else found.folder / photographs
    model = kept.folder / MODEL
    source = Source(read_model(model), model, images, kept.left_out, kept.folder, kept.origin)
    if need_photos:
        files = source.files()
        missing = [file.readlink() if file.is_symlink() else file for file in files if not os.path.isfile(file)]
        changed = []
        for image, file, size in zip(source.model.images, files, in_threads(image_size, files), strict=True):
            camera = source.model.cameras[image.camera_id]
            if size not in (None, camera.size):
                changed.append(f"{file}: {size[0]} x {size[1]} pixels, {camera.width} x {camera.height} then")
        what = [f"{len(missing)} are missing ({listed(missing)})"] if missing else []
        what += [f"{len(changed)} have another size ({listed(changed)})"] if changed else []
        if what:
            which = f"of the {len(files)} photographs that the run was trained with, {' and '.join(what)}"
            fail(f"{which}, so its poses in {kept.folder} cannot be used. Put them back as they were, or train again.")
    count = len(source.model.images)
    say(f"Poses of {count} photographs of {found.path} as the run was trained with them, of {kept.folder}.")
    return source


def has_kept_poses(folder: Path) -> bool:
    """Test for poses in a run's folder; earlier versions kept the report alone."""
    return (folder / ORIGIN).is_file()


def read_kept_poses(folder: Path | None) -> KeptPoses | None:
    """Read the poses kept in a run's folder; None = none. Raises CaptureError: ORIGIN cannot be read."""
    if folder is None or not has_kept_poses(folder := Path(folder)):
        return None
    path = folder / ORIGIN
    which = f"{path}, which says what the poses are of,"
    with parsing(which, f"Put the folder {folder} back as it was, or train again."):
        return TypeAdapter(KeptPoses).validate_python({**read_json(path), "folder": folder})


def kept_settings(folder: Path, requested: SfmSettings) -> SfmSettings:
    """Return the settings of a run's kept poses; warn of requested ones, other than defaults, that are not used."""
    kept = read_kept_poses(folder)
    settings = None if kept is None else kept.origin.settings
    unused = []
    for each in fields(SfmSettings):
        value = getattr(requested, each.name)
        if value not in (each.default, getattr(settings, each.name, each.default)):
            unused.append(f"--sfm.{each.name.replace('_', '-')} {value}")
    if unused:
        warn(
            f"{' and '.join(unused)} {'is' if len(unused) == 1 else 'are'} not used: the run goes on with the poses it "
            f"was trained with, in {folder}. For others leave out --load-dir and --load-checkpoint."
        )
    return settings or requested


def write_kept_poses(folder: Path, source: Source, origin: Origin) -> None:
    """Copy a model into an existing folder, and its photographs if they are upright copies or frames: hard links where
    possible. Raises OSError: it cannot be written, or a name leads out of the folder."""
    copy_files(source.folder, folder / MODEL)
    if origin.photographs is None:
        for image in source.model.images:
            if not leads_inside(image.name):
                raise Refused(f"{source.folder} names {image.name!r}, which leads out of its folder", folder)
            file, target = source.photographs / image.name, folder / IMAGES / image.name
            target.parent.mkdir(parents=True, exist_ok=True)
            if file.is_symlink():
                target.symlink_to(os.path.realpath(file))
                continue
            try:
                os.link(file, target)
            except OSError:  # another disk, or a file system without links
                shutil.copyfile(file, target)
    values = {"origin": asdict(origin), "left_out": dict(source.left_out)}
    (folder / ORIGIN).write_text(json.dumps(values, indent=2, ensure_ascii=False) + "\n", "utf8")
