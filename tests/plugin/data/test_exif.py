"""Exposure settings in EXIF."""

import math
from pathlib import Path

import pytest
from PIL import Image
from PIL.ExifTags import IFD, Base
from PIL.TiffImagePlugin import IFDRational

from bitymi_ns.plugin.data.images import exposure_stops


def photograph(path: Path, **settings: object) -> Path:
    """Write a photograph with these EXIF tags, by name."""
    exif = Image.Exif()
    exif.get_ifd(IFD.Exif).update({int(Base[name]): value for name, value in settings.items()})
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
