"""Masks of photographs: their folder, their files, and which pixels count."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from bitymi_ns.capture.image_files import in_proportion
from bitymi_ns.capture.kinds import DYNAMIC, MASK
from bitymi_ns.capture.masks import find_masks, mask_folder, mask_pixels
from bitymi_ns.capture.types import CaptureError


@pytest.mark.parametrize(
    ("photographs", "data", "there", "found"),
    [
        ("bed/images", "bed", ["bed/masks"], "bed/masks"),
        ("bed/images", "bed/images", ["bed/masks"], "bed/masks"),
        ("bed/input", "bed/input", ["bed/masks", "bed/input/masks"], "bed/masks"),
        ("bed/shots", "bed", ["bed/masks"], "bed/masks"),  # below the data, whatever its name
        ("bed/shots", "bed/sparse/0", ["bed/masks"], "bed/masks"),
        ("bed/a/images", "bed", ["bed/a/masks", "bed/masks"], "bed/a/masks"),
        ("bed/a/images", "bed", ["bed/masks"], "bed/masks"),
        ("all/bed", "all/bed", ["all/bed/masks", "all/masks"], "all/bed/masks"),
        ("all/bed", "all/bed", ["all/masks"], None),  # of another capture
        ("all/bed", "all/bed/sparse/0", ["all/masks"], None),
        ("bed/images", "bed", ["bed/mask"], "bed/mask"),
        ("bed/images", "bed", [], None),
    ],
)
def test_the_folder_of_masks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, photographs: str, data: str, there: list[str], found: str | None
) -> None:
    for folder in (photographs, data, *there):
        (tmp_path / folder).mkdir(parents=True, exist_ok=True)
    expected = None if found is None else tmp_path / found
    assert mask_folder(tmp_path / photographs, tmp_path / data) == expected
    monkeypatch.chdir(tmp_path / data)  # the same from within
    assert mask_folder(tmp_path / photographs, Path()) == expected


def test_the_folder_of_masks_that_is_given_and_of_smaller_ones_alone(tmp_path: Path) -> None:
    for name in ("images", "masks_2", "mine"):
        (tmp_path / name).mkdir()
    assert mask_folder(tmp_path / "images", tmp_path, tmp_path / "mine") == tmp_path / "mine"
    with pytest.raises(CaptureError, match="the folder of masks .*/yours does not exist"):
        mask_folder(tmp_path / "images", tmp_path, tmp_path / "yours")
    assert mask_folder(tmp_path / "images", tmp_path) is None
    assert mask_folder(tmp_path / "images", tmp_path, downscale=2) == tmp_path / "masks_2"
    assert in_proportion((144, 108), (288, 216)) and in_proportion((67, 50), (4000, 3000))
    assert not in_proportion((216, 288), (288, 216))


@pytest.mark.parametrize(
    ("name", "files"),
    [
        ("a.jpg", ["a.png", "a.jpg.png", "a.PNG", "a.jpg.PNG"]),
        ("a.png", ["a.jpg"]),
        ("b/a.jpg", ["b/a.png", "b/A.png", "b/a_mask.png", "b/a.jpg.mask.png"]),
        ("000012.png", ["012.png", "12.png"]),  # IDR
        ("a.heic.jpg", ["a.png", "a.heic.png", "a.heic.jpg.png"]),  # an upright copy
    ],
)
def test_a_mask_is_found_by_the_name_of_its_photograph(tmp_path: Path, name: str, files: list[str]) -> None:
    for file in files:
        path = tmp_path / file
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(b"")
        assert find_masks([name], tmp_path / "images", tmp_path) == ({name: path}, False)
        path.unlink()
    (tmp_path / "a.png").write_bytes(b"")
    assert find_masks(["c/a.jpg", "a.b.jpg"], tmp_path / "images", tmp_path) == ({}, False)


@pytest.mark.parametrize("form", [*MASK.names.split(), *DYNAMIC.names.split()])
@pytest.mark.parametrize("ending", ["", ".jpg"])
def test_masks_beside_photographs_are_used_before_a_folder(tmp_path: Path, form: str, ending: str) -> None:
    for name in ("photos/cam1/a.jpg", "masks/cam1/a.png", f"photos/cam1/{form.replace('NAME', f'a{ending}')}.png"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    found = find_masks(["cam1/a.jpg", "cam1/b.jpg"], tmp_path / "photos", tmp_path / "masks")
    assert found == ({"cam1/a.jpg": tmp_path / name}, True)
    found = find_masks(["cam1/a.jpg"], tmp_path / "photos", tmp_path / "masks", stated=True)
    assert found == ({"cam1/a.jpg": tmp_path / "masks/cam1/a.png"}, False)


def blob() -> np.ndarray:
    """A round mask [48,64] bool, whose edge crosses compression blocks."""
    y, x = np.mgrid[:48, :64]
    return (x - 30) ** 2 + (y - 22) ** 2 < 15**2


@pytest.mark.parametrize("values", [(0, 255), (0, 1), (0, 3)])
def test_pixels_of_a_lossless_mask_count_where_they_are_not_black(tmp_path: Path, values: tuple[int, int]) -> None:
    Image.fromarray(np.where(blob(), values[1], values[0]).astype(np.uint8)).save(tmp_path / "m.png")
    assert np.array_equal(mask_pixels(Image.open(tmp_path / "m.png")), blob())


@pytest.mark.parametrize("ending", ["jpg", "webp"])
@pytest.mark.parametrize("quality", [50, 90])
def test_pixels_of_a_lossy_mask_count_above_the_middle(tmp_path: Path, ending: str, quality: int) -> None:
    path = tmp_path / f"m.{ending}"
    Image.fromarray(np.where(blob(), 255, 0).astype(np.uint8)).save(path, quality=quality)
    stored = Image.open(path)
    ripples = np.asarray(stored.convert("L"))[~blob()]
    assert (ripples > 0).sum() > 50  # what would count where nothing does
    assert (mask_pixels(stored) != blob()).sum() <= 20  # of 132 along the edge
