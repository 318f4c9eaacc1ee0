"""Pinhole pictures from distorted photographs."""

import math
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from PIL import Image

from bitymi_ns.capture.image_files import read_image
from bitymi_ns.capture.lens import MAX_VIEW_ANGLE, Lens, lenses_of
from bitymi_ns.capture.types import ColmapCamera
from tests.captures import refused

SIZE = (96, 72)
RADIAL = ColmapCamera("SIMPLE_RADIAL", *SIZE, (80.0, 48.0, 36.0, 0.1))
MODELS = [name for name in pycolmap.CameraModelId.__members__ if name not in ("INVALID", "EQUIRECTANGULAR")]


def camera_of(model: str, f: float, size: tuple[int, int] = SIZE, first: float = 0.02) -> ColmapCamera:
    """Make a camera with slight distortion, if the model has any."""
    camera = pycolmap.Camera.create_from_model_name(1, model, f, *size)
    params, extra = np.array(camera.params), camera.extra_params_idxs()
    if extra:
        params[extra[0]] = {"FOV": 0.5, "EUCM": 0.5}.get(model, first)
    return ColmapCamera(model, *size, tuple(params.tolist()))


def picture(one: Lens) -> np.ndarray:
    """Undistort a photograph whose red and green encode a pixel's position in units of 1/255 of its sides."""
    width, height = one.stored
    x, y = np.meshgrid((np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height)
    image = np.stack([x, y, 0 * x], -1) * 255.0
    return np.asarray(one.undistort(Image.fromarray(np.round(image).astype(np.uint8)))).astype(float)


@pytest.mark.parametrize("f", [30.0, 120.0])
@pytest.mark.parametrize("model", MODELS)
def test_pixels_come_from_where_the_camera_saw_their_rays(model: str, f: float) -> None:
    lenses = lenses_of(camera_of(model, f), SIZE, "camera 1")
    camera = lenses[0].camera.colmap
    for one in lenses:
        to = one.pinhole
        assert max(to.view) <= MAX_VIEW_ANGLE + 0.01 or not one.distorts
        rays = to.rays.reshape(-1, 3) @ one.turn[:3, :3].T
        seen = camera.img_from_cam(rays).reshape(to.height, to.width, 2)
        shown = np.ones(seen.shape[:2], bool) if one.whole else one.coverage
        assert (seen[shown] >= 0.0).all() and (seen[shown] <= SIZE).all()  # no extrapolation
        # rounding of result and photograph, and the half pixel at its edges
        error = np.abs(picture(one)[..., :2] - seen / SIZE * 255.0)[shown]
        assert np.quantile(error, 0.99) < 2.0 and error.max() < 4.0


@example(-0.09375, 0.5, 40.0)
@given(st.floats(-0.1, 0.2), st.floats(0.35, 0.65), st.floats(40.0, 400.0))
@settings(max_examples=25, deadline=None)
def test_windows_are_as_large_as_they_can_be(k: float, center: float, f: float) -> None:
    """Their edges touch the photograph's within a few pixels, unless they are as wide as allowed."""
    camera = ColmapCamera("SIMPLE_RADIAL", *SIZE, (f, center * SIZE[0], 0.5 * SIZE[1], k))
    lenses = lenses_of(camera, SIZE, "camera 1")
    to = lenses[0].pinhole
    x, y = np.meshgrid([0.0, to.width], [0.0, to.height])
    x, y = np.append(x, [to.cx, to.cx, 0.0, to.width]), np.append(y, [0.0, to.height, to.cy, to.cy])
    rays = np.stack([(x - to.cx) / to.fx, (y - to.cy) / to.fy, np.ones_like(x)], -1)
    seen = camera.colmap.img_from_cam(rays)
    margin = min(seen.min(), (np.array(SIZE) - seen).min())
    # wider windows become cube faces, masked beyond the photograph
    assert -0.01 < margin < 2.5 or max(to.view) > MAX_VIEW_ANGLE - 3.0 or len(lenses) > 1


def test_a_pinhole_is_left_as_it_is() -> None:
    for model in ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "OPENCV", "FULL_OPENCV"):
        (one, *_) = lenses_of(camera_of(model, 80.0, first=0.0), SIZE, "camera 1")
        assert not one.distorts and (one.pinhole.width, one.pinhole.height) == SIZE
        image = Image.fromarray(np.random.default_rng(0).integers(0, 255, (72, 96, 4), np.uint8))
        assert one.undistort(image) is image


def test_a_fisheye_needs_no_coefficients() -> None:
    (one,) = lenses_of(ColmapCamera("SIMPLE_FISHEYE", *SIZE, (60.0, 48.0, 36.0)), SIZE, "camera 1 of x")
    assert one.distorts and one.turn.tolist() == np.eye(4).tolist()


def test_masks_go_with_their_photographs() -> None:
    (one, *_) = lenses_of(RADIAL, (192, 144), "camera 1")
    mask = np.zeros((144, 192), bool)
    mask[:, 96:] = True
    out = np.asarray(one.undistort_mask(Image.fromarray(mask), Path("m.png")))
    assert out.dtype == bool and out.shape == (one.pinhole.height, one.pinhole.width)
    assert not out[:, : out.shape[1] // 2 - 1].any() and out[:, out.shape[1] // 2 + 1 :].all()


def test_larger_photographs_are_averaged_down() -> None:
    (one, *_) = lenses_of(ColmapCamera("PINHOLE", *SIZE, (80.0, 80.0, 48.0, 36.0)), (192, 144), "camera 1")
    stripes = np.tile(np.array([0, 255], np.uint8), (144, 96))[..., None].repeat(3, -1)
    out = np.asarray(one.undistort(Image.fromarray(stripes)))
    assert out.shape == (72, 96, 3) and np.abs(out.astype(int) - 127).max() <= 1


def test_a_photograph_of_another_size_is_named(tmp_path: Path) -> None:
    (one, *_) = lenses_of(RADIAL, SIZE, "camera 1")
    Image.new("RGB", (10, 20)).save(tmp_path / "b.png")
    with refused("b.png has 10 x 20 pixels, but its camera is for 96 x 72"):
        read_image(tmp_path / "b.png", one.stored, one.camera.size)
    with refused("m.png has 10 x 20 pixels, but its camera is for 96 x 72"):
        one.undistort_mask(Image.new("1", (10, 20)), Path("m.png"))


@pytest.mark.parametrize(
    ("model", "params", "message"),
    [
        ("EQUIRECTANGULAR", (96.0, 72.0), "camera 1 is EQUIRECTANGULAR, .*twice as wide.* but .* 96 x 72 pixels"),
        ("PINHOLE", (-80.0, math.nan, 48.0, 36.0), "focal lengths have to be positive, all numbers finite"),
        ("SIMPLE_RADIAL", (80.0, 48.0, 36.0, -100.0), "lens distortion of camera 1 is absurd: .*would leave"),
        ("SIMPLE_RADIAL", (80.0, 480.0, 36.0, 0.1), "lens distortion of camera 1 is absurd"),
    ],
)
def test_cameras_that_cannot_be_used(model: str, params: tuple[float, ...], message: str) -> None:
    with refused(message):
        lenses_of(ColmapCamera(model, *SIZE, params), SIZE, "camera 1")
