"""The named cases of numbers that misbehave, each with the errors that float32 may have on it."""

from __future__ import annotations

from dataclasses import dataclass

from bitymi_ns.measure.stability.scenes import SceneCase, extreme_scenes


@dataclass(frozen=True)
class Case:
    """A scene and what is asked of a float32 backend on it; errors as in `measure.Errors`."""

    scene: SceneCase
    forward: float
    gradient: float
    flipped: float

    @property
    def name(self) -> str:
        return self.scene.name


STATED: dict[str, tuple[float, float, float]] = {
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
}
"""Largest error of the images, of the gradients, and share of pixels that may flip, by name of the case: three times
what the CPU kernels have, rounded up. Cases that are not listed draw nothing."""


def cases() -> list[Case]:
    """All of them, in the order of the page."""
    return [Case(scene, *STATED.get(scene.name, (0.0, 0.0, 0.0))) for scene in extreme_scenes()]
