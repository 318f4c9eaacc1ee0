"""Recognize the format of a capture: poses in files, photographs, or a video."""

import os
import struct
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

from bitymi_ns.safe_reading import MOST_TEXT, open_regular, open_text, read_json
from bitymi_ns.trust import listed
from . import folder_contents
from .kinds import OTHERS, PHOTOGRAPHS, SCANS, UNREAD, VIDEOS
from .types import fail

Format = Literal[
    "nerfstudio", "instant-ngp", "blender", "colmap", "polycam", "record3d", "3d-scanner", "stray-scanner",
    "pose-files", "photographs", "video",
]  # fmt: skip

MODELS = ("sparse/0", "colmap/sparse/0", "sparse")  # of COLMAP, the most usual first
NERFSTUDIOS_OWN = {"ply_file_path", "applied_transform", "camera_model", "orientation_override", "train_filenames"}
"""Entries of a transforms.json that only nerfstudio writes."""
POLYCAM = (("corrected_images", "corrected_cameras"), ("images", "cameras"))
"""Polycam's folders of images and cameras, the better ones first."""
TWINS = ("nerfstudio", "instant-ngp")  # formats of one file name
STRAY = ("odometry.csv", "camera_matrix.csv", "rgb.mp4")  # Stray Scanner's poses, camera, video
SPLITS = ("transforms_train.json", "transforms_val.json", "transforms_test.json")  # files of a Blender data set
INTRINSICS = {"fl_x", "fl_y", "cx", "cy", "w", "h"}


@dataclass(frozen=True)
class Found:
    format: Format  # to read it as
    path: Path
    """nerfstudio, instant-ngp: transforms.json; colmap: the model's folder; video: the file; else a folder."""
    folder: Path  # of the capture, to which names in its files are relative
    beside: tuple[tuple[Format, Path], ...] = ()  # captures beside it that are not read
    unread: tuple[str, ...] = ()  # files of poses, and what converts them

    def how_to_choose(self) -> str:
        """Describe captures that are not read, and how to read them; empty = none."""
        ways = []
        for format, path in self.beside:
            option = f"--format {format}"
            if format == "colmap" and self.format == "colmap":
                option = f"--colmap-path {path.relative_to(self.folder)}"
            elif format == "video" or (path.suffix == ".json" and path.name != "transforms.json"):
                option = f"--data {path}"
            ways.append(f"{_seen_from(path, self.folder)} (`bitymi-data {option}`)")
        return f"Not read: {listed(ways)}." if ways else ""


def recognise(data: Path, format: Format | Literal["auto"] = "auto", colmap_path: Path | None = None) -> Found:
    """Recognize the capture of a `format` (auto = any, poses before photographs without) at a folder or a file.
    `colmap_path` of a model is relative to it. Raises CaptureError: there is none."""
    if not data.exists():
        fail(f"the capture {data} does not exist. Give a folder or a file with --data.")
    if colmap_path is not None:
        if format not in ("auto", "colmap"):
            fail(f"--colmap-path is for COLMAP models: leave out --format {format}, or the path.")
        return _colmap_given(data, colmap_path)
    if why := folder_contents.refusal(data):
        fail(why)
    folder = data if data.is_dir() else data.parent
    candidates = list(_in_folder(data) if data.is_dir() else _of_file(data))
    fitting: list[tuple[Format, Path]] = [each for each in candidates if format in ("auto", each[0])]
    if data.is_dir() and all(kind in ("photographs", "video") for kind, _ in fitting):
        if (within := _capture_within(data, format)) is not None:
            return recognise(within, format)
    if format in TWINS and not fitting:  # the user knows better
        fitting = [(format, path) for kind, path in candidates if kind in TWINS]
    if not fitting:
        fail(_nothing(data, format, candidates))
    (chosen, path), *_ = fitting
    # photographs belong to the capture beside them, but not to a video
    beside = [each for each in candidates if each[1] != path and (each[0] != "photographs" or chosen == "video")]
    if chosen == "stray-scanner":
        beside = [each for each in beside if each[1].name != STRAY[2]]
    poses = folder_contents.poses_in(folder) if chosen in ("photographs", "video") else ()
    return Found(chosen, path, path if chosen == "blender" else folder, tuple(beside), poses)


def _capture_within(folder: Path, format: Format | Literal["auto"]) -> Path | None:
    """Find the only subfolder with poses, as unpacked archives have; None = none, several, or photographs beside it."""
    if folder_contents.photographs_in(folder):
        return None
    folders = [path for path in folder_contents.folders_in(folder)
               if any(format in ("auto", kind) for kind, _ in (*_transforms_in(path), *_scanned(path)))]  # fmt: skip
    return folders[0] if len(folders) == 1 else None


def _of_file(file: Path) -> Iterator[tuple[Format, Path]]:
    suffix = file.suffix.lower()
    if file.name in SPLITS:
        yield "blender", file.parent
    elif suffix == ".json":
        yield _kind_of(file), file
    elif suffix in VIDEOS:
        yield "video", file
    elif file.stem in ("cameras", "images", "points3D") and is_model(file.parent):
        yield "colmap", file.parent


def _in_folder(folder: Path) -> Iterator[tuple[Format, Path]]:
    """Yield a folder's captures in order of preference."""
    yield from _transforms_in(folder)
    for model in models_in(folder):
        yield "colmap", folder / model
    yield from _scanned(folder)
    if (photographs := _photographs_in(folder)) is not None:
        yield "photographs", photographs
    for video in folder_contents.videos_in(folder):
        yield "video", video


def _transforms_in(folder: Path) -> Iterator[tuple[Format, Path]]:
    """Yield transforms.json and Blender's files, else JSON files of other names that hold camera transforms."""
    usual = folder / "transforms.json"
    # folders and broken links count: reading them reports an error
    there, splits = (os.path.lexists(path) for path in (usual, folder / SPLITS[0]))
    if there:
        yield _kind_of(usual), usual
    if splits:
        yield "blender", folder
    elif not there:
        for path in sorted(folder.glob("*.json")):
            if path.name not in SPLITS and folder_contents.holds(path, b'"transform_matrix"', MOST_TEXT):
                yield _kind_of(path), path


def _scanned(folder: Path) -> Iterator[tuple[Format, Path]]:
    """Yield captures of scanning programs, and RGB-D sets with poses."""
    scanned = set()
    for row in SCANS:
        files = []
        for name in row.names.split():
            exists = Path.is_file if row.mark or "." in name else Path.is_dir
            files += [path for path in sorted(folder.glob(name)) if exists(path)][:1]
        complete = len(files) == len(row.names.split())
        if complete and (not row.mark or folder_contents.holds(files[0], row.mark.encode(), MOST_TEXT)):
            scanned.add(row.what)
    yield from ((format, folder) for format in get_args(Format) if format in scanned)


def _kind_of(file: Path) -> Format:
    """Tell nerfstudio's transforms.json from instant-ngp's; unreadable ones are nerfstudio's, whose reader says so."""
    meta = None
    with suppress(OSError, ValueError):
        meta = read_json(file)
    if not isinstance(meta, dict) or meta.keys() & NERFSTUDIOS_OWN:
        return "nerfstudio"
    if "aabb_scale" in meta:
        return "instant-ngp"
    frames: Any = meta.get("frames")
    first = frames[0] if isinstance(frames, list) and frames and isinstance(frames[0], dict) else {}
    complete = INTRINSICS <= meta.keys() | first.keys()
    return "instant-ngp" if not complete and meta.keys() & {"camera_angle_x", "x_fov"} else "nerfstudio"


def is_model(folder: Path) -> bool:
    return any(os.path.isfile(folder / name) for name in ("cameras.bin", "cameras.txt"))


def models_in(data: Path) -> list[Path]:
    """List COLMAP models at most three levels below a folder, relative to it: usual folders first, and of numbered
    models side by side, of parts of a scene, those with most images."""
    folders = {path.parent for depth in ("", "*/", "*/*/", "*/*/*/") for path in data.glob(f"{depth}cameras.*")}
    models = [path.relative_to(data) for path in folders if is_model(path)]

    def rank(model: Path) -> tuple[int, str, int, str]:
        first = str(model.with_name("0") if model.name.isdigit() else model)  # sparse/1 ranks as sparse/0 does
        place = MODELS.index(first) if first in MODELS else len(MODELS)
        return place, str(model.parent), -image_count(data / model), str(model)

    return sorted((model for model in models if not any(part[0] == "." for part in model.parts)), key=rank)


def image_count(model: Path) -> int:
    """Read a model's number of images; 0 if it states none."""
    try:
        if (model / "images.bin").is_file():
            with open_regular(model / "images.bin") as file:
                return int(struct.unpack("<Q", file.read(8))[0])
        with open_text(model / "images.txt", errors="replace") as text:
            return sum(1 for line in text if line.strip() and not line.startswith("#")) // 2
    except (OSError, struct.error):
        return 0


def _photographs_in(folder: Path) -> Path | None:
    """Choose the folder to search for photographs: this one if it or its `images` holds some, or several subfolders do;
    else the same within the only subfolder that does. None = no photographs, or subfolders are captures."""
    if folder_contents.photographs_in(folder) or any(folder_contents.photographs_below(folder / "images")):
        return folder
    holding = [path for path in folder_contents.folders_in(folder) if any(folder_contents.photographs_below(path))]
    if not holding or captures_in(folder):
        return None
    return _photographs_in(holding[0]) if len(holding) == 1 else folder


def captures_in(folder: Path) -> list[Path]:
    """List the subfolders whose `images` hold photographs, as captures of their own, if several."""
    folders = folder_contents.folders_in(folder)
    captures = [path for path in folders if any(folder_contents.photographs_below(path / "images"))]
    return captures if len(captures) > 1 else []


def _colmap_given(data: Path, colmap_path: Path) -> Found:
    folder = data if data.is_dir() else data.parent
    model = folder / colmap_path
    if is_model(model):
        return Found("colmap", model, folder)
    what = "has no cameras.bin or cameras.txt" if os.path.isdir(model) else "does not exist"
    advice = "".join(f" Give `--colmap-path {path}`." for path in models_in(folder)[:1])
    fail(f"the COLMAP model {model} {what}.{advice or f' There is none in other folders of {folder}.'}")


def _nothing(data: Path, format: str, candidates: list[tuple[Format, Path]]) -> str:
    if format != "auto":
        held = ", ".join(f"{_seen_from(path, data)} ({kind})" for kind, path in candidates[:3])
        there = f" It holds {held}: leave --format out." if candidates else ""
        return f"{data} holds nothing of the format {format}.{there}"
    if not data.is_dir():
        if kind := folder_contents.kind_of(data, (*OTHERS, *UNREAD)):
            return f"{data} is {kind.what}: {kind.use}."
        is_one = "is one photograph" if data.suffix.lower() in PHOTOGRAPHS else "is no file that can be trained on"
        return f"{data} {is_one}. Give a folder of photographs, a video, or a capture with poses."
    if not any(data.iterdir()):
        return f"the folder {data} is empty. Give a folder of photographs, a video, or a capture with poses."
    hint, several = "", captures_in(data)
    known = [(path.name, kind) for path in data.iterdir() if (kind := folder_contents.kind_of(path, OTHERS))]
    if several:
        hint = f" It holds {len(several)} captures: give one of them, as {several[0]}."
    elif known:
        hint = f" {known[0][0]} is {known[0][1].what}: {known[0][1].use}."
    elif left := folder_contents.passed_over(data):
        hint = f" It holds what is not taken for photographs: {listed(left)}."
    lacks = "no transforms.json, no transforms_train.json, no COLMAP model (sparse/0), no photographs and no video"
    return f"{data} holds nothing to train on: {lacks}.{folder_contents.unreadable_in(data) or hint}"


def _seen_from(path: Path, folder: Path) -> str:
    return str(path.relative_to(folder)) if path != folder and path.is_relative_to(folder) else str(path)
