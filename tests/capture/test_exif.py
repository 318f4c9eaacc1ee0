import math
import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import ExifTags, Image
from PIL.TiffImagePlugin import IFDRational

from bitymi_ns.capture.exif import Exif, exposure_exif, exposure_settings, focal_length, read_exif
from bitymi_ns.capture.image_files import exposure_stops
from bitymi_ns.capture.sfm_photos import read_photo, upright_photos
from bitymi_ns.progress import no_progress

B = ExifTags.Base


def detail(**values: object) -> dict[int, object]:
    return {getattr(B, name): value for name, value in values.items()}


def test_focal_lengths() -> None:
    focal, doubt = focal_length(detail(FocalLengthIn35mmFilm=26), (4032, 3024))
    assert focal == pytest.approx(26 / math.hypot(36, 24) * 5040) and doubt == ""
    stated = detail(FocalLengthIn35mmFilm=26, ExifImageWidth=4032, ExifImageHeight=3024)
    full, half = (focal_length(stated, size)[0] for size in ((4032, 3024), (2016, 1512)))
    assert full == pytest.approx(2 * half)  # a reduced photograph keeps its field of view
    entries = detail(FocalLength=50, FocalPlaneXResolution=3000, FocalPlaneResolutionUnit=3)
    focal, _ = focal_length({**entries, **detail(ExifImageWidth=6000, ExifImageHeight=4000)}, (6000, 4000))
    assert focal == pytest.approx(50 * 300)  # by the density of pixels
    assert focal_length(entries, (6000, 4000))[0] is None
    for value in (0, -3, "x", None, float("nan"), float("inf"), 1e9):
        assert focal_length(detail(FocalLengthIn35mmFilm=value), (4000, 3000))[0] is None


@pytest.mark.parametrize("size", [(3024, 3024), (2000, 2000), (4032, 1500)])
def test_a_cropped_photograph_has_no_focal_length_to_be_believed(size: tuple[int, int]) -> None:
    stated = detail(FocalLengthIn35mmFilm=24, ExifImageWidth=4032, ExifImageHeight=3024)
    for entries in (stated, detail(FocalLengthIn35mmFilm=24)):
        focal, doubt = focal_length(entries, size)
        assert focal is None and "cropped" in doubt
    assert "cropped" in focal_length(stated, (4032, 2268))[1]  # to the aspect of other sensors


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
    zeros = {1: "N", 2: (0.0, 0.0, 0.0), 3: "E", 4: (0.0, 0.0, 0.0)}
    assert with_exif(lambda exif: exif.get_ifd(ExifTags.IFD.GPSInfo).update(zeros)).position is None


def apple_note(*acceleration: float, first: int = 3) -> bytes:
    """Build a phone's maker note: another entry, the acceleration, and their offsets."""
    entries = struct.pack(">HHII", first, 7, 4, 0) + struct.pack(">HHII", 8, 10, 3, 14 + 2 + 2 * 12 + 4)
    parts = [part for value in acceleration for part in (round(value * 10_000), 10_000)]
    return b"Apple iOS\0\0\1MM" + struct.pack(">H", 2) + entries + struct.pack(">I6i", 0, *parts)


def up_of(note: bytes, orientation: int = 1, lens: str = "iPhone 15 back camera") -> tuple[float, float, float] | None:
    def fill(exif: Image.Exif) -> None:
        exif[B.Make], exif[B.Orientation] = "Apple", orientation
        exif.get_ifd(ExifTags.IFD.Exif).update({B.MakerNote: note, B.LensModel: lens})

    return with_exif(fill).up


@pytest.mark.parametrize(
    ("acceleration", "orientation", "up"),
    [
        ((-1.0, 0.0, 0.0), 1, (0, -1, 0)),  # landscape, right side up
        ((1.0, 0.0, 0.0), 3, (0, -1, 0)),  # landscape, left side up
        ((0.0, -1.0, 0.0), 6, (0, -1, 0)),  # upright
        ((0.0, 1.0, 0.0), 8, (0, -1, 0)),  # upside down
        ((0.0, -0.8, -0.6), 6, (0, -0.8, -0.6)),  # upright, tilted towards the ground
        ((0.0, 0.0, -1.0), 6, (0, 0, -1)),  # flat, camera towards the ground
        ((0.17, -0.98, 0.0), 6, (-0.171, -0.985, 0)),  # upright, slightly rotated to its right
    ],
)
def test_up_is_that_of_the_phones_accelerometer(
    acceleration: tuple[float, float, float], orientation: int, up: tuple[float, float, float]
) -> None:
    assert up_of(apple_note(*acceleration), orientation) == pytest.approx(up, abs=1e-3)


def test_an_acceleration_that_cannot_be_gravity_is_not_believed() -> None:
    assert up_of(apple_note(0.0, -1.3, 0.0), 6) is None, "the phone was moved"
    assert up_of(apple_note(0.0, -1.0, 0.0), 1) is None, "turned by hand afterwards"
    assert up_of(apple_note(0.0, -1.0, 0.0), 5) is None, "mirrored"
    assert up_of(apple_note(0.0, -1.0, 0.0), 6, "iPhone 15 front TrueDepth camera") is None


@given(st.integers(0, 80), st.binary(max_size=8))
def test_a_broken_maker_note_is_none(length: int, more: bytes) -> None:
    whole = apple_note(0.0, -1.0, 0.0)
    found = up_of(whole[:length] + more, 6)
    assert found is None or len(found) == 3
    assert up_of(b"Nikon" + whole) is None and up_of(b"") is None


def test_the_upright_copy_of_a_portrait_photograph_keeps_its_exposure_alone(tmp_path: Path) -> None:
    image = Image.new("RGB", (64, 48), (90, 120, 60))
    exif = image.getexif()
    exif[B.Orientation] = 6
    exif.get_ifd(ExifTags.IFD.Exif).update(detail(ExposureTime=0.008, FNumber=1.8, ISOSpeedRatings=125, FocalLength=50))
    exif.get_ifd(ExifTags.IFD.GPSInfo)[ExifTags.GPS.GPSLatitudeRef] = "N"
    image.save(tmp_path / "portrait.jpg", exif=exif)
    photo = read_photo(tmp_path, "portrait.jpg")
    folder, names = upright_photos([photo], tmp_path, tmp_path / "work", no_progress)
    with Image.open(folder / names["portrait.jpg"]) as copy:
        assert copy.size == (48, 64)
        assert exposure_settings(copy) == pytest.approx((0.008, 1.8, 125))
        tags = copy.getexif()
        assert B.Orientation not in tags and not tags.get_ifd(ExifTags.IFD.GPSInfo)


def photograph(path: Path, **settings: object) -> Path:
    """Write a photograph with these EXIF tags, by name."""
    exif = Image.Exif()
    exif.get_ifd(ExifTags.IFD.Exif).update({int(B[name]): value for name, value in settings.items()})
    Image.new("RGB", (8, 8)).save(path, exif=exif.tobytes() if settings else b"")
    return path


@pytest.mark.parametrize("kind", ["jpg", "png"])
def test_exposures_in_stops(tmp_path: Path, kind: str) -> None:
    full = dict(ExposureTime=IFDRational(1, 60), FNumber=IFDRational(28, 10), ISOSpeedRatings=100)
    changed = [{}, {"ExposureTime": IFDRational(1, 30)}, {"FNumber": 5.6}, {"ISOSpeedRatings": 800}]
    paths = [photograph(tmp_path / f"{i}.{kind}", **(full | change)) for i, change in enumerate(changed)]
    stops = exposure_stops(paths)
    assert [s - stops[0] for s in stops] == pytest.approx([0.0, 1.0, -2.0, 3.0], abs=1e-4)


def test_what_no_photograph_states_is_the_same_for_all(tmp_path: Path) -> None:
    times = [IFDRational(1, 100), IFDRational(1, 25)]
    paths = [photograph(tmp_path / f"{i}.jpg", ExposureTime=t, ISOSpeedRatings=200) for i, t in enumerate(times)]
    paths.append(photograph(tmp_path / "more.jpg", ExposureTime=times[0], ISOSpeedRatings=200, FNumber=4.0))
    first, second, more = exposure_stops(paths)
    assert second - first == pytest.approx(2.0) and math.isnan(more)


def test_photographs_without_settings_or_that_cannot_be_read(tmp_path: Path) -> None:
    bare = photograph(tmp_path / "bare.jpg")
    odd = photograph(tmp_path / "odd.jpg", ExposureTime=IFDRational(1, 0), ISOSpeedRatings=100)
    cut = tmp_path / "cut.jpg"
    cut.write_bytes(bare.read_bytes()[:30])
    stops = exposure_stops([bare, odd, cut, tmp_path / "none.jpg"])
    assert len(stops) == 4 and all(math.isnan(s) for s in stops)


def test_exif_that_breaks_pillow_counts_as_none(tmp_path: Path) -> None:
    """Its exposure pointer is a 64-bit number."""
    entry = (0x8769).to_bytes(2, "little") + (16).to_bytes(2, "little") + (1).to_bytes(4, "little")
    exif = b"Exif\0\0II*\0\x08\0\0\0\x01\0" + entry + (26).to_bytes(4, "little") + bytes(4) + b"\xff" * 8
    paths = [tmp_path / f"{i}.jpg" for i in range(2)]
    for path in paths:
        Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(path, exif=exif)
    assert np.isnan(exposure_stops(paths)).all()
    with Image.open(paths[0]) as image:
        assert read_exif(image) == Exif() and not dict(exposure_exif(image))
