"""The named cases of numbers that misbehave, each with the errors that float32 may have on it."""

from __future__ import annotations

from dataclasses import dataclass

from bitymi_ns.measure.stability.scenes import SceneCase, extreme_scenes
from bitymi_ns.measure.stability.ways import PLAIN, Way


@dataclass(frozen=True)
class Case:
    """A scene, how it is drawn, and what is asked of a float32 backend on it; errors as in `measure.Errors`."""

    scene: SceneCase
    forward: float
    gradient: float
    flipped: float
    way: Way = PLAIN

    @property
    def name(self) -> str:
        return self.scene.name


STATED: dict[str, dict[str, tuple[float, float, float]]] = {
    "plain": {
        "edge_on": (2e-06, 2e-06, 0),
        "through_the_camera_plane": (5e-06, 8e-06, 0),
        "subpixel": (2e-06, 2e-06, 0),
        "screen_filling": (8e-05, 0.0002, 0),
        "axis_ratio_1e6": (2e-06, 2e-06, 0),
        "zero_scales": (2e-06, 2e-06, 0),
        "huge_scales": (0.0002, 0.006, 0),
        "zero_quaternions": (1e-05, 7e-05, 0),
        "tiny_quaternions": (9e-06, 5e-05, 0),
        "long_quaternions": (2e-05, 6e-05, 0),
        "opacity_1": (2e-05, 5e-05, 0),
        "beta_0": (2e-06, 2e-06, 0),
        "beta_small": (9e-06, 0.001, 0),
        "beta_4": (8e-06, 7e-06, 0),
        "temperature_1e4": (2e-05, 5e-05, 0),
        "temperature_0": (9e-06, 5e-05, 0),
        "sites_of_length_0": (9e-06, 5e-05, 0),
        "thousands_on_one_pixel": (6e-06, 2e-06, 0),
        "equal_depths": (7e-06, 2e-05, 0),
        "identical_surfels": (3e-06, 2e-06, 0),
        "coordinates_1e6": (2e-05, 6e-05, 0),
        "camera_at_1e6": (6e-06, 5e-06, 0),
        "image_1x1": (5e-07, 7e-07, 0),
        "image_8192x1": (3e-06, 2e-05, 0),
        "image_1x8192": (0.0007, 0.0003, 0),
    },
    "texels": {
        "edge_on": (2e-06, 2e-06, 0),
        "through_the_camera_plane": (5e-06, 6e-06, 0),
        "subpixel": (5e-03, 2e-02, 0),
        "screen_filling": (8e-05, 9e-05, 0),
        "axis_ratio_1e6": (3e-06, 8e-06, 0),
        "zero_scales": (3e-06, 3e-06, 0),
        "huge_scales": (2e-04, 2e-03, 0),
        "zero_quaternions": (9e-06, 7e-05, 0),
        "tiny_quaternions": (1e-05, 7e-05, 0),
        "long_quaternions": (2e-05, 9e-05, 0),
        "opacity_1": (2e-05, 6e-05, 0),
        "beta_0": (7e-06, 6e-06, 0),
        "beta_small": (9e-06, 7e-04, 0),
        "beta_4": (8e-06, 8e-06, 0),
        "temperature_1e4": (1e-05, 6e-05, 0),
        "temperature_0": (9e-06, 6e-05, 0),
        "sites_of_length_0": (9e-06, 6e-05, 0),
        "thousands_on_one_pixel": (8e-06, 7e-05, 0),
        "equal_depths": (7e-06, 3e-05, 0),
        "identical_surfels": (3e-06, 6e-06, 0),
        "coordinates_1e6": (1e-05, 8e-05, 0),
        "camera_at_1e6": (6e-06, 6e-06, 0),
        "image_1x1": (2e-06, 2e-06, 0),
        "image_8192x1": (5e-06, 2e-05, 0.00018),
        "image_1x8192": (7e-04, 3e-04, 0),
    },
    "pixel": {
        "through_the_camera_plane": (5e-06, 6e-06, 0),
        "screen_filling": (9e-05, 8e-05, 0),
        "huge_scales": (2e-06, 1e-01, 0.046),
        "zero_quaternions": (8e-06, 2e-05, 0),
        "tiny_quaternions": (8e-06, 3e-05, 0),
        "long_quaternions": (8e-06, 2e-05, 0),
        "opacity_1": (8e-06, 8e-06, 0),
        "beta_0": (2e-06, 2e-06, 0),
        "beta_small": (2e-05, 8e-04, 0),
        "beta_4": (2e-06, 2e-06, 0),
        "temperature_1e4": (8e-06, 1e-05, 0),
        "temperature_0": (7e-06, 9e-06, 0),
        "sites_of_length_0": (7e-06, 9e-06, 0),
        "equal_depths": (4e-06, 9e-06, 0),
        "identical_surfels": (3e-06, 2e-06, 0),
        "coordinates_1e6": (6e-06, 7e-06, 0),
        "camera_at_1e6": (5e-06, 4e-06, 0),
        "image_1x1": (2e-06, 2e-06, 0),
        "image_8192x1": (3e-06, 2e-05, 0),
        "image_1x8192": (4e-05, 3e-06, 0),
    },
}
"""Largest error of the images, of the gradients, and share of pixels that may flip, by way and name of the case: three
times what the CPU kernels have, rounded up. Cases that are not listed draw nothing."""


def cases(way: Way = PLAIN) -> list[Case]:
    """All of them, drawn in a way, in the order of the page."""
    stated = STATED[way.name]
    return [Case(scene, *stated.get(scene.name, (0.0, 0.0, 0.0)), way) for scene in extreme_scenes()]
