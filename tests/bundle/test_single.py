"""Bundles in one file: parts in order, damaged files refused."""

import io
import random
import zipfile
from pathlib import Path

import pytest
import torch

from bitymi_ns import cli
from bitymi_ns.bundle import BundleError, check_files, read_bundle
from bitymi_ns.bundle import single as single_module
from bitymi_ns.bundle.single import write_single
from tests.bundle.compact_scene import make_codes, write_compact


@pytest.fixture
def single(tmp_path: Path) -> bytes:
    """A compact bundle in one file, with a large file that viewers do not need."""
    folder = write_compact(tmp_path / "b", make_codes(count=40), extra_files={"preview.jpg": bytes(100_000)})
    write_single(folder, tmp_path / "b.bitymi.zip")
    return (tmp_path / "b.bitymi.zip").read_bytes()


def middle_of(single: bytes, name: str) -> int:
    entry = zipfile.ZipFile(io.BytesIO(single)).getinfo(name)
    return entry.header_offset + 30 + len(name) + entry.file_size // 2


def test_parts_are_stored_in_the_order_of_their_use(single: bytes) -> None:
    entries = zipfile.ZipFile(io.BytesIO(single)).infolist()
    assert [entry.filename for entry in entries] == ["bundle.json", "surfels.bin", "texels.bin", "preview.jpg"]
    assert all(entry.compress_type == zipfile.ZIP_STORED and not entry.flag_bits & 8 for entry in entries)


def test_it_is_read_and_checked_by_its_path_as_a_folder_is(single: bytes, tmp_path: Path) -> None:
    path = tmp_path / "b.bitymi.zip"
    bundle, checks = check_files(path)
    assert bundle is not None and all(check.ok for check in checks), checks
    assert {check.name for check in checks} >= {"bundle.json", "surfels.bin", "texels.bin", "preview.jpg", "contents"}
    assert torch.equal(read_bundle(path).scene.atlas, bundle.scene.atlas)
    data = bytearray(single)
    data[middle_of(single, "preview.jpg")] ^= 1
    path.write_bytes(data)
    assert [check.name for check in check_files(path)[1] if not check.ok] == ["preview.jpg"]
    path.write_bytes(b"no bundle")
    with pytest.raises(BundleError, match="is not a bundle in one file"):
        read_bundle(path)


def test_damage_anywhere_is_refused_or_changes_nothing(single: bytes, tmp_path: Path) -> None:
    rng, path = random.Random(0), tmp_path / "damaged.bitymi"
    want = read_bundle(tmp_path / "b").scene
    path.write_bytes(single)
    assert torch.equal(read_bundle(path).scene.atlas, want.atlas)
    start = single.rindex(b"PK\x05\x06")  # the list of parts lies before it
    places = [*range(60), *range(start - 260, len(single))]
    for _ in range(300):
        data = bytearray(single)
        data[rng.choice(places)] ^= 1 << rng.randrange(8)
        path.write_bytes(data[: rng.choice((len(data), len(data), len(data) - rng.randrange(300)))])
        try:
            found = read_bundle(path).scene
        except BundleError as error:
            assert "\n" not in str(error)
        else:
            assert torch.equal(found.atlas, want.atlas) and torch.equal(found.surfels["means"], want.surfels["means"])


def test_what_is_not_packed_and_not_read(single: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(single_module, "machine_memory", lambda: 150_000)  # the preview has 100,000 bytes
        with pytest.raises(BundleError, match="cannot be packed: that takes 2.* this machine has 150.0 kB"):
            write_single(tmp_path / "b", tmp_path / "c.bitymi")
    with zipfile.ZipFile(tmp_path / "deflated.bitymi", "w", zipfile.ZIP_DEFLATED) as archive:
        for entry in zipfile.ZipFile(io.BytesIO(single)).infolist():
            archive.writestr(entry.filename, zipfile.ZipFile(io.BytesIO(single)).read(entry))
    with pytest.raises(BundleError, match="is not stored as it is"):
        read_bundle(tmp_path / "deflated.bitymi")
    (tmp_path / "b" / "preview.jpg").write_bytes(bytes(99_999) + b"x")
    with pytest.raises(BundleError, match="preview.jpg is altered"):
        write_single(tmp_path / "b", tmp_path / "c.bitymi")
    assert not (tmp_path / "c.bitymi").exists()


def test_the_command_packs_and_verifies(single: bytes, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["pack", str(tmp_path / "b")]) == 0
    assert "b.bitymi" in capsys.readouterr().out and (tmp_path / "b.bitymi").read_bytes() == single
    assert cli.main(["verify", str(tmp_path / "b.bitymi")]) == 0
    assert cli.main(["pack", str(tmp_path / "b")]) == 1
    assert "--overwrite" in capsys.readouterr().err
    assert cli.main(["pack", str(tmp_path / "b"), "--overwrite"]) == 0
    (tmp_path / "mine.zip").write_bytes(b"precious")
    assert cli.main(["pack", str(tmp_path / "b"), "--output", str(tmp_path / "mine.zip"), "--overwrite"]) == 1
    assert "is not replaced" in capsys.readouterr().err and (tmp_path / "mine.zip").read_bytes() == b"precious"
