"""Wide photographs as cube faces."""

import math
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from bitymi_ns.capture.lens import FACES, Lens, lenses_of
from bitymi_ns.capture.types import ColmapCamera

PANORAMA = ColmapCamera("EQUIRECTANGULAR", 256, 128, (256.0, 128.0))
RADIUS = 100.0
FOCAL = RADIUS / (0.5 * math.pi)
FISHEYE = ColmapCamera("OPENCV_FISHEYE", 200, 200, (FOCAL, FOCAL, RADIUS, RADIUS, 0.0, 0.0, 0.0, 0.0))


def rays_of(lens: Lens) -> np.ndarray:
    """Compute unit rays [h, w, 3] of a view's pixels in the axes of the photograph's camera."""
    rays = lens.pinhole.rays @ lens.turn[:3, :3].T
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def directions(lens: Lens, width: int, height: int) -> np.ndarray:
    """Render a photograph whose colors are the directions, [height, width, 3]."""
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1) + 0.5
    rays = lens.camera.colmap.cam_ray_from_img(pixels.reshape(-1, 2)).reshape(height, width, 3)
    return np.nan_to_num((rays * 0.5 + 0.5) * 255.0).round().clip(0, 255).astype(np.uint8)


def test_a_panorama_becomes_six_faces_that_show_each_direction_once() -> None:
    lenses = lenses_of(PANORAMA, PANORAMA.size, "camera 1")
    assert [lens.face for lens in lenses] == list(FACES) and all(lens.whole for lens in lenses)
    solid = 0.0
    for lens in lenses:
        rays = rays_of(lens)
        cosine = rays @ lens.turn[:3, 2]
        solid += float((cosine**3 / (lens.pinhole.fx * lens.pinhole.fy)).sum())
        got = np.asarray(lens.undistort(Image.fromarray(directions(lens, 256, 128)))).astype(float)
        assert np.abs(got - (rays * 0.5 + 0.5) * 255.0).max() < 4.0  # including the seam and the poles
    assert solid == pytest.approx(4.0 * math.pi, rel=1e-3)


def test_a_fisheye_of_180_degrees_is_used_to_more_than_nine_tenths() -> None:
    lenses = lenses_of(FISHEYE, FISHEYE.size, "camera 1")
    assert [lens.face for lens in lenses] == ["front", "right", "left", "up", "down"]
    pixels = np.stack(np.meshgrid(np.arange(200), np.arange(200)), -1) + 0.5
    circle, used = np.linalg.norm(pixels - 100.0, axis=-1) < RADIUS, np.zeros((200, 200), bool)
    rays = FISHEYE.colmap.cam_ray_from_img(pixels[circle])
    for lens in lenses:
        (x, y, z), to = (rays @ lens.turn[:3, :3]).T, lens.pinhole
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = to.fx * x / z + to.cx, to.fy * y / z + to.cy
        inside = (z > 0) & (u >= 0) & (v >= 0) & (u < to.width) & (v < to.height)
        covered = np.zeros_like(inside)
        mask = np.asarray(lens.undistort_mask(None, None))
        covered[inside] = mask[v[inside].astype(int), u[inside].astype(int)]
        used[circle] |= covered
        got = np.asarray(lens.undistort(Image.fromarray(directions(lens, 200, 200)))).astype(float)
        error = np.abs(got - (rays_of(lens) * 0.5 + 0.5) * 255.0).max(-1)[mask]
        assert np.quantile(error, 0.97) < 4.0
    assert used[circle].mean() > 0.98


def test_faces_that_the_photograph_covers_in_part_have_a_mask() -> None:
    wide = ColmapCamera("OPENCV_FISHEYE", 200, 100, (65.0, 65.0, 100.0, 50.0, 0.0, 0.0, 0.0, 0.0))
    lenses = lenses_of(wide, wide.size, "camera 1")
    assert [lens.face for lens in lenses] == ["front", "right", "left"]
    front = lenses[0]
    assert not front.whole and 0.8 < front.coverage.mean() < 1.0
    white = Image.new("1", (200, 100), 1)
    assert (np.asarray(front.undistort_mask(white, Path("m.png"))) == front.coverage).all()
    left_half = np.zeros((100, 200), bool)
    left_half[:, :100] = True
    masks = {lens.face: np.asarray(lens.undistort_mask(Image.fromarray(left_half), Path("m.png"))) for lens in lenses}
    assert masks["left"].any() and not masks["right"].any()


def test_a_face_is_the_same_one_in_a_smaller_photograph() -> None:
    for lens in lenses_of(PANORAMA, PANORAMA.size, "camera 1") + lenses_of(FISHEYE, FISHEYE.size, "camera 1"):
        small = lens.downscaled(0.5)
        assert small.face == lens.face and small.stored == lens.stored
        assert small.camera.size == (lens.camera.width // 2, lens.camera.height // 2)
        assert small.pinhole.view == pytest.approx(lens.pinhole.view, abs=0.5)


def test_where_the_distortion_folds_the_picture_nothing_is_used() -> None:
    folding = ColmapCamera("OPENCV_FISHEYE", 200, 200, (60.0, 60.0, 100.0, 100.0, -0.2, 0.0, 0.0, 0.0))
    angle = 1.0 / math.sqrt(0.6)  # at which theta - 0.2 theta^3 is largest
    for lens in lenses_of(folding, folding.size, "camera 1"):
        mask = lens.coverage
        assert (np.arccos(rays_of(lens)[..., 2])[mask] <= angle).all() and mask.mean() > 0.3
