"""The poster of a bundle: small, and listed and checked like other files."""

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from bitymi_ns.bundle import check_files, read_bundle
from bitymi_ns.bundle.manifest import POSTER
from bitymi_ns.bundle.poster import LEAST, SHARE, SIDE, draw_poster, encode_poster, most_bytes
from bitymi_ns.bundle.single import write_single
from tests.bundle.compact_scene import make_codes, write_compact
from tests.cuda.baked_scenes import front, textured

SMOOTH = np.zeros((300, 480, 3), np.uint8) + np.linspace(0, 255, 480).astype(np.uint8)[None, :, None]
NOISE = np.random.default_rng(0).integers(0, 256, (75, 120, 3), dtype=np.uint8)


def opened(data: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))


def test_it_is_what_the_camera_sees_and_small() -> None:
    scene, background = textured(20, 0), (0.25, 0.5, 1.0)
    pixels = draw_poster(scene, front(160, 120), background)
    assert pixels.shape == (120, 160, 3) and pixels.dtype == np.uint8
    want = scene.render(front(160, 120), torch.tensor(background)).rgb.clamp(0, 1)
    assert np.abs(pixels / 255.0 - want.numpy()).max() <= 0.5001 / 255
    assert draw_poster(scene, front(1600, 1200), background).shape == (SIDE * 3 // 4, SIDE, 3)


def test_it_fits_its_bytes() -> None:
    for most in (20_000, 5_000, LEAST):
        data = encode_poster(NOISE, most)
        assert data is not None and len(data) <= most
    whole = encode_poster(SMOOTH, 20_000)
    assert whole is not None and np.abs(opened(whole).astype(int) - SMOOTH).mean() < 2
    assert encode_poster(NOISE, 10) is None
    assert most_bytes(10_000_000) == SHARE * 10_000_000 and most_bytes(0) == LEAST


def test_it_comes_second_in_one_file_and_is_checked(tmp_path: Path) -> None:
    folder, single = write_compact(tmp_path / "b", make_codes(), poster=SMOOTH), tmp_path / "b.bitymi"
    write_single(folder, single)
    names = [entry.filename for entry in zipfile.ZipFile(single).infolist()]
    assert names == ["bundle.json", POSTER, "surfels.bin", "texels.bin"]
    for place in (folder, single):
        assert POSTER in {check.name for check in check_files(place)[1] if check.ok}
    good = (folder / POSTER).read_bytes()
    assert len(good) == read_bundle(folder).info.files[POSTER].bytes <= LEAST and opened(good).ndim == 3
    data = bytearray(good)
    data[len(data) // 2] ^= 1
    single.write_bytes(single.read_bytes().replace(good, bytes(data)))
    (folder / POSTER).write_bytes(data)
    for place in (folder, single):
        assert [check.name for check in check_files(place)[1] if not check.ok] == [POSTER]
        with pytest.warns(UserWarning, match=rf"{POSTER} is altered.* is left out"):
            assert len(read_bundle(place)) == 12
