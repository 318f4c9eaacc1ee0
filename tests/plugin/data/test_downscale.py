"""Large photographs are reduced on reading: cameras, pictures, masks and messages agree."""

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from bitymi_ns.capture import image_files
from bitymi_ns.capture.image_files import read_image
from bitymi_ns.capture.lens import lenses_of
from bitymi_ns.capture.types import ColmapCamera
from bitymi_ns.plugin.data.datamanager import BitymiDataManager, BitymiDataManagerConfig
from bitymi_ns.plugin.data.dataparser import BitymiDataParserConfig
from tests.captures import expect


def load(capture: Path, longest_side: int) -> BitymiDataManager:
    config = BitymiDataManagerConfig(data=capture, dataparser=BitymiDataParserConfig(), longest_side=longest_side)
    return config.setup(device="cpu", test_mode="val")


def test_cameras_and_pictures_are_reduced_together(capture: Path, capsys: pytest.CaptureFixture) -> None:
    """At half the size a pixel is the mean of four and has the same rays."""
    whole, half = load(capture, 0), load(capture, 24)
    said = " ".join(capsys.readouterr().out.split())
    assert "10 of 10 training photographs, up to 48 x 36, are reduced to 24 pixels" in said
    for index in range(len(whole.train_dataset)):
        large, small = whole.train_views[index], half.train_views[index]
        assert small.image.shape == (18, 24, 3)
        assert torch.allclose(small.camera.K[:2], 0.5 * large.camera.K[:2])
        assert torch.equal(small.camera.viewmat, large.camera.viewmat)
        mean = large.image.float().view(18, 2, 24, 2, 3).mean((1, 3))
        assert (small.image.float() - mean).abs().max() <= 1.0  # PIL rounds after each direction
    assert half.eval_views[0].image.shape == (18, 24, 3)
    assert half.train_dataset.facts.train_pixels == len(half.train_dataset) * 18 * 24


def test_odd_sizes_keep_the_rays_of_the_corners(capture: Path) -> None:
    whole, small = load(capture, 0), load(capture, 31)  # 31 x 23.25
    a, b = whole.train_views[0].camera, small.train_views[0].camera
    assert (b.width, b.height) == (31, 23)
    for pixel in ((0.0, 0.0), (1.0, 1.0)):
        x, y = pixel
        rays = [
            [float((x * c.width - c.K[0, 2]) / c.K[0, 0]), float((y * c.height - c.K[1, 2]) / c.K[1, 1])]
            for c in (a, b)
        ]
        assert rays[0] == pytest.approx(rays[1], abs=1e-5)


def test_transparent_photographs_keep_their_colors(tmp_path: Path, capture: Path) -> None:
    """Colours of transparent pixels do not bleed into others."""
    pixels = np.zeros((36, 48, 4), np.uint8)
    pixels[:, ::2] = (200, 100, 50, 255)  # every other column; the rest is transparent black
    for path in (capture / "images").iterdir():
        Image.fromarray(pixels).save(path)
    image = load(capture, 24).train_views[0].image
    assert (image[..., 3].int() - 128).abs().max() <= 1
    assert (image[..., :3].int() - torch.tensor([200, 100, 50])).abs().max() <= 2


def test_a_negative_side_is_refused(capture: Path) -> None:
    with expect("longest-side is -1: give a number of pixels"):
        load(capture, -1)


def test_a_lens_is_reduced_with_its_photographs() -> None:
    camera = ColmapCamera("SIMPLE_RADIAL", 960, 720, (800.0, 480.0, 360.0, 0.1))
    (whole,) = lenses_of(camera, camera.size, "camera 1")
    half = whole.downscaled(0.5)
    assert half.camera.size == (480, 360) and half.stored == (960, 720)
    assert half.pinhole.view == pytest.approx(whole.pinhole.view, abs=0.2)
    grey = Image.fromarray(np.tile(np.linspace(0, 255, 960).astype(np.uint8), (720, 1))).convert("RGB")
    a, b = (np.asarray(each.undistort(grey)).astype(float) for each in (whole, half))
    a = a[: 2 * (len(a) // 2), : 2 * (a.shape[1] // 2)]
    a = a.reshape(len(a) // 2, 2, a.shape[1] // 2, 2, 3).mean((1, 3))
    h, w = min(len(a), len(b)), min(a.shape[1], b.shape[1])
    assert np.abs(a[:h, :w] - b[:h, :w]).mean() < 1.0


@pytest.mark.parametrize("size", [(800, 600), (801, 533), (807, 603)])
@pytest.mark.parametrize("reduction", [1, 2, 4, 5.3, 8])
def test_jpegs_are_decoded_small_and_stay_in_their_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, size: tuple[int, int], reduction: float
) -> None:
    """Decoders round half of an odd size up; a picture of that is not the photograph's."""
    x, y = np.arange(size[0])[None, :], np.arange(size[1])[:, None]
    waves = 127 + 100 * np.sin(x / 40 + y / 30)
    pixels = np.stack(np.broadcast_arrays(waves, x / 7, y / 5), -1)
    Image.fromarray(pixels.astype(np.uint8)).save(tmp_path / "a.jpg", quality=95, subsampling=0)
    decoded = []
    monkeypatch.setattr(image_files, "in_srgb", lambda image: decoded.append(image.size) or image)
    wanted = (round(size[0] / reduction), round(size[1] / reduction))
    small = read_image(tmp_path / "a.jpg", size, wanted)
    whole = read_image(tmp_path / "a.jpg", size)
    assert small.size == wanted and decoded[1] == size
    assert decoded[0] == size or 2 * wanted[0] <= decoded[0][0] <= 4 * wanted[0] + 2
    expected = np.asarray(whole.resize(wanted, Image.Resampling.BOX)).astype(float)
    error = np.asarray(small).astype(float) - expected
    assert np.abs(error).mean() < 1.0 and np.abs(error[:, :, 1:].mean((0, 1))).max() < 0.5
