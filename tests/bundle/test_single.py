"""A bundle in one file: read in ranges, surfels before texels, and refused where it is damaged."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import pytest
import torch

from bitymi_ns.bundle import BundleError, read_bundle
from bitymi_ns.bundle.single import Ranges, read_single, write_single
from tests.bundle.compact_scene import make_codes, write_compact
from tests.bundle.made import make


@pytest.fixture
def single(tmp_path: Path) -> bytes:
    """A compact bundle in one file, with a large file that no viewer needs."""
    folder = write_compact(tmp_path / "b", make_codes(count=40), extra_files={"preview.jpg": bytes(100_000)})
    write_single(folder, tmp_path / "b.bitymi.zip")
    return (tmp_path / "b.bitymi.zip").read_bytes()


def middle_of(single: bytes, name: str) -> int:
    """Where the middle of a part lies."""
    entry = zipfile.ZipFile(io.BytesIO(single)).getinfo(name)
    return entry.header_offset + 30 + len(name) + entry.file_size // 2


def test_it_is_the_bundle(single: bytes, tmp_path: Path) -> None:
    want, got = read_bundle(tmp_path / "b").scene, read_single(io.BytesIO(single)).scene
    assert torch.equal(got.tiles, want.tiles) and torch.equal(got.atlas, want.atlas)
    for name, value in want.surfels.items():
        assert torch.equal(got.surfels[name], value)


def test_it_is_read_in_ranges_and_surfels_do_without_the_texels(single: bytes) -> None:
    fetched: list[tuple[int, int]] = []

    def fetch(at: int, count: int) -> bytes:
        fetched.append((at, count))
        return single[at : at + count]

    bundle = read_single(Ranges(fetch, len(single)), textured=False)
    assert bundle.scene.atlas is None and bool(bundle.scene.mean_residual.any()) and len(bundle) == 40
    middle = middle_of(single, "texels.bin")
    assert not any(at <= middle < at + count for at, count in fetched)
    assert sum(count for _, count in fetched) < len(single) / 4


def test_parts_are_stored_in_the_order_of_their_use(single: bytes) -> None:
    entries = zipfile.ZipFile(io.BytesIO(single)).infolist()
    assert [entry.filename for entry in entries] == ["bundle.json", "surfels.bin", "texels.bin", "preview.jpg"]
    assert all(entry.compress_type == zipfile.ZIP_STORED and not entry.flag_bits & 8 for entry in entries)


@pytest.mark.parametrize("name", ["bundle.json", "surfels.bin", "texels.bin"])
def test_damage_is_refused(single: bytes, name: str) -> None:
    data, at = bytearray(single), middle_of(single, name)
    data[at] ^= 255
    with pytest.raises(BundleError):
        read_single(io.BytesIO(bytes(data)))
    with pytest.raises(BundleError):
        read_single(io.BytesIO(single[:at]))


def test_deflated_parts_are_refused(single: bytes) -> None:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for entry in zipfile.ZipFile(io.BytesIO(single)).infolist():
            archive.writestr(entry.filename, zipfile.ZipFile(io.BytesIO(single)).read(entry))
    with pytest.raises(BundleError, match="is not stored as it is"):
        read_single(packed)


def test_bundles_of_earlier_versions_fit_as_well(surfels, tmp_path: Path) -> None:
    make(surfels, tmp_path / "b", format="bc7")
    write_single(tmp_path / "b", tmp_path / "b.zip")
    with open(tmp_path / "b.zip", "rb") as file:
        assert torch.equal(read_single(file).scene.atlas, read_bundle(tmp_path / "b").scene.atlas)
    with open(tmp_path / "b.zip", "rb") as file, pytest.raises(BundleError, match="only a compact bundle"):
        read_single(file, textured=False)
