"""Read photographs with poses of scanning programs, and of folders with a text file per pose (ScanNet, 7-Scenes)."""

import csv
from collections.abc import Callable, Sequence
from io import StringIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from bitymi_ns.progress import rich_progress
from bitymi_ns.safe_reading import read_json, read_text
from bitymi_ns.trust import listed
from .depth_normal_maps import MapFiles, maps_beside, maps_called
from .folder_contents import photographs_in
from .image_files import image_size, in_proportion, wrong_size
from .order import natural
from .pose_checks import rotations
from .recognise import POLYCAM, STRAY, Found
from .transforms import MAX_SIDE
from .types import OPENCV_AXES, ColmapCamera, Photograph, Pose, fail, parsing, warn


class ScannedPhotograph(NamedTuple):
    file: Path
    pose: Pose  # in nerfstudio's axes
    pinhole: tuple[float, ...]  # fx, fy, cx, cy
    size: tuple[int, int] | None = None  # of pinhole's image; None = the file's
    maps: MapFiles | None = None  # None = maps in folders beside the photographs' folder


AGAIN = "Export the capture again."
MOST_POSE = 1 << 20  # bytes of a pose or a camera
Y_UP = np.array([[0.0, 0.0, 1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
"""Transform of ARKit's world, y up, to z up."""


def scanner_photographs(found: Found) -> list[Photograph]:
    """Read photographs with cameras and poses by name. Raises CaptureError: a file is damaged."""
    readers: dict[str, Callable[[Path], list[ScannedPhotograph]]] = {
        "polycam": _polycam, "record3d": _record3d, "pose-files": _pose_files,
        "3d-scanner": _scanner_app, "stray-scanner": _stray_scanner,
    }  # fmt: skip
    rows = readers[found.format](found.path)
    what = f"{found.path}, read as {found.format},"
    for row in rows:
        sides = row.size or ()
        if not np.isfinite([*row.pose.ravel(), *row.pinhole]).all() or not all(1 <= side <= MAX_SIDE for side in sides):
            fail(f"{what} is damaged: the pose, camera or size of {row.file.name} is not finite, or 0. {AGAIN}")
    if len(rows) < 2:
        fail(f"{what} has {len(rows)} photographs with poses: a scene needs many.")
    files = [row.file for row in rows]
    parts = rotations(np.stack([row.pose[:3, :3] for row in rows]), [file.name for file in files], str(found.path))
    result = []
    for (path, pose, pinhole, stated, own), rotation, beside in zip(rows, parts, maps_beside(files), strict=True):
        pose = pose.copy()
        pose[:3, :3] = rotation
        size = image_size(path) or stated or (1, 1)
        camera = ColmapCamera("PINHOLE", *(stated or size), pinhole)
        if not in_proportion(camera.size, size):
            fail(wrong_size(path, size, camera.size))
        result.append(Photograph(path, camera.rescaled(*size), pose, f"the camera of {path}", maps=own or beside))
    return result


def _polycam(folder: Path) -> list[ScannedPhotograph]:
    """Read Polycam's cameras and images, the corrected ones if there are any."""
    folders = ((base / i, base / c) for base in (folder / "keyframes", folder) for i, c in POLYCAM)
    images, cameras = next((i, c) for i, c in folders if i.is_dir() and any(c.glob("*.json")))
    rows, pictures = [], _images(images)
    for path in sorted(cameras.glob("*.json"), key=lambda path: natural(path.name)):
        with parsing(path, AGAIN):
            values = read_json(path)
            pose = np.eye(4)
            pose[:3] = [[float(values[f"t_{i}{j}"]) for j in range(4)] for i in range(3)]
            size = (int(values["width"]), int(values["height"])) if "width" in values else None  # since late in 2025
            pinhole = tuple(float(values[name]) for name in ("fx", "fy", "cx", "cy"))
        picture = pictures.get(path.stem, images / f"{path.stem}.jpg")
        rows.append(ScannedPhotograph(picture, Y_UP @ pose, pinhole, size))
    return rows


def _record3d(folder: Path) -> list[ScannedPhotograph]:
    """Read Record3D's metadata: one camera or one per image, and poses as quaternions xyzw and positions."""
    path = folder / "metadata" if (folder / "metadata").is_file() else folder / "metadata.json"
    with parsing(path, AGAIN):
        values = read_json(path)
        K, size = [float(x) for x in values["K"]], (int(values["w"]), int(values["h"]))
        camera = (K[0], K[4], K[6], K[7])
        own: Sequence[Any] = values.get("perFrameIntrinsicCoeffs") or ()
        poses: Sequence[Any] = list(values["poses"])
    files = _images(folder, "rgb", "rgbd", "images")
    rows = []
    for i, numbers in enumerate(poses):
        with parsing(f"{path}: pose {i} (counted from 0)", AGAIN):
            pose = _pose(_numbers(numbers, 7))
            pinhole = tuple(_numbers(own[i][:4], 4)) if i < len(own) else camera
        if str(i) in files:  # Record3D can export every n-th image
            rows.append(ScannedPhotograph(files[str(i)], Y_UP @ pose, pinhole, size))
    return rows


def _scanner_app(folder: Path) -> list[ScannedPhotograph]:
    """Read 3D Scanner App's frames: JSON files of row-major matrices; for some a picture, depth and confidence."""
    rows, pictures = [], _images(folder)
    for path in sorted(folder.glob("frame_*.json"), key=lambda path: natural(path.name)):
        if path.stem not in pictures:
            continue
        with parsing(path, AGAIN):
            values = read_json(path)
            pose: Pose = np.array(_numbers(values["cameraPoseARFrame"], 16)).reshape(4, 4)
            fx, _, cx, _, fy, cy, *_ = _numbers(values["intrinsics"], 9)
        maps = maps_called(folder, *(path.stem.replace("frame", kind) for kind in ("depth", "conf")))
        rows.append(ScannedPhotograph(pictures[path.stem], Y_UP @ pose, (fx, fy, cx, cy), maps=maps))
    return rows


def _stray_scanner(folder: Path) -> list[ScannedPhotograph]:
    """Read Stray Scanner's camera matrix, video and poses: positions and quaternions xyzw, with OpenCV axes."""
    from .video import frames_with_poses  # slow to import

    odometry, matrix, video = (folder / name for name in STRAY)
    with parsing(matrix, AGAIN):
        K = np.loadtxt(StringIO(read_text(matrix, MOST_POSE)), delimiter=",").reshape(3, 3)
    with parsing(odometry, AGAIN):
        lines = csv.DictReader(StringIO(read_text(odometry)))
        poses = [{str(name).strip(): value for name, value in line.items()} for line in lines]
    with rich_progress() as progress:
        images = frames_with_poses(video, len(poses), progress, warn)
    rows = []
    for file in sorted(images.iterdir()):
        number = int(file.stem.removeprefix("frame_"))
        if number >= len(poses):  # the app ended while it wrote
            continue
        with parsing(f"{odometry}: pose {number} (counted from 0)", AGAIN):
            pose = _pose([float(poses[number][name]) for name in ("qx", "qy", "qz", "qw", "x", "y", "z")])
            name = f"{int(poses[number]['frame']):06d}"
        maps = maps_called(folder, f"depth/{name}", f"confidence/{name}")
        rows.append(ScannedPhotograph(file, Y_UP @ pose @ OPENCV_AXES, (K[0, 0], K[1, 1], K[0, 2], K[1, 2]), maps=maps))
    return rows


def _pose_files(folder: Path) -> list[ScannedPhotograph]:
    """Read color/NAME.png with pose/NAME.txt, or NAME.color.png with NAME.pose.txt: 4 x 4, OpenCV axes, NaN = none."""
    pinhole = _intrinsics(folder)
    files = {stem.removesuffix(".color"): file for stem, file in _images(folder, "color", "rgb", "images").items()}
    poses, rows, lost = folder / "pose" if (folder / "pose").is_dir() else folder, [], []
    for path in sorted(poses.glob("*.txt"), key=lambda path: natural(path.name)):
        name = path.stem.removesuffix(".pose")
        if name not in files:
            continue
        with parsing(path, AGAIN):
            pose = np.loadtxt(StringIO(read_text(path, MOST_POSE))).reshape(4, 4)
        if np.isfinite(pose).all():
            rows.append(ScannedPhotograph(files[name], pose @ OPENCV_AXES, pinhole))
        else:
            lost.append(name)
    if lost:
        warn(f"{len(lost)} photographs of {folder} have no pose, and are left out: {listed(lost)}.")
    return rows


def _intrinsics(folder: Path) -> tuple[float, ...]:
    """Read fx, fy, cx, cy from a matrix, also in one line, from four numbers, or from NSVF's f, cx and cy."""
    names = ("intrinsic/intrinsic_color.txt", "intrinsics_color.txt", "intrinsic_color.txt", "intrinsics.txt",
             "intrinsic.txt", "camera-intrinsics.txt", "calibration.txt", "../camera-intrinsics.txt")  # fmt: skip
    path = next((folder / name for name in names if (folder / name).is_file()), None)
    if path is None:
        advice = "Write its matrix there, a row per line, or compute poses: `bitymi-data --format photographs`."
        fail(f"{folder} has poses, but no file with the camera ({', '.join(names[:4])}). {advice}")
    with parsing(path, AGAIN):
        rows = [[float(word) for word in line.split()] for line in read_text(path, MOST_POSE).splitlines()]
        first, *more = filter(None, rows)
        if not more and len(first) in (9, 16):
            first, *more = np.reshape(first, (3 if len(first) == 9 else 4, -1)).tolist()
        if more and min(len(first), len(more[0])) >= 3 and more[0][1]:
            return first[0], more[0][1], first[2], more[0][2]
        fx, fy, cx, cy = first if len(first) == 4 and first[3] else (first[0], *first[:3])
        return fx, fy, cx, cy


def _images(folder: Path, *names: str) -> dict[str, Path]:
    """List photographs by stem in the first of these subfolders, or in the folder itself."""
    images = next((folder / name for name in names if (folder / name).is_dir()), folder)
    return {file.stem: file for file in photographs_in(images)}


def _pose(values: Sequence[float]) -> Pose:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_quat(values[:4]).as_matrix(), values[4:]
    return pose


def _numbers(values: Any, count: int) -> list[float]:
    """Convert to `count` floats, else raise ValueError: numpy would repeat or drop some."""
    numbers = [float(value) for value in values]
    if len(numbers) != count:
        raise ValueError(f"it has {len(numbers)} numbers, not {count}")
    return numbers
