"""Photographs and masks of all kinds, and which can be trained on."""

import shutil
import struct
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from PIL import Image

from bitymi_ns.capture.image_files import ImageSummary, read_image, summarize
from bitymi_ns.capture.masks import checked_mask
from bitymi_ns.plugin.data.datamanager import BitymiDataManager
from tests.captures import add_masks, edit, expect, images_of, load, load_with, printed, refused


@pytest.fixture
def picture() -> np.ndarray:
    """[36, 48, 3] uint8 with black and white pixels."""
    picture = np.random.default_rng(0).integers(0, 256, (36, 48, 3), dtype=np.uint8)
    picture[0, 0], picture[0, 1] = 0, 255
    return picture


def grey_of(picture: np.ndarray) -> np.ndarray:
    return np.asarray(Image.fromarray(picture).convert("L"))


def as_rgb(grey: np.ndarray) -> np.ndarray:
    return np.repeat(grey[..., None], 3, axis=-1)


@pytest.mark.parametrize(
    ("name", "dtype", "factor"),
    [
        ("a.png", np.uint16, 257),
        ("a.tiff", np.uint16, 257),
        ("a.tiff", np.int32, 257),
        ("a.tiff", np.int32, 1),
        ("a.tiff", np.float32, 1 / 255),
        ("a.tiff", np.float32, 1),
    ],
)
def test_deep_grey_pictures_are_scaled(
    picture: np.ndarray, tmp_path: Path, name: str, dtype: Any, factor: float
) -> None:
    grey = grey_of(picture)
    grey = np.where(grey == grey.max(), 255, grey).astype(np.uint8)
    Image.fromarray((grey * np.float64(factor)).astype(dtype)).save(tmp_path / name)
    assert np.array_equal(np.asarray(read_image(tmp_path / name)), as_rgb(grey))


def test_deep_color_is_scaled(picture: np.ndarray, tmp_path: Path) -> None:
    for name in ("a.png", "a.tiff"):
        cv2.imwrite(str(tmp_path / name), picture[..., ::-1].astype(np.uint16) * 257)
        assert np.array_equal(np.asarray(read_image(tmp_path / name)), picture)


def test_floats_beyond_white_are_refused(tmp_path: Path) -> None:
    for values, message in (([[0.0, 900.0]], "lie between 0 and 900"), ([[0.0, np.nan]], "lie between nan and nan")):
        Image.fromarray(np.float32(values)).save(tmp_path / "a.tiff")
        with refused(f"a.tiff cannot be read: its values {message}"):
            read_image(tmp_path / "a.tiff")


def test_other_modes_come_out_right(picture: np.ndarray, tmp_path: Path) -> None:
    def saved(image: Image.Image, name: str = "a.png", **options: Any) -> np.ndarray:
        image.save(tmp_path / name, **options)
        return np.asarray(read_image(tmp_path / name))

    grey, whole = grey_of(picture), Image.fromarray(picture)
    few = whole.quantize(8)
    assert np.array_equal(saved(few), np.asarray(few.convert("RGB")))
    assert saved(few, transparency=0).shape[-1] == 4
    assert np.array_equal(saved(Image.fromarray(grey)), as_rgb(grey))
    assert np.array_equal(saved(Image.fromarray(grey > 99)), as_rgb(np.uint8(255) * (grey > 99)))
    both = Image.merge("LA", [Image.fromarray(grey), Image.fromarray(grey.T.reshape(36, 48).copy())])
    assert np.array_equal(saved(both), np.asarray(both.convert("RGBA")))
    assert np.array_equal(saved(whole.convert("CMYK"), "a.tiff"), picture)
    smooth = Image.fromarray(np.uint8(np.linspace(10, 240, 48 * 36).reshape(36, 48, 1).repeat(3, 2)))
    jpeg = saved(smooth.convert("CMYK"), "a.jpg", quality=95)
    assert np.abs(jpeg.astype(int) - np.asarray(smooth)).max() < 12


def test_masks_of_any_mode_say_the_same(tmp_path: Path) -> None:
    counts = np.tile([[False, True]], (6, 4))
    grey = Image.fromarray(np.uint8(counts * 255))
    swapped = Image.fromarray(np.uint8(~counts), "P")  # index 0 is white
    swapped.putpalette([255, 255, 255, 0, 0, 0])
    cut_out = Image.new("RGBA", grey.size, (200, 0, 0, 255))
    cut_out.putalpha(grey)
    others = [Image.merge("LA", [grey, Image.new("L", grey.size, 255)]), Image.fromarray(np.uint16(counts * 256))]
    for i, mask in enumerate((grey, swapped, cut_out, grey.convert("1"), grey.convert("RGB"), *others)):
        mask.save(tmp_path / f"{i}.png")
        assert np.array_equal(np.asarray(checked_mask(tmp_path / f"{i}.png")), counts), mask.mode
    (tmp_path / "bad.png").write_bytes(b"no picture")
    with refused("the mask .*bad.png cannot be read"):
        checked_mask(tmp_path / "bad.png")


def test_masks_without_a_pixel(capture: Path, capsys: pytest.CaptureFixture[str]) -> None:
    add_masks(capture, lambda i: 255 * (i not in (0, 4)))
    manager = load(capture)
    assert (len(manager.train_dataset), len(manager.eval_dataset)) == (9, 1)
    assert "frame_00005" not in "".join(map(str, manager.train_dataset.image_filenames))
    assert len(manager.cached_train) == 9 and manager.cached_eval[0]["mask"].all()
    message = printed(capsys)
    assert "The masks of 1 of 10 training photographs exclude every pixel" in message
    assert "The masks of 1 of 2 held-out photographs exclude every pixel" in message and "frame_00005.png" in message
    for path in (capture / "masks").iterdir():
        Image.new("L", (48, 36)).save(path)
    with expect("the masks of all 10 training photographs exclude every pixel.*invert inverted masks"):
        load(capture)
    edit(capture, lambda meta: meta["frames"][5].pop("mask_path"))
    with expect("no mask_path for images/frame_00006.png, but other frames have one"):
        load(capture)


def test_the_color_for_what_masks_exclude(capture: Path) -> None:
    add_masks(capture, 255)
    Image.fromarray(np.uint8(np.arange(48) % 2 * 255)[None].repeat(36, 0)).save(capture / "masks/frame_00002.png")
    stock = NerfstudioDataParserConfig(mask_color=(1.0, 0.0, 0.5), eval_mode="interval")
    image = load_with(capture, stock).cached_train[0]["image"]
    assert image.dtype == torch.uint8 and image[0, 0].tolist() == [255, 0, 128]
    original = np.asarray(Image.open(images_of(capture)[1]))
    assert np.array_equal(image[:, 1::2].numpy(), original[:, 1::2])


def checked(capture: Path) -> BitymiDataManager:
    manager = load(capture)
    _ = manager.cached_train, manager.cached_eval
    manager.check_pictures()
    return manager


def test_photographs_that_show_nothing(capture: Path, capsys: pytest.CaptureFixture[str]) -> None:
    paths = images_of(capture)
    Image.new("RGB", (48, 36), (7, 7, 7)).save(paths[2])
    clear = Image.open(paths[3]).convert("RGBA")
    clear.putalpha(0)
    clear.save(paths[3])
    checked(capture)
    message = printed(capsys)
    assert "1 show nothing, of one color throughout" in message and paths[2].name in message
    assert "1 show nothing, transparent everywhere" in message and paths[3].name in message
    for path in paths:
        clear.save(path)
    with expect("nothing to learn from the 10 training photographs: transparent everywhere: .* and 7 more"):
        checked(capture)


def test_what_is_remembered_of_a_photograph(picture: np.ndarray) -> None:
    large = np.zeros((500, 400, 3), np.uint8)
    assert summarize(large).empty == "of one color throughout"
    large[1, 1] = 1  # between the pixels sampled first
    assert summarize(large).empty == ""
    assert summarize(picture) == ImageSummary("", summarize(picture.copy()).fingerprint)
    assert summarize(picture).fingerprint != summarize(255 - picture).fingerprint


def test_the_same_photograph_on_both_sides(capture: Path, capsys: pytest.CaptureFixture[str]) -> None:
    paths = images_of(capture)
    shutil.copy(paths[0], paths[3])
    checked(capture)
    message = printed(capsys)
    assert "1 of 2 held-out photographs are training photographs, too" in message
    assert f"{paths[0]} = {paths[3]}" in message and "remove the duplicates" in message
    Image.open(paths[8]).save(paths[5], compress_level=0)  # other bytes, the same pixels
    checked(capture)
    message = printed(capsys)
    assert f"{paths[8]} = {paths[5]}" in message and message.count(f"{paths[0]} = {paths[3]}") == 1


def test_a_frame_that_is_listed_twice(capture: Path, capsys: pytest.CaptureFixture[str]) -> None:
    edit(capture, lambda meta: meta["frames"].insert(1, dict(meta["frames"][0])))
    checked(capture)
    first = images_of(capture)[0]
    assert f"{first} = {first}" in printed(capsys)
    load(capture, eval_mode="all").check_pictures()
    assert "held-out photographs are" not in printed(capsys)


def declared(path: Path, width: int, height: int) -> None:
    """Write a PNG header with this size, without pixels."""
    ihdr = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    chunks = [ihdr, b"IDAT" + zlib.compress(b""), b"IEND"]
    path.write_bytes(
        b"\x89PNG\r\n\x1a\n"
        + b"".join(struct.pack(">I", len(c) - 4) + c + struct.pack(">I", zlib.crc32(c)) for c in chunks)
    )


@pytest.mark.parametrize("index", [0, 4])
def test_photographs_beyond_all_sizes(capture: Path, index: int) -> None:
    path = images_of(capture)[index]
    declared(path, 16320, 12240)  # a phone's 200-megapixel sensor
    camera = {"w": 16320, "h": 12240, "fl_x": 13600.0, "fl_y": 13600.0, "cx": 8160.0, "cy": 6120.0}
    edit(capture, lambda meta: meta["frames"][index].update(camera))
    manager = load(capture, points="random")
    assert len(manager.train_dataset) == 10
    declared(path, 60000, 60000)
    with expect(f"{path.name} has more than 1,000,000,000 pixels. Make it smaller"):
        checked(capture)
