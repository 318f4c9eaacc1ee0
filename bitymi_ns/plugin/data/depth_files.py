"""Depth maps, their confidence, and normal maps in files, as programs and scanners write them."""

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from bitymi_ns.capture.masks import in_proportion
from bitymi_ns.plugin.console import fail, warn
from bitymi_ns.plugin.data.images import wrong_size
from bitymi_ns.plugin.data.lens import Lens
from bitymi_ns.plugin.data.map_headers import image_shape, read_array
from bitymi_ns.reading import reading
from bitymi_ns.train.views import spread

MAP_FILES = (".png", ".tif", ".tiff", ".npy", ".npz", ".exr")
"""Extensions of depth and normal maps."""
MILLIMETER = 1e-3
"""Metres of a unit of integer depth, where no other is stated: nerfstudio's convention."""
MAPS = "maps"
"""Metadata key of the `MapFiles` of each view."""
COLOR_SAMPLES = 8
"""Files of a scanner's depth that are tested for color pictures; all have to be."""
MOST_LARGER = 8
"""Sides of a map in those of its photograph, at most: photographs may be reduced copies."""
MOST_NUMBERS = 1 << 28
"""Numbers of a map, at most: those of 80 million normals, or 260 million depths."""
FARTHEST = 65504.0
"""Depth from which on a number stands for "no depth": the largest of half floats, below Blender's 1e10."""

Values = npt.NDArray[np.float32]


@dataclass(frozen=True)
class MapFiles:
    """Files with what is known of a photograph's pixels beside their colors; None = none.

    Attributes:
        depth: of camera z, see `read_depth`.
        confidence: of the depth, 0 = low, at most of the size of the depth.
        normal: see `read_normal`.
    """

    depth: Path | None = None
    confidence: Path | None = None
    normal: Path | None = None


def maps_called(folder: Path, depth: str, confidence: str) -> MapFiles:
    """Find the depth and confidence of a photograph by their names in a folder, without endings."""

    def find(name: str) -> Path | None:
        files = (folder / f"{name}{ending}" for ending in MAP_FILES)
        return next((file for file in files if file.is_file()), None)

    return MapFiles(find(depth), find(confidence))


def maps_beside(photographs: Sequence[Path]) -> list[MapFiles]:
    """Find the depth and confidence of a scanner's photographs: files of their names in `depth` and `confidence` beside
    their folder (Polycam, Record3D, ScanNet). A folder of color pictures is not used, with a warning."""

    found = [maps_called(path.parent.parent, f"depth/{path.stem}", f"confidence/{path.stem}") for path in photographs]
    depths = [files.depth for files in found if files.depth is not None]
    if depths and all(_is_color(depths[i]) for i in spread(len(depths), COLOR_SAMPLES)):
        warn(f"{depths[0].parent} is not used: it holds color pictures, not depth.")
        return [MapFiles()] * len(found)
    return found


def _is_color(path: Path) -> bool:
    """Test for an image of integers in channels that differ, which is no depth; a damaged one is none."""
    if path.suffix.lower() not in (".png", ".tif", ".tiff"):
        return False
    try:
        if math.prod(image_shape(path)) > MOST_NUMBERS:
            return False
        values = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    except Exception:  # of libraries on damaged files; what is wrong is said where it is read
        return False
    return values is not None and values.ndim == 3 and values.dtype.kind in "iu" and _channels_differ(values)


def _channels_differ(values: npt.NDArray[np.generic]) -> bool:
    return not bool((values[..., :3] == values[..., :1]).all())


def read_depth(files: MapFiles, lens: Lens, unit: float | None = None) -> Values:
    """Read camera z [H, W] for the pinhole picture of a photograph's lens; 0 = unknown. The map is resized to the
    photograph and undistorted by nearest neighbors.

    Integers count millimetres; 0 and the largest one are unknown. Floating-point numbers are metres; those that are not
    finite, not above 0, or 65,504 and more are unknown. So is what has confidence 0. `unit` is another length of a unit
    in metres.

    Raises:
        InputError: a file cannot be read, or has another shape than the photograph.
    """
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
    """Read normals [H, W, 3] for the pinhole picture of a lens, in its frame (OpenCV axes); 0 = unknown.

    Files hold them in the camera frame of transforms.json (x right, y up, z back): floating-point numbers x, y, z, or
    colors (n + 1) / 2, of which black is unknown.

    Raises:
        InputError: a file cannot be read, or has another shape than the photograph.
    """
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


def _read(path: Path, photograph: tuple[int, int], alike: bool = True) -> npt.NDArray[np.generic]:
    """Read an array [H, W] or [H, W, C]; color channels in the order red, green, blue. Its header is compared with the
    width and height of the photograph before its numbers are read; `alike`: it must have the shape of that, too."""

    def check(shape: tuple[int, ...]) -> None:
        if len(shape) not in (2, 3) or min(shape) < 1:
            fail(f"{path} is no map of numbers, but declares {list(shape)} of them. {_WITHOUT}")
        size = (shape[1], shape[0])
        if alike and not in_proportion(size, photograph):
            fail(wrong_size(path, size, photograph))
        if max(size[0] / photograph[0], size[1] / photograph[1]) > MOST_LARGER or math.prod(shape) > MOST_NUMBERS:
            fail(
                f"{path} declares {' x '.join(map(str, shape))} numbers for a photograph of {photograph[0]} x "
                f"{photograph[1]} pixels: at most {MOST_LARGER} times its sides, and {MOST_NUMBERS:,}, are read. "
                f"{_WITHOUT}"
            )

    with reading(path, fail, _WITHOUT):
        if path.suffix.lower() in (".npy", ".npz"):
            values = read_array(path, check)
            values = values[..., 0] if values.ndim == 3 and values.shape[-1] == 1 else values
        else:
            check(image_shape(path))
            os.environ.setdefault("OPENCV_IO_ENABLE_OPENEXR", "1")  # OpenCV has the reader, switched off
            values = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
            if values is None:
                raise ValueError("it is no image that OpenCV reads")
            check(values.shape)
            if values.ndim == 3:
                values = values[..., [2, 1, 0] if _channels_differ(values) else 0]  # grey: depth, as a program wrote it
    if values.dtype.kind not in "iuf":
        fail(f"{path} is no map of numbers, but of {values.dtype}. {_WITHOUT}")
    return values.astype(np.float32) if values.dtype.itemsize > 4 or values.dtype == np.float16 else values
