"""The poses that a run on photographs or a video was trained with: they stay with it, whatever becomes of the files."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from bitymi_ns.capture.recognise import Found
from bitymi_ns.capture.types import SfmSettings
from bitymi_ns.plugin.console import fail, listed, warn
from bitymi_ns.plugin.data.colmap_model import Model, read_model
from bitymi_ns.plugin.data.colmap_views import Origin, Source
from bitymi_ns.plugin.data.images import THREADS, of_header
from bitymi_ns.trust import Refused, json_of, leads_inside

MODEL = Path("sparse/0")
IMAGES = "images"
ORIGIN = "origin.json"
"""File that says of what the model is. A folder that lacks it holds no poses, but at most a report."""


@dataclass(frozen=True)
class KeptPoses:
    """The poses in the folder of a run.

    Attributes:
        folder: it holds MODEL, the report, and IMAGES where those were made for the training.
        origin: of what they were found; its photographs are IMAGES where it names no folder.
        left_out: photographs without a pose, and why.
    """

    folder: Path
    origin: Origin
    left_out: Mapping[str, str] = field(default_factory=dict)

    @property
    def model(self) -> Path:
        """Folder of the COLMAP model."""
        return self.folder / MODEL

    def images(self, capture: Path) -> Path:
        """The folder to which the names in the model are relative, of a capture in this folder."""
        return self.folder / IMAGES if self.origin.photographs is None else capture / self.origin.photographs

    def found(self, data: Path) -> Found:
        """What to read, whatever else lies beside it by now.

        Args:
            data: folder or file of the capture, as the run was given it.
        """
        folder = data if data.is_dir() else data.parent
        return Found(self.origin.kind, folder / self.origin.path, folder)


def are_in(folder: Path) -> bool:
    """Whether a run keeps its poses in this folder; runs of earlier versions keep the report alone."""
    return (folder / ORIGIN).is_file()


def read(folder: Path) -> KeptPoses | None:
    """The poses in this folder; None = there are none.

    Raises:
        InputError: what says of what they are cannot be read.
    """
    path = folder / ORIGIN
    if not path.is_file():
        return None
    try:
        values: dict[str, Any] = json_of(path.read_text("utf8"))
        entries, left_out = dict(values["origin"]), dict(values["left_out"])
        if entries.get("settings") is not None:  # runs of earlier versions do not state them
            entries["settings"] = SfmSettings(**entries["settings"])
        origin = Origin(**entries)
        if origin.kind not in ("photographs", "video"):
            raise ValueError(f"it is of {origin.kind}")
    except (OSError, ValueError, LookupError, TypeError) as error:
        fail(
            f"{path}, which says of what the poses of the run were found, cannot be read ({error}). Put the folder "
            f"{folder} back as it was, or train again.",
            error,
        )
    return KeptPoses(folder, origin, left_out)


def settings_in(folder: Path, given: SfmSettings) -> SfmSettings:
    """The settings with which the poses in this folder were found; says which of those that were given are not used.

    Args:
        folder: of kept poses.
        given: settings of a run that reads them; a default counts as not given.
    """
    kept = read(folder)
    found = None if kept is None else kept.origin.settings
    unused = []
    for each in fields(SfmSettings):
        value = getattr(given, each.name)
        if value not in (each.default, getattr(found, each.name, each.default)):
            unused.append(f"--sfm.{each.name.replace('_', '-')} {value}")
    if unused:
        warn(
            f"{' and '.join(unused)} {'is' if len(unused) == 1 else 'are'} not used: the run goes on with the poses it "
            f"was trained with, in {folder}, because what it has learned fits no others. To have poses found anew, "
            "start a new run: leave out --load-dir and --load-checkpoint."
        )
    return found or given


def write(folder: Path, source: Source, origin: Origin) -> None:
    """Copy a model into an existing folder, with the photographs where those are copies or frames that can go.

    These take no space where they can be linked; links to the photographs themselves stay links.

    Raises:
        OSError: something cannot be written, or a name in the model leads out of its folder.
    """
    shutil.copytree(source.folder, folder / MODEL)
    if origin.photographs is None:
        for image in read_model(source.folder).images:
            if not leads_inside(image.name):
                raise Refused(f"{source.folder} names {image.name!r}, which leads out of its folder", folder)
            _link(source.photographs / image.name, folder / IMAGES / image.name)
    values = {"origin": asdict(origin), "left_out": dict(source.left_out)}
    (folder / ORIGIN).write_text(json.dumps(values, indent=2, ensure_ascii=False) + "\n", "utf8")


def _link(file: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    if file.is_symlink():
        target.symlink_to(os.path.realpath(file))
        return
    try:
        os.link(file, target)
    except OSError:  # another disk, or one that knows no links
        shutil.copyfile(file, target)


def check(source: Source, kept: Path) -> None:
    """Stop where photographs of the model are missing, or have another size than its cameras.

    Args:
        source: of kept poses.
        kept: their folder, for the message.
    """
    model = read_model(source.folder)
    files = source.files(model)
    missing = [file.readlink() if file.is_symlink() else file for file in files if not file.is_file()]
    changed = [] if source.reduced is not None else _changed(model, files)
    what = [f"{len(missing)} are missing ({listed(missing)})"] if missing else []
    what += [f"{len(changed)} have another size ({listed(changed)})"] if changed else []
    if what:
        fail(
            f"of the {len(files)} photographs that the run was trained with, {' and '.join(what)}, so its poses in "
            f"{kept} cannot be used. Put these photographs back as they were, or train again."
        )


def _changed(model: Model, files: list[Path]) -> list[str]:
    """The photographs that have another size than their cameras, with both; those that cannot be read are no such."""
    with ThreadPoolExecutor(THREADS) as pool:
        sizes = list(pool.map(lambda file: of_header(file, lambda image: image.size, None), files))
    changed = []
    for image, file, size in zip(model.images, files, sizes, strict=True):
        camera = model.cameras[image.camera_id]
        if size is not None and size != (camera.width, camera.height):
            changed.append(f"{file}: {size[0]} x {size[1]} pixels, {camera.width} x {camera.height} then")
    return changed
