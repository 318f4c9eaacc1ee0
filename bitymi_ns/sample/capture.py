"""Render the sample room along a camera path and write it as a nerfstudio capture."""

import json
from contextlib import suppress
from itertools import count
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image as PILImage

from bitymi_ns.capture.image_files import in_threads
from bitymi_ns.capture.lens import Pinhole
from bitymi_ns.files import complete_folder
from bitymi_ns.ply import write_cloud
from bitymi_ns.progress import Progress, no_progress
from bitymi_ns.safe_reading import read_json
from bitymi_ns.trust import check_replaceable
from .room import Room

FOCAL = 0.80  # focal length in image widths
BAND = 1 << 16  # rays traced at a time
CAPTURE, CLOUD = "transforms.json", "sparse_pc.ply"
MADE_BY = "bitymi sample"  # in transforms.json of folders that may be overwritten


class RoomView(NamedTuple):
    """A pinhole camera: camera-to-world [4, 4] with OpenGL axes (x right, y up, z backward), pixels."""

    camera_to_world: NDArray[np.float64]
    focal: float
    width: int
    height: int

    def rays(self, supersample: int = 1) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Compute the origin [3, 1] and unit directions [3, H s W s] of rays through s by s subpixel centres."""
        focal, w, h = supersample * self.focal, supersample * self.width, supersample * self.height
        d = Pinhole(focal, focal, w / 2, h / 2, w, h).rays * (1, -1, -1) @ self.camera_to_world[:3, :3].T
        d /= np.linalg.norm(d, axis=-1, keepdims=True)
        return self.camera_to_world[:3, 3:].astype(np.float32), np.ascontiguousarray(d.reshape(-1, 3).T, np.float32)


def look_at(eye: NDArray[np.float64], target: NDArray[np.float64]) -> NDArray[np.float64]:
    """Compute camera-to-world [4, 4], OpenGL axes, of a camera at `eye` facing `target`, with z up."""
    back = eye - target
    back /= np.linalg.norm(back)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3] = np.stack([right, np.cross(back, right), back, eye], axis=1)
    return matrix


def camera_path(views: int, width: int, height: int, seed: int) -> list[RoomView]:
    """Generate two orbits around the objects, at varying heights, towards targets with random offsets."""
    s = (np.arange(views) + 0.5) / views
    angle, reach = 4 * np.pi * s, 1 + 0.10 * np.sin(7 * 2 * np.pi * s)
    z = np.where(s < 0.5, 0.75, 1.55) + 0.30 * np.sin(5 * 2 * np.pi * s)
    eyes = np.stack([2.25 * reach * np.cos(angle), 1.75 * reach * np.sin(angle), z], axis=1)
    targets = [0.0, 0.0, 0.72] + np.random.default_rng([seed, 1]).uniform(-0.25, 0.25, (views, 3))
    poses = [look_at(eye, target) for eye, target in zip(eyes, targets, strict=True)]
    return [RoomView(pose, FOCAL * width, width, height) for pose in poses]


def render(room: Room, view: RoomView, supersample: int = 3) -> NDArray[np.uint8]:
    """Render a view with antialiasing: [H, W, 3]."""
    o, directions = view.rays(supersample)
    bands = np.split(directions, range(BAND, directions.shape[1], BAND), axis=1)
    color = np.concatenate([room.color(o, d) for d in bands])
    color = color.reshape(view.height, supersample, view.width, supersample, 3).mean(axis=(1, 3))
    return (color * 255 + 0.5).astype(np.uint8)


def first_hits(
    room: Room, view: RoomView, pixels: NDArray[np.int64]
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.int8]]:
    """Trace the centres of pixels, flat indices [n]: world points [n, 3], distances [n] and surfaces [n]."""
    o, directions = view.rays()
    d = directions.take(pixels, 1)
    t, surfaces = room.hit(o, d)
    return (o + t * d).T, t, surfaces


def sparse_points(
    room: Room, views: list[RoomView], images: list[NDArray[np.uint8]], count: int, seed: int
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Sample exact surface points [count, 3] with their pixels' colors [count, 3], more where a view has corners, as
    structure from motion does."""
    rng = np.random.default_rng([seed, 2])
    points, colors = [], []
    shares = np.diff(np.linspace(0, count, len(views) + 1).astype(int))
    for view, image, share in zip(views, images, shares, strict=True):
        corners = cv2.cornerMinEigenVal(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), 3).ravel().astype(float)
        weights = np.sqrt(np.maximum(corners, 1e-3 * corners.max() + 1e-12))  # eigenvalues round below 0
        pixels = rng.choice(len(weights), share, replace=share > len(weights), p=weights / weights.sum())
        points.append(first_hits(room, view, pixels)[0])
        colors.append(image.reshape(-1, 3)[pixels])
    return np.concatenate(points), np.concatenate(colors)


def generate(
    output_dir: Path,
    views: int = 60,
    width: int = 320,
    height: int = 240,
    seed: int = 0,
    points: int = 8000,
    overwrite: bool = False,
    progress: Progress = no_progress,
) -> Path:
    """Write transforms.json, images and sparse_pc.ply to a folder, whole or not at all, and return it. Equal arguments
    give equal files. Raises ValueError: an argument is too small; FileExistsError: the folder holds other files, or
    `overwrite` is False; NotADirectoryError: it is a file."""
    limits = {"views": (views, 1), "width": (width, 8), "height": (height, 8), "points": (points, 0), "seed": (seed, 0)}
    for name, (value, least) in limits.items():
        if value < least:
            raise ValueError(f"{name} must be at least {least}, got {value}")
    output_dir = Path(output_dir).absolute()

    def check() -> None:
        files = None
        with suppress(FileNotFoundError, NotADirectoryError, ValueError, AttributeError):
            if read_json(output_dir / CAPTURE).get("made_by") == MADE_BY:
                images = (output_dir / "images").glob("frame_[0-9][0-9][0-9][0-9][0-9].png")
                files = [CAPTURE, CLOUD, *(f"images/{path.name}" for path in images)]
        check_replaceable(output_dir, "a sample capture", files, overwrite, FileExistsError)

    path, done = camera_path(views, width, height, seed), count(1)
    names = [f"images/frame_{k + 1:05d}.png" for k in range(views)]
    with complete_folder(output_dir, check) as new:
        (new / "images").mkdir()
        room = Room(seed)

        def frame(k: int) -> NDArray[np.uint8]:
            image = render(room, path[k])
            PILImage.fromarray(image).save(new / names[k])
            progress("Rendering the sample room", next(done), views)
            return image

        write_cloud(new / CLOUD, *sparse_points(room, path, in_threads(frame, range(views)), points, seed))
        poses = [view.camera_to_world.tolist() for view in path]
        frames = [{"file_path": name, "transform_matrix": p} for name, p in zip(names, poses, strict=True)]
        meta = {
            **{"made_by": MADE_BY, "camera_model": "OPENCV", "w": width, "h": height},
            **{"fl_x": FOCAL * width, "fl_y": FOCAL * width, "cx": width / 2, "cy": height / 2},
            **dict.fromkeys(("k1", "k2", "p1", "p2"), 0.0),
            **{"ply_file_path": CLOUD, "frames": frames},
        }
        (new / CAPTURE).write_text(json.dumps(meta, indent=1) + "\n", encoding="utf-8")
    return output_dir
