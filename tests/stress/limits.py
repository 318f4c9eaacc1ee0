"""Errors allowed to a float32 backend on each extreme scene."""

from dataclasses import dataclass

from bitymi_ns.measure.stability.scenes import PLAIN, WAYS, SceneCase, Way, extreme_scenes


@dataclass(frozen=True)
class Case:
    """A scene, its rendering mode, and the errors allowed to a float32 backend, as in `errors.Errors`."""

    scene: SceneCase
    forward: float
    gradient: float
    flipped: float
    way: Way = PLAIN


ALLOWED: dict[str, tuple[tuple[float, float, float], ...]] = {
    "edge_on": ((2e-06, 2e-06, 0), (2e-06, 2e-06, 0), (3e-06, 2e-06, 0)),
    "through_the_camera_plane": ((5e-06, 8e-06, 0), (5e-06, 6e-06, 0), (6e-06, 3e-06, 0)),
    "subpixel": ((2e-06, 2e-06, 0), (0.005, 0.02, 0), (0.009, 0.009, 0)),
    "screen_filling": ((8e-05, 0.0002, 0), (8e-05, 9e-05, 0), (6e-05, 8e-05, 0)),
    "axis_ratio_1e6": ((2e-06, 2e-06, 0), (3e-06, 8e-06, 0), (4e-06, 2e-05, 0)),
    "zero_scales": ((2e-06, 2e-06, 0), (3e-06, 3e-06, 0), (2e-06, 3e-06, 0)),
    "huge_scales": ((0.0002, 0.006, 0), (0.0002, 0.002, 0), (0.0003, 0.002, 0)),
    "zero_quaternions": ((1e-05, 7e-05, 0), (9e-06, 7e-05, 0), (1e-05, 6e-05, 0)),
    "tiny_quaternions": ((9e-06, 5e-05, 0), (1e-05, 7e-05, 0), (1e-05, 5e-05, 0)),
    "long_quaternions": ((2e-05, 6e-05, 0), (2e-05, 9e-05, 0), (2e-05, 8e-05, 0)),
    "opacity_1": ((2e-05, 5e-05, 0), (2e-05, 6e-05, 0), (2e-05, 6e-05, 0.047)),
    "beta_0": ((2e-06, 2e-06, 0), (7e-06, 6e-06, 0), (2e-05, 1e-05, 0.0079)),
    "beta_small": ((9e-06, 0.001, 0), (9e-06, 0.0007, 0), (2e-05, 0.0003, 0.0079)),
    "beta_4": ((8e-06, 7e-06, 0), (8e-06, 8e-06, 0), (1e-05, 2e-05, 0)),
    "temperature_1e4": ((2e-05, 5e-05, 0), (1e-05, 6e-05, 0), (1e-05, 5e-05, 0)),
    "temperature_0": ((9e-06, 5e-05, 0), (9e-06, 6e-05, 0), (1e-05, 5e-05, 0)),
    "sites_of_length_0": ((9e-06, 5e-05, 0), (9e-06, 6e-05, 0), (1e-05, 5e-05, 0)),
    "thousands_on_one_pixel": ((6e-06, 2e-06, 0), (8e-06, 7e-05, 0), (5e-06, 4e-05, 0)),
    "equal_depths": ((7e-06, 2e-05, 0), (7e-06, 3e-05, 0), (1e-05, 3e-05, 0)),
    "identical_surfels": ((3e-06, 2e-06, 0), (3e-06, 6e-06, 0), (3e-06, 4e-06, 0)),
    "coordinates_1e6": ((2e-05, 6e-05, 0), (1e-05, 8e-05, 0), (2e-05, 8e-05, 0)),
    "camera_at_1e6": ((6e-06, 5e-06, 0), (6e-06, 6e-06, 0), (8e-06, 6e-06, 0)),
    "image_1x1": ((5e-07, 7e-07, 0), (2e-06, 2e-06, 0), (6e-07, 2e-06, 0)),
    "image_8192x1": ((3e-06, 2e-05, 0), (5e-06, 2e-05, 0.00018), (5e-06, 1e-05, 0.00037)),
    "image_1x8192": ((0.0007, 0.0003, 0), (0.0007, 0.0003, 0), (0.0004, 0.0003, 0)),
}  # fmt: skip
"""Case -> allowed errors of images and gradients, and allowed share of flipped pixels, for plain, texels and alpha:
three times the CPU kernels' values, rounded up. Other cases draw nothing."""


def cases(way: Way = PLAIN) -> list[Case]:
    """List all cases in a rendering mode."""
    column = (PLAIN, *WAYS).index(way)
    nothing = (0.0, 0.0, 0.0)
    return [Case(scene, *ALLOWED.get(scene.name, (nothing,) * 3)[column], way) for scene in extreme_scenes()]
