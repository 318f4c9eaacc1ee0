from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageFilter

from bitymi_ns.capture.folder_contents import photo_folder
from bitymi_ns.capture.image_files import in_srgb, read_image
from bitymi_ns.capture.sfm_photos import blurred, duplicates, find_photos, natural, read_photo, read_photos, upright
from bitymi_ns.capture.types import CaptureError
from bitymi_ns.progress import no_progress
from tests.profiles import DISPLAY_P3, SRGB


def test_names_are_sorted_by_the_numbers_in_them(tmp_path: Path) -> None:
    for name in ("b_10.jpg", "b_9.jpg", "B_1.JPG", "x/2.png", "masks/2.png", ".hidden/3.png", "._4.jpg", "notes.txt"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    assert find_photos(tmp_path) == ["B_1.JPG", "b_9.jpg", "b_10.jpg", "x/2.png"]
    assert natural("a2") < natural("a10")
    assert photo_folder(tmp_path) == tmp_path
    (tmp_path / "below/images").mkdir(parents=True)
    assert photo_folder(tmp_path / "below") == tmp_path / "below/images"


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp", ".tif", ".bmp", ".heic"])
def test_every_format_is_read(tmp_path: Path, pictures: list[np.ndarray], suffix: str) -> None:
    Image.fromarray(pictures[0]).save(tmp_path / f"a{suffix}")
    photo = read_photo(tmp_path, f"a{suffix}")
    assert (photo.width, photo.height) == pictures[0].shape[1::-1]
    assert photo.plain == (suffix not in (".webp", ".heic"))
    assert np.abs(np.asarray(upright(photo), float) - pictures[0]).mean() < 8


@pytest.mark.parametrize("orientation", range(1, 9))
def test_the_rotation_in_exif_is_applied(tmp_path: Path, pictures: list[np.ndarray], orientation: int) -> None:
    turns = {2: 0, 3: 3, 4: 1, 5: 5, 6: 2, 7: 6, 8: 4}  # what Pillow calls the transposition that stores it so
    image = Image.fromarray(pictures[0])
    exif = image.getexif()
    exif[0x0112] = orientation
    stored = image if orientation == 1 else image.transpose(turns[orientation])
    stored.save(tmp_path / "a.png", exif=exif)
    photo = read_photo(tmp_path, "a.png")
    assert (photo.width, photo.height) == image.size and photo.plain == (orientation == 1)
    np.testing.assert_array_equal(np.asarray(upright(photo)), pictures[0])


def test_a_damaged_file_among_good_ones_is_named(tmp_path: Path, pictures: list[np.ndarray]) -> None:
    for i in range(3):
        Image.fromarray(pictures[i]).save(tmp_path / f"{i}.jpg")
    whole = (tmp_path / "1.jpg").read_bytes()
    (tmp_path / "1.jpg").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "2.jpg").write_bytes(b"")
    photos, broken = read_photos(tmp_path, ["0.jpg", "1.jpg", "2.jpg"], no_progress)
    assert [photo.name for photo in photos] == ["0.jpg"]
    assert "truncated" in broken["1.jpg"] and "damaged, too large or not an image" in broken["2.jpg"]
    Image.new("RGB", (16, 16)).save(tmp_path / "a.png")  # an icon
    with pytest.raises(CaptureError, match="16 x 16"):
        read_photo(tmp_path, "a.png")
    first, second = (Image.fromarray(picture) for picture in pictures[:2])  # two pictures in one file
    first.save(tmp_path / "a.tif", save_all=True, append_images=[second])
    photo = read_photo(tmp_path, "a.tif")
    assert not photo.plain and np.array_equal(np.asarray(upright(photo)), pictures[0])


def test_a_blurred_photograph_is_found(arc: Path, tmp_path: Path) -> None:
    for i in range(1, 6):
        image = Image.open(arc / f"photo_{i}.png")
        (image.filter(ImageFilter.GaussianBlur(3)) if i == 2 else image).save(tmp_path / f"{i}.png")
    photos, _ = read_photos(tmp_path, find_photos(tmp_path), no_progress)
    assert blurred(photos) == ["2.png"]


def test_duplicates_are_found_and_neighbours_are_none(arc: Path, tmp_path: Path) -> None:
    for i in range(1, 5):
        Image.open(arc / f"photo_{i}.png").save(tmp_path / f"{i}.png")
    noise = np.random.default_rng(0).normal(0, 2, (216, 288, 3))
    burst = np.clip(np.asarray(Image.open(arc / "photo_2.png")) + noise, 0, 255).astype(np.uint8)
    Image.fromarray(burst).save(tmp_path / "burst.png")
    Image.open(arc / "photo_3.png").save(tmp_path / "again.png")
    photos, _ = read_photos(tmp_path, find_photos(tmp_path), no_progress)
    found = {frozenset(pair) for pair in duplicates(photos).items()}
    assert found == {frozenset(("burst.png", "2.png")), frozenset(("again.png", "3.png"))}


def deep(pixels: np.ndarray) -> Image.Image:
    """Make a 16-bit grey picture."""
    return Image.fromarray(pixels.mean(axis=2).astype(np.uint16) * 257)


@pytest.mark.parametrize(("suffix", "options"), [("png", {}), ("tif", {"compression": "tiff_lzw"})])
def test_deep_grey_pictures_are_scaled_and_turned(
    tmp_path: Path, pictures: list[np.ndarray], suffix: str, options: dict[str, str]
) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6
    deep(pictures[0]).save(tmp_path / f"a.{suffix}", exif=exif, **options)
    photo = read_photo(tmp_path, f"a.{suffix}")
    assert (photo.width, photo.height) == (216, 288) and not photo.plain
    expected = np.rot90(pictures[0].mean(axis=2), -1)
    assert np.abs(np.asarray(upright(photo).convert("L"), float) - expected).max() < 2


@pytest.mark.parametrize(
    ("name", "format"), [("a.jpg", "HEIF"), ("a.jpg", "WEBP"), ("a.png", "JPEG2000"), ("a.jpeg", "PNG")]
)
def test_a_file_that_is_not_what_its_name_says_is_converted(tmp_path: Path, name: str, format: str) -> None:
    Image.fromarray(np.zeros((64, 64, 3), np.uint8)).save(tmp_path / name, format)
    assert not read_photo(tmp_path, name).plain


def test_colors_of_another_profile_are_those_of_screens(tmp_path: Path) -> None:
    Image.new("RGB", (64, 64), (200, 100, 80)).save(tmp_path / "a.webp", lossless=True, icc_profile=DISPLAY_P3)
    for image in (upright(read_photo(tmp_path, "a.webp")), read_image(tmp_path / "a.webp")):
        assert image.getpixel((9, 9))[0] > 205
    pixels = np.full((4, 4, 4), (200, 100, 80, 60), np.uint8)
    for mode in ("RGB", "RGBA"):
        image = Image.fromarray(pixels[..., : len(mode)])
        image.info["icc_profile"] = DISPLAY_P3
        result = np.asarray(in_srgb(image))
        assert np.abs(result[0, 0, :3] - np.array([215, 92, 73])).max() <= 2  # by the matrices of both
        assert (result[..., 3:] == 60).all() and result.shape[-1] == len(mode)
        for same in (SRGB, b"no profile"):
            image.info["icc_profile"] = same
            assert in_srgb(image) is image
    grey = Image.new("L", (4, 4))
    grey.info["icc_profile"] = DISPLAY_P3
    assert in_srgb(grey) is grey
