"""Read maps of depth, confidence and normals, as programs and scanners write them."""

import math
import os
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from operator import attrgetter
from pathlib import Path
from typing import IO, Any
from zipfile import ZipFile

import cv2
import numpy as np
import numpy.typing as npt
from PIL import TiffImagePlugin

from bitymi_ns.ranges import spread
from bitymi_ns.safe_reading import open_regular
from .folder_contents import open_picture
from .image_files import wrong_size
from .lens import Lens
from .masks import in_proportion
from .types import MAP_FILES, MapFiles, fail, parsing, warn

MILLIMETER = 1e-3  # metres per unit of integer depth: nerfstudio's convention
COLOR_SAMPLES = 8  # files of a folder of depth that are tested for being color pictures
MOST_LARGER = 8  # largest ratio of a map's side to its photograph's, which may be reduced
MOST_NUMBERS = 1 << 28  # of a map
FARTHEST = 65504.0  # no depth from here on: the largest half float, below Blender's 1e10

EXR_HEADER = 1 << 24  # most bytes of a header
EXR_ATTRIBUTES = ("channels", "compression", "dataWindow", "displayWindow", "lineOrder", "pixelAspectRatio")

Check = Callable[[tuple[int, ...]], None]  # raises if an array of this shape must not be read
TIFFS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
# damaged maps get our message only
attrgetter("setLogLevel" if hasattr(cv2, "setLogLevel") else "utils.logging.setLogLevel")(cv2)(0)
_PARSING = threading.Lock()  # numpy's ast.literal_eval fails in threads of Python 3.11

Values = npt.NDArray[np.float32]


def maps_called(folder: Path, depth: str, confidence: str) -> MapFiles:
    def find(name: str) -> Path | None:
        files = (folder / f"{name}{ending}" for ending in MAP_FILES)
        return next((file for file in files if os.path.isfile(file)), None)

    return MapFiles(find(depth), find(confidence))


def maps_beside(photographs: Sequence[Path]) -> list[MapFiles]:
    """Find maps of a scanner's photographs beside their folder; warn of color pictures, which are not used."""
    maps = [maps_called(path.parent.parent, f"depth/{path.stem}", f"confidence/{path.stem}") for path in photographs]
    depths = [files.depth for files in maps if files.depth is not None]
    if depths and all(_is_color(depths[i]) for i in spread(len(depths), COLOR_SAMPLES)):
        warn(f"{depths[0].parent} is not used: it holds color pictures, not depth.")
        return [MapFiles()] * len(maps)
    return maps


def _is_color(path: Path) -> bool:
    """Test for an integer image whose channels differ."""
    with suppress(Exception):  # damaged files are reported when they are read
        if path.suffix.lower() in (".png", ".tif", ".tiff") and math.prod(image_shape(path)) <= MOST_NUMBERS:
            values = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
            return values is not None and values.ndim == 3 and values.dtype.kind in "iu" and _channels_differ(values)
    return False


def _channels_differ(values: npt.NDArray[Any]) -> bool:
    return not bool((values[..., :3] == values[..., :1]).all())


def read_depth(files: MapFiles, lens: Lens, unit: float | None = None) -> Values:
    """Read camera z [H, W] for the pinhole picture of a lens, by nearest neighbors; 0 = unknown. Integers are
    millimetres and floats metres, unless `unit` gives metres; 0, the largest integer, floats from FARTHEST and
    confidence 0 mean unknown. Raises CaptureError: a file cannot be read, or has another shape."""
    assert files.depth is not None
    stored = _read(files.depth, lens.stored)
    if stored.ndim != 2:
        fail(f"the depth map {files.depth} has {stored.shape[2]} channels: write depth as one. {_WITHOUT}")
    whole = stored.dtype.kind in "iu"
    values = stored.astype(np.float32)
    known = np.isfinite(values) & (values > 0.0) & (values < (np.iinfo(stored.dtype).max if whole else FARTHEST))
    if files.confidence is not None:
        confidence = _read(files.confidence, lens.stored, alike=False)
        known &= cv2.resize(confidence, stored.shape[::-1], interpolation=cv2.INTER_NEAREST_EXACT) != 0
    scale = unit if unit is not None else MILLIMETER if whole else 1.0
    return lens.undistort_map(np.where(known, values * np.float32(scale), np.float32(0.0)), files.depth)


def read_normal(files: MapFiles, lens: Lens) -> Values:
    """Read normals [H, W, 3] for the pinhole picture of a lens, in its frame (OpenCV axes); 0 = unknown. Files hold
    them in the camera's OpenGL axes, as floats, or colors (n + 1) / 2 with black for unknown. Raises CaptureError."""
    assert files.normal is not None
    stored = _read(files.normal, lens.stored)
    if stored.ndim != 3 or stored.shape[2] < 3:
        fail(f"the normal map {files.normal} has no three channels. {_WITHOUT}")
    normal = stored[..., :3].astype(np.float32)
    if stored.dtype.kind in "iu":
        black = (stored[..., :3] == 0).all(-1, keepdims=True)
        normal = np.where(black, 0.0, normal * np.float32(2.0 / np.iinfo(stored.dtype).max) - 1.0)
    return lens.undistort_map((normal * (1.0, -1.0, -1.0)).astype(np.float32), files.normal)


_WITHOUT = "Write it again, or train without: `bitymi-data --depth off`."


def _read(path: Path, photograph: tuple[int, int], alike: bool = True) -> npt.NDArray[Any]:
    """Read an array [H, W] or [H, W, C] of RGB order; check its size before, if `alike` also its aspect ratio."""

    def check(shape: tuple[int, ...]) -> None:
        if len(shape) not in (2, 3) or min(shape) < 1:
            fail(f"{path} is no map of numbers, but declares {list(shape)} of them. {_WITHOUT}")
        size = (shape[1], shape[0])
        if alike and not in_proportion(size, photograph):
            fail(wrong_size(path, size, photograph))
        if max(size[0] / photograph[0], size[1] / photograph[1]) > MOST_LARGER or math.prod(shape) > MOST_NUMBERS:
            declares = f"{path} declares {' x '.join(map(str, shape))} numbers for a photograph of"
            limits = f"at most {MOST_LARGER} times its sides, and {MOST_NUMBERS:,} numbers, are read"
            fail(f"{declares} {photograph[0]} x {photograph[1]} pixels: {limits}. {_WITHOUT}")

    with parsing(path, _WITHOUT):
        if path.suffix.lower() in (".npy", ".npz"):
            values = read_array(path, check)
            values = values[..., 0] if values.ndim == 3 and values.shape[-1] == 1 else values
        else:
            values = (_read_exr if path.suffix.lower() == ".exr" else _read_by_opencv)(path, check)
            check(values.shape)
            if values.ndim == 3 and not _channels_differ(values):
                values = values[..., 0]  # depth, written as grey
    if values.dtype.kind not in "iuf":
        fail(f"{path} is no map of numbers, but of {values.dtype}. {_WITHOUT}")
    return values.astype(np.float32) if values.dtype.itemsize > 4 or values.dtype == np.float16 else values


def _read_by_opencv(path: Path, check: Check) -> npt.NDArray[Any]:
    check(image_shape(path))
    values = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if values is None:
        raise ValueError("it is no image that OpenCV reads")
    return values if values.ndim == 2 else values[..., 2::-1]  # BGR, BGRA


def _read_exr(path: Path, check: Check) -> npt.NDArray[Any]:
    import OpenEXR  # OpenCV 5 reads no such files, and 4 reads a channel Z as zeros

    with open_regular(path) as file:
        _check_exr_header(file)
        image = OpenEXR.InputFile(file)
        box, channels = image.header()["dataWindow"], image.header()["channels"]
        shape = (box.max.y - box.min.y + 1, box.max.x - box.min.x + 1)
        check(shape)
        kinds = {name: ("u4", "f2", "f4")[channel.type.v] for name, channel in channels.items()}
        names = next(wanted for wanted in ("RGB", "Y", "Z", list(kinds)) if kinds.keys() >= set(wanted))
        if len(names) != 1 and names != "RGB":
            raise ValueError(f"R, G and B, Y, Z or a single channel are read, and it has {', '.join(kinds)}")
        planes = zip(names, image.channels(list(names)), strict=True)
        values = np.stack([np.frombuffer(plane, kinds[name]).reshape(shape) for name, plane in planes], axis=-1)
    return values if len(names) == 3 else values[..., 0]


def _check_exr_header(file: IO[bytes]) -> None:
    """Raise ValueError if the header lacks a required attribute: OpenEXR crashes on such files."""
    data, start, names = file.read(EXR_HEADER), 8, set()
    file.seek(0)
    while data[start : start + 1] not in (b"", b"\0"):
        end = data.index(b"\0", start)
        kind = data.index(b"\0", end + 1)
        names.add(data[start:end].decode("latin1"))
        start = kind + 5 + int.from_bytes(data[kind + 1 : kind + 5], "little")
    if missing := [name for name in EXR_ATTRIBUTES if name not in names]:
        raise ValueError(f"its header has no {missing[0]}")


def read_array(path: Path, check: Check) -> npt.NDArray[Any]:
    """Read a .npy file, or the first array of a .npz file. Raises OSError, ValueError, or what `check` does."""
    with open_regular(path) as file:
        if path.suffix.lower() != ".npz":
            return _array(file, check)
        with ZipFile(file) as archive, archive.open(archive.namelist()[0]) as part:
            return _array(part, check)


def _array(file: IO[bytes], check: Check) -> npt.NDArray[Any]:
    version = np.lib.format.read_magic(file)
    if version not in ((1, 0), (2, 0)):
        raise ValueError(f"it is of version {version[0]} of the format, which is for tables")
    read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    with _PARSING:
        shape, by_columns, dtype = read_header(file)
    if dtype.kind not in "iuf":
        raise ValueError(f"it holds no numbers, but {dtype}")
    check(shape)
    count = math.prod(shape) * dtype.itemsize
    data = file.read(count)
    if len(data) < count:
        raise ValueError(f"it is cut off: it has {len(data)} of {count} bytes")
    return np.frombuffer(data, dtype).reshape(shape, order="F" if by_columns else "C")


def image_shape(path: Path) -> tuple[int, int]:
    """Read height and width of an image from its header. Raises OSError, ValueError: it is none."""
    with open_regular(path) as file:
        start = file.read(16)
        if start.startswith(TIFFS):
            entries = TiffImagePlugin.ImageFileDirectory_v2(start if start[2:4] in (b"+\0", b"\0+") else start[:8])
            file.seek(entries.next)
            entries.load(file)
            return int(entries[TiffImagePlugin.IMAGELENGTH]), int(entries[TiffImagePlugin.IMAGEWIDTH])
    with open_picture(path) as image:
        return image.size[1], image.size[0]
