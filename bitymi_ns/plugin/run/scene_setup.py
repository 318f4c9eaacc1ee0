"""The scene that training starts from, out of what nerfstudio hands to a model."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from nerfstudio.data.scene_box import SceneBox
from torch import Tensor

from bitymi_ns.plugin.data.point_files import reporting_time
from bitymi_ns.plugin.errors import fail, say, warn
from bitymi_ns.scene.config import SceneConfig
from bitymi_ns.scene.scene import Scene
from bitymi_ns.train import bounds
from bitymi_ns.train.config import TrainConfig
from bitymi_ns.train.domain import build_scene
from bitymi_ns.train.init import first_surfels_for

FEW_POINTS = 50
"""Number of points below which much of a scene may have none near it."""


def new_scene(
    points: tuple[Tensor, Tensor] | None,
    scene_box: SceneBox | None,
    config: SceneConfig,
    train: TrainConfig,
    metadata: dict[str, Any],
    steps: int | None = None,
) -> Scene:
    """Surfels at the capture's points, or at random in its box, and an empty texture field around them.

    Args:
        points: positions [N, 3] and colours [N, 3] (uint8, or empty when the cloud has none).
        scene_box: where random points are placed.
        config: the representation.
        train: training options.
        metadata: what the data manager says about the capture.
        steps: length of the run that is going to be made.
    """
    centers, pixels = metadata.get("camera_centers", torch.zeros(0, 3)), metadata.get("train_pixels", 0)
    if train.first_surfels is None and steps is not None and len(centers):
        train = replace(train, first_surfels=first_surfels_for(steps, pixels / len(centers)))
    xyz, rgb = _points(points)
    declared = _corners(scene_box) if metadata.get("declares_box") else None
    box = None
    if not bool(torch.isfinite(xyz).all(1).any()):
        box = _box_for_random_points(scene_box, len(xyz))
    try:
        with reporting_time("Making surfels of", len(xyz)):
            scene, report = build_scene(
                xyz,
                rgb,
                centers,
                config,
                train,
                bounded=metadata.get("has_alpha", False),
                image_pixels=pixels,
                box=box,
                declared=declared,
            )
    except ValueError as error:
        fail(str(error), error)
    for sentence in bounds.start(report, train, pixels, config):
        say(sentence)
    if report.random:
        say(f"Surfels are made of {report.random:,} random points.")
    usable = report.given - report.not_finite - report.duplicates
    if 0 < usable < FEW_POINTS:
        warn(
            f"The capture's point cloud has only {usable} different points to start from. If little appears, remove it "
            "(ply_file_path in transforms.json) to start from random points."
        )
    if report.not_finite:
        row = int(torch.nonzero(~torch.isfinite(xyz).all(1))[0])
        warn(
            f"{report.not_finite} of {report.given} points of the capture are NaN or infinite (the "
            f"first is point {row}); they are left out."
        )
    return scene


def _points(points: tuple[Tensor, Tensor] | None) -> tuple[Tensor, Tensor]:
    if points is None:
        return torch.zeros(0, 3), torch.zeros(0, 3)
    xyz, rgb = points
    xyz = xyz.detach().float().reshape(-1, 3)
    if rgb.shape[:1] != xyz.shape[:1]:
        return xyz, torch.full_like(xyz, 0.5)  # a cloud without colours
    return xyz, rgb.detach().float().reshape(-1, 3) / (255.0 if rgb.dtype == torch.uint8 else 1.0)


def _box_for_random_points(scene_box: SceneBox | None, given: int) -> Tensor | None:
    """[2, 3] corners."""
    if given:
        fail(
            f"all {given} points of the capture's point cloud are NaN or infinite. Make the cloud again, or remove "
            "ply_file_path from transforms.json to start from random points."
        )
    return None if scene_box is None else _corners(scene_box)


def _corners(scene_box: SceneBox) -> Tensor:
    """[2, 3]: low and high corner."""
    corners = scene_box.aabb.float().cpu().reshape(2, 3)
    low, high = corners
    if not bool(torch.isfinite(corners).all()) or not bool((high > low).all()):
        fail(
            f"the scene box of the capture, from {low.tolist()} to {high.tolist()}, is empty. Correct it in the "
            "capture's files; in nerfstudio's own format give a point cloud (ply_file_path in transforms.json) or a "
            "positive --scene-scale after `nerfstudio-data`."
        )
    return corners
