from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import ExifTags, Image

from bitymi_ns.capture.exif import Exif, focal_length, read_exif

B = ExifTags.Base


def detail(**values: object) -> dict[int, object]:
    return {getattr(B, name): value for name, value in values.items()}


def test_the_focal_length_in_35_mm_film_is_of_the_diagonal() -> None:
    focal, doubt = focal_length(detail(FocalLengthIn35mmFilm=26), (4032, 3024))
    assert focal == pytest.approx(26 / math.hypot(36, 24) * 5040) and doubt == ""


def test_a_reduced_photograph_keeps_its_field_of_view() -> None:
    full, _ = focal_length(detail(FocalLengthIn35mmFilm=26, ExifImageWidth=4032, ExifImageHeight=3024), (4032, 3024))
    half, _ = focal_length(detail(FocalLengthIn35mmFilm=26, ExifImageWidth=4032, ExifImageHeight=3024), (2016, 1512))
    assert full == pytest.approx(2 * half)


@pytest.mark.parametrize("size", [(3024, 3024), (2000, 2000), (4032, 1500)])
def test_a_cropped_photograph_has_no_focal_length_to_be_believed(size: tuple[int, int]) -> None:
    stated = detail(FocalLengthIn35mmFilm=24, ExifImageWidth=4032, ExifImageHeight=3024)
    for entries in (stated, detail(FocalLengthIn35mmFilm=24)):
        focal, doubt = focal_length(entries, size)
        assert focal is None and "cropped" in doubt


def test_the_pixel_density_gives_the_focal_length_where_film_does_not() -> None:
    entries = detail(FocalLength=50, FocalPlaneXResolution=3000, FocalPlaneResolutionUnit=3)
    focal, _ = focal_length({**entries, **detail(ExifImageWidth=6000, ExifImageHeight=4000)}, (6000, 4000))
    assert focal == pytest.approx(50 * 300)
    assert focal_length(entries, (6000, 4000))[0] is None


@pytest.mark.parametrize("value", [0, -3, "x", None, float("nan"), float("inf"), 1e9])
def test_a_focal_length_that_cannot_be_meant_is_none(value: object) -> None:
    assert focal_length(detail(FocalLengthIn35mmFilm=value), (4000, 3000))[0] is None


@given(st.dictionaries(st.sampled_from([int(tag) for tag in B]), st.one_of(st.none(), st.text("0 /-x"), st.floats())))
def test_whatever_stands_in_exif_is_no_error(entries: dict[int, object]) -> None:
    focal, _ = focal_length(entries, (640, 480))
    assert focal is None or 0.3 * 640 <= focal <= 15 * 640


def with_exif(fill: object) -> Exif:
    image = Image.new("RGB", (400, 300))
    exif = image.getexif()
    fill(exif)  # type: ignore[operator]
    again = Image.Exif()
    again.load(exif.tobytes())
    image._exif = again  # as if it had been read from a file
    return read_exif(image)


def test_position_time_and_camera_are_read() -> None:
    def fill(exif: Image.Exif) -> None:
        exif[B.Make], exif[B.Model] = "Maker", "Phone"
        exif.get_ifd(ExifTags.IFD.Exif).update({B.DateTimeOriginal: "2024:05:01 10:00:00", B.FocalLength: 4.2})
        exif.get_ifd(ExifTags.IFD.GPSInfo).update(
            {1: "S", 2: (33.0, 30.0, 0.0), 3: "E", 4: (151.0, 0.0, 36.0), 5: b"\x01", 6: 5.0}
        )

    found = with_exif(fill)
    assert found.camera == "Maker Phone 4.2 mm" and found.time == "2024:05:01 10:00:00"
    assert found.position == pytest.approx((-33.5, 151.01, -5.0))


def test_a_position_of_zeros_is_none() -> None:
    zeros = {1: "N", 2: (0.0, 0.0, 0.0), 3: "E", 4: (0.0, 0.0, 0.0)}
    assert with_exif(lambda exif: exif.get_ifd(ExifTags.IFD.GPSInfo).update(zeros)).position is None
