"""COLMAP models as they are on disk: cameras, poses and points, in COLMAP's own frame.

COLMAP's reader (pycolmap) stops at nothing in a file that is cut off, takes the name of a photograph in a text file to
end at its first space, and reads no model without points. So files are read here, where what is wrong is said by file
and entry; camera models and their geometry are pycolmap's (`plugin/data/lens.py`).
"""

from __future__ import annotations

import functools
import math
import os
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pycolmap

from bitymi_ns.capture.recognise import image_count
from bitymi_ns.files import encoding_of
from bitymi_ns.plugin.console import fail, warn
from bitymi_ns.plugin.data.colmap import check_cameras, check_images, parameter_count, reading
from bitymi_ns.plugin.data.ply import as_bytes, read_points
from bitymi_ns.plugin.data.point_cloud import what_is_wrong_with

FORMS = (".txt", ".bin")


class ModelCamera(NamedTuple):
    """A camera of a model: the name of its camera model, the size of its pictures in pixels, and its parameters."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]


class ModelImage(NamedTuple):
    """A photograph of a model: its name, its camera, and the rotation (wxyz) and translation of world to camera."""

    name: str
    camera_id: int
    qvec: npt.NDArray[np.float64]
    tvec: npt.NDArray[np.float64]


class Model(NamedTuple):
    """A model.

    Attributes:
        cameras: by number.
        images: in the order of their names.
        xyz: [N, 3] float64, the points.
        rgb: [N, 3] uint8, their colours; [0, 3] where they have none.
        without_colours: why they have none, in words that follow the name of the file; empty where they have.
    """

    cameras: dict[int, ModelCamera]
    images: list[ModelImage]
    xyz: npt.NDArray[np.float64]
    rgb: npt.NDArray[np.uint8]
    without_colours: str = ""


def read_model(folder: Path) -> Model:
    """Read the model in this folder, binary or text; the text where both are there, as nerfstudio does.

    Where they differ, that is said. A model is read once, also where several commands of a run ask for it.

    Raises:
        InputError: what is wrong with it, by file and entry.
    """
    names = [f"{name}{form}" for name in ("cameras", "images", "points3D") for form in FORMS]
    files = [*(folder / name for name in names), folder / "points3D.ply"]
    stamps = tuple((file, file.stat().st_mtime_ns, file.stat().st_size) for file in files if file.is_file())
    return _read_model(folder, stamps)


@functools.lru_cache(maxsize=1)
def _read_model(folder: Path, stamps: tuple[Any, ...]) -> Model:
    path = _file(folder, "cameras")
    with reading(path):
        cameras = dict(_cameras_text(path) if path.suffix == ".txt" else _cameras_binary(path))
    check_cameras(path, cameras)
    path = _file(folder, "images")
    with reading(path):
        images = dict(_images_text(path) if path.suffix == ".txt" else _images_binary(path))
    check_images(path, images, cameras)
    first: dict[str, int] = {}
    for number, image in images.items():
        if first.setdefault(image.name, number) != number:
            fail(
                f"{path}: images {first[image.name]} and {number} are both of {image.name}. Correct the name of one of "
                "them or remove it."
            )
    _tell_other_form(folder, cameras, len(images))
    path = _file(folder, "points3D")
    xyz, rgb, without_colours = np.zeros((0, 3)), np.zeros((0, 3), np.uint8), ""
    if path.is_file():
        with reading(path):
            xyz, rgb, without_colours = _points_text(path) if path.suffix == ".txt" else (*_points_binary(path), "")
            kept = np.isfinite(xyz).all(1)
        if not kept.all():
            warn(
                f"{path}: {np.sum(~kept):,} of {len(xyz):,} points, the first is point {np.argmin(kept) + 1}, are not "
                "finite. They are left out."
            )
            xyz, rgb = xyz[kept], rgb[kept] if len(rgb) else rgb
    elif (cloud := folder / "points3D.ply").is_file():  # as programs leave it that have read the model
        wrong = what_is_wrong_with(cloud)
        if wrong is not None:
            fail(f"the point cloud {cloud} {wrong}. Copy it again, or move it away to have points triangulated.")
        (xyz, rgb), without_colours = read_points(cloud)
    # nerfstudio sorts paths, not text: so the same photographs are held out
    return Model(cameras, sorted(images.values(), key=lambda image: Path(image.name)), xyz, rgb, without_colours)


def _file(folder: Path, name: str) -> Path:
    """A file of a model. All are of one form where one is whole: a single file of the other form is of another time."""

    def is_whole(form: str) -> bool:
        return all((folder / f"{each}{form}").is_file() for each in ("cameras", "images"))

    preferred = sorted(FORMS, key=is_whole, reverse=True)  # the text first, of two that are whole or are not
    return next((file for form in preferred if (file := folder / f"{name}{form}").is_file()), folder / f"{name}.bin")


def _tell_other_form(folder: Path, cameras: dict[int, ModelCamera], images: int) -> None:
    """Say what a binary model that is not read, because there is one in text, has that this has not."""
    if _file(folder, "images").suffix != ".txt" or not (folder / "images.bin").is_file():
        return
    differing = []
    count = image_count(folder)  # of the binary one, where that is there
    if count != images:
        differing.append(f"{images} images in text and {count} in binary form")
    path = folder / "cameras.bin"
    if path.is_file():
        with reading(path):
            if dict(_cameras_binary(path)) != cameras:
                differing.append("other cameras in text than in binary form")
    if differing:
        warn(
            f"{folder} holds two models: {' and '.join(differing)}. The text is read. To have the binary one read, "
            "move cameras.txt, images.txt and points3D.txt away."
        )


class _Binary:
    """A binary file from its start to its end, neither less nor more."""

    def __init__(self, path: Path) -> None:
        self.data, self.at = path.read_bytes(), 0

    def take(self, format: str) -> tuple[Any, ...]:
        values = struct.unpack_from("<" + format, self.data, self.at)
        self.skip(struct.calcsize("<" + format))
        return values

    def skip(self, size: int) -> None:
        self.at += size
        if self.at > len(self.data):
            raise ValueError("ends too early")

    def name(self) -> str:
        end = self.data.index(b"\0", self.at)
        text = os.fsdecode(self.data[self.at : end])
        self.skip(end + 1 - self.at)
        return text

    def end(self) -> None:
        if self.at != len(self.data):
            raise ValueError("has more than it states")


def _cameras_binary(path: Path) -> Iterator[tuple[int, ModelCamera]]:
    file = _Binary(path)
    for _ in range(file.take("Q")[0]):
        number, kind, width, height = file.take("IiQQ")
        name = pycolmap.CameraModelId(kind).name
        yield number, ModelCamera(name, width, height, file.take(f"{parameter_count(name)}d"))
    file.end()


def _images_binary(path: Path) -> Iterator[tuple[int, ModelImage]]:
    file = _Binary(path)
    for _ in range(file.take("Q")[0]):
        number, *pose, camera = file.take("I7dI")
        yield number, ModelImage(file.name(), camera, np.array(pose[:4]), np.array(pose[4:]))
        file.skip(24 * file.take("Q")[0])  # 2D points
    file.end()


def _points_binary(path: Path) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.uint8]]:
    file = _Binary(path)
    starts = []
    for _ in range(file.take("Q")[0]):
        starts.append(file.at)
        file.skip(43)  # number, position, colour, error
        file.skip(8 * file.take("Q")[0])  # track
    file.end()
    rows = np.frombuffer(file.data, np.uint8)[np.array(starts, int)[:, None] + np.arange(8, 35)]
    return rows[:, :24].copy().view("<f8").reshape(-1, 3), rows[:, 24:].copy()


def _lines(path: Path) -> Iterator[str]:
    with open(path, encoding=encoding_of(path), errors="surrogateescape") as file:
        for line in file:
            if not line.startswith("#"):
                yield line.strip()


def _cameras_text(path: Path) -> Iterator[tuple[int, ModelCamera]]:
    for line in filter(None, _lines(path)):
        number, model, width, height, *params = line.split()
        if parameter_count(model) is None:
            raise ValueError(f"COLMAP has no camera model {model}")
        yield int(number), ModelCamera(model, int(width), int(height), tuple(map(float, params)))


def _images_text(path: Path) -> Iterator[tuple[int, ModelImage]]:
    """The images; those of programs that leave the second line of an image out, too."""
    number = None
    for line in _lines(path):
        if number is not None and _are_observations(line):
            number = None
        elif line:
            words = line.split(maxsplit=9)
            if number is not None and len(words) < 10:
                raise ValueError(f"the 2D points of image {number} are no triples")
            number, *pose, camera, name = words
            numbers = np.array(list(map(float, pose)))
            yield int(number), ModelImage(name, int(camera), numbers[:4], numbers[4:])


def _are_observations(line: str) -> bool:
    """Whether it is the second line of an image: triples of numbers, or nothing."""
    words = line.split()
    try:
        return len(words) % 3 == 0 and all(math.isfinite(float(word)) for word in words)
    except ValueError:
        return False


def _points_text(path: Path) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.uint8], str]:
    """Positions, colours, and why there are none."""
    rows = [[float(word) for word in line.split(maxsplit=7)[1:7]] for line in _lines(path) if line]
    counts = {len(row) for row in rows}
    if not counts <= {3, 6} or len(counts) > 1:
        raise ValueError("a point has a number, three coordinates and three colours")
    values = np.array(rows).reshape(len(rows), -1)
    if values.shape[1] < 6:
        return values[:, :3].reshape(-1, 3), np.zeros((0, 3), np.uint8), "its points have none" * bool(rows)
    rgb = as_bytes(values[:, 3:], bool((values[:, 3:] % 1.0).any()))
    return (values[:, :3], np.zeros((0, 3), np.uint8), rgb) if isinstance(rgb, str) else (values[:, :3], rgb, "")
