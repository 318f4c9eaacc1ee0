"""Reader of undistorted captures without nerfstudio, from transforms.json or Blender's files: photographs, poses and
points."""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from bitymi_ns.ply import read_header, read_rows
from bitymi_ns.scene.camera import Camera
from bitymi_ns.train.views import View

HELD_OUT = 8


@dataclass
class Capture:
    """A capture for training."""

    train: list[View]
    held_out: list[View]  # every `HELD_OUT`-th photograph, including the first
    points: Tensor  # [M, 3] sparse points
    colours: Tensor  # [M, 3] in [0, 1]
    white: bool = False  # evaluate images with alpha over white, as for Blender's captures

    @property
    def views(self) -> list[View]:
        """All views."""
        return [*self.train, *self.held_out]


def load_capture(path: Path, downscale: int = 1) -> Capture:
    """Read an undistorted capture, translated and scaled as in nerfstudio: the mean of the cameras is the origin, and
    their largest coordinate is 1. The orientation is kept.

    Args:
        path: a folder with transforms.json, or such a file; or a folder with Blender's transforms_train.json,
            transforms_test.json (held out) and *_pc.ply.
        downscale: integer factor by which photographs are downscaled.

    Raises:
        ValueError: the images have lens distortion, or the point cloud is damaged.
    """
    folder = path if path.is_dir() else path.parent
    file = folder / "transforms.json" if path.is_dir() else path
    blender = not file.exists()
    if blender:
        frames, counts = [], []
        for part in ("train", "test"):
            meta = json.loads((folder / f"transforms_{part}.json").read_text("utf8"))
            frames += [{**frame, "file_path": f"{frame['file_path']}.png"} for frame in meta["frames"]]
            counts.append(len(meta["frames"]))
        held_out = list(range(counts[0], sum(counts)))
        cloud = next(iter(sorted(folder.glob("*_pc.ply"))), None)
    else:
        meta = json.loads(file.read_text("utf8"))
        frames = sorted(meta["frames"], key=lambda frame: frame["file_path"])
        held_out = list(range(0, len(frames), HELD_OUT))
        cloud = folder / meta["ply_file_path"] if "ply_file_path" in meta else None
    poses = torch.tensor(
        [frame["transform_matrix"] for frame in frames], dtype=torch.float64
    )  # camera to world, OpenGL
    middle = poses[:, :3, 3].mean(0)
    scale = 1.0 / float((poses[:, :3, 3] - middle).abs().max())
    views = []
    for frame, pose in zip(frames, poses, strict=True):
        values = {**meta, **frame}
        if any(float(values.get(k, 0)) for k in ("k1", "k2", "k3", "k4", "p1", "p2")):
            raise ValueError(f"{path}: the images have lens distortion; undistort the capture first")
        image = Image.open(folder / frame["file_path"])
        if blender:
            w, h = image.size
            focal = 0.5 * w / math.tan(0.5 * meta["camera_angle_x"])
            values |= {"w": w, "h": h, "fl_x": focal, "fl_y": focal, "cx": 0.5 * w, "cy": 0.5 * h}
        image = image.convert("RGBA" if "A" in image.mode else "RGB")
        size = (image.width // downscale, image.height // downscale)
        picture = torch.from_numpy(np.array(image if downscale == 1 else image.resize(size, Image.Resampling.BOX)))
        views.append(View(_camera(values, pose, middle, scale, *size), picture))
    points, colours = (torch.zeros(0, 3),) * 2 if cloud is None else _points(cloud)
    points = ((points.double() - middle) * scale).float()
    kept = set(held_out)
    train = [view for i, view in enumerate(views) if i not in kept]
    return Capture(train, [views[i] for i in held_out], points, colours, blender)


def _camera(values: dict[str, Any], pose: Tensor, middle: Tensor, scale: float, width: int, height: int) -> Camera:
    rotation = pose[:3, :3] * torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = rotation.T
    viewmat[:3, 3] = -rotation.T @ ((pose[:3, 3] - middle) * scale)
    x, y = width / values["w"], height / values["h"]
    K = torch.tensor([[values["fl_x"] * x, 0, values["cx"] * x], [0, values["fl_y"] * y, values["cy"] * y], [0, 0, 1]])
    return Camera(viewmat.float(), K.float(), width, height)


def _points(path: Path) -> tuple[Tensor, Tensor]:
    """Read positions and colours of a PLY file with uint8 colours."""
    rows = read_rows(path, read_header(path), "vertex")
    xyz, rgb = (
        np.stack([rows[name] for name in group], axis=1).astype(np.float64)
        for group in (("x", "y", "z"), ("red", "green", "blue"))
    )
    return torch.from_numpy(xyz).float(), torch.from_numpy(rgb / 255).float()
