"""Read a capture without nerfstudio, moved and scaled as nerfstudio does it."""

from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

import bitymi_ns
from bitymi_ns.train.views import View


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
    """Read a capture, translated and scaled as in nerfstudio: the mean of the cameras is the origin, and their largest
    coordinate is 1. The orientation is kept.

    Args:
        path: a folder or file, see `bitymi_ns.load_capture`; of Blender's, the first *_pc.ply has the points.
        downscale: integer factor by which photographs are downscaled.

    Raises:
        CaptureError: it cannot be read.
    """
    blender = (path / "transforms_train.json").exists()
    cloud = next(iter(sorted(path.glob("*_pc.ply"))), None) if blender else None
    given = {} if cloud is None else {"ply_path": cloud.absolute()}
    train, points, colours = bitymi_ns.load_capture(path, "train", downscale_factor=downscale, **given)
    held_out, *_ = bitymi_ns.load_capture(path, "test", downscale_factor=downscale, points="random")
    centers = torch.stack([view.camera.center.double() for view in (*train, *held_out)])
    middle = centers.mean(0)
    scale = 1.0 / float((centers - middle).abs().max())

    def moved(view: View) -> View:
        viewmat = view.camera.viewmat.double()
        viewmat[:3, 3] = (viewmat[:3, 3] + viewmat[:3, :3] @ middle) * scale
        return view._replace(camera=replace(view.camera, viewmat=viewmat.float()))

    points = ((points.double() - middle) * scale).float()
    return Capture(list(map(moved, train)), list(map(moved, held_out)), points, colours, blender)
