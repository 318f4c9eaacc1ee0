"""Opening of a bundle's files: sizes and types are checked before reading."""

import base64
import json
import os
import struct
import time
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

from bitymi_ns.bundle import BundleError, check_files, read_bundle
from bitymi_ns.bundle.parts import is_known, parts_of
from bitymi_ns.bundle.single import write_single
from bitymi_ns.cli import main
from tests.bundle.compact_scene import make_codes, write_compact
from tests.bundle.damage import amend
from tests.bundle.test_read import peak
from tests.typed import Patch, Printed

PREVIEW = bytes(3000)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_compact(tmp_path / "b", make_codes(count=40), extra_files={"preview.jpg": PREVIEW})


def pipe(path: Path) -> None:
    os.mkfifo(path)


def sparse(path: Path) -> None:
    with open(path, "wb") as file:
        os.truncate(file.fileno(), 1 << 36)


def link(target: str) -> Callable[[Path], None]:
    return lambda path: path.symlink_to(target)


def linked_pipe(path: Path) -> None:
    pipe(path.parent.parent / "pipe")
    path.symlink_to(path.parent.parent / "pipe")


PLACED = {
    **{"zero": link("/dev/zero"), "pipe": pipe, "linked pipe": linked_pipe, "sparse": sparse, "folder": Path.mkdir},
    **{"loop": lambda path: path.symlink_to(path), "nothing": link("/nowhere"), "terminal": link("/dev/tty")},
}


@pytest.mark.parametrize(
    "what, name",
    [
        *((what, "surfels.bin") for what in PLACED),
        *((what, name) for what in ("pipe", "sparse") for name in ("bundle.json", "texels.bin", "preview.jpg")),
    ],
)
def test_irregular_parts_are_refused_by_all(what: str, name: str, folder: Path, capsys: Printed) -> None:
    (folder / name).unlink()
    PLACED[what](folder / name)
    out, begin = str(folder.parent / "out"), time.perf_counter()

    def refused() -> None:
        left_out = pytest.warns(UserWarning, match=f"{name}.* It is left out: the scene does not need it")
        with left_out if name == "preview.jpg" else pytest.raises(BundleError, match=f"{name}"):
            read_bundle(folder)
        assert not all(check.ok for check in check_files(folder)[1])
        commands = [["pack", str(folder), "--output", out], ["view", str(folder), "--export", out]]
        commands += [["view", str(folder), "--export", out, "--one-file"], ["verify", str(folder)]]
        for command in commands:
            assert main(command) == 1
            shown = "".join(capsys.readouterr())
            assert "Traceback" not in shown and name in shown

    assert peak(refused) < 16 << 20 and time.perf_counter() - begin < 5
    assert not os.path.lexists(out)


@pytest.mark.parametrize("what", ["zero", "pipe", "linked pipe", "folder", "loop", "nothing"])
def test_one_file_has_to_be_a_regular_file(what: str, tmp_path: Path, capsys: Printed) -> None:
    path = tmp_path / "x" / "b.bitymi"
    path.parent.mkdir()
    PLACED[what](path)
    with pytest.raises(BundleError):
        read_bundle(path)
    for command in ("verify", "pack", "view"):
        assert main([command, str(path)]) == 1
    capsys.readouterr()
    for none in ("a" * 300, "/dev/null/x", "/proc/1/nothing"):  # no path at all
        assert main(["view", none]) == 1
        assert "Errno" not in capsys.readouterr().err


def test_a_link_to_a_file_as_it_is_stated_is_read_and_not_passed_on(folder: Path) -> None:
    """Storage of large files may replace files by links."""
    (folder / "surfels.bin").rename(folder.parent / "blob")
    (folder / "surfels.bin").symlink_to("../blob")
    assert len(read_bundle(folder)) == 40
    with pytest.raises(BundleError, match="leads out of the bundle"):
        write_single(folder, folder.parent / "b.bitymi")


def test_a_large_file_beside_the_scene_is_not_taken_into_memory(folder: Path, tmp_path: Path) -> None:
    os.truncate(folder / "preview.jpg", 80 << 20)
    amend(folder)

    def read() -> None:
        assert len(read_bundle(folder)) == 40
        with pytest.raises(BundleError, match="at most 67108864 are read"):
            write_single(folder, tmp_path / "b.bitymi")

    assert peak(read) < 20 << 20


def entries(path: Path, count: int, large: bool = False) -> None:
    one = struct.pack("<4s6H3L5H2L", b"PK\1\2", 20, 20, 0, 0, 0, 0, 0, 0, 0, 5, 0, 0, 0, 0, 0, 0)
    directory = b"".join(one + b"%05x" % (k % 16**5) for k in range(count))
    end = (b"PK\5\6", 0, 0, min(count, 0xFFFF), min(count, 0xFFFF), len(directory), 0, 0)
    more = b""
    if large:
        more = struct.pack("<4sQ2H2L4Q", b"PK\6\6", 44, 45, 45, 0, 0, count, count, len(directory), 0)
        more += struct.pack("<4sLQL", b"PK\6\7", 0, len(directory), 1)
        end = (*end[:5], 50, 0, 0)
    path.write_bytes(directory + more + struct.pack("<4s4H2LH", *end))


@pytest.mark.parametrize("large", [False, True], ids=["small records", "records of large files"])
def test_a_directory_of_many_entries_is_refused_before_it_is_read(large: bool, tmp_path: Path) -> None:
    path = tmp_path / "b.bitymi"
    entries(path, 300_000, large)
    begin = time.perf_counter()
    with pytest.raises(BundleError, match="its directory has 15300000 bytes"):
        read_bundle(path)
    assert time.perf_counter() - begin < 0.5


def test_a_directory_that_lies_elsewhere_than_it_says_is_refused(folder: Path, tmp_path: Path) -> None:
    write_single(folder, tmp_path / "b.bitymi")
    data = (tmp_path / "b.bitymi").read_bytes()
    moved = struct.pack("<4sQ2H2L4Q", b"PK\6\6", 44, 45, 45, 0, 0, 1, 1, 10, 0)
    moved += struct.pack("<4sLQL", b"PK\6\7", 0, 5, 1)
    # trailing data, a comment, other records, and leading data: a page, another ZIP
    more = (data + b"x", data[:-1] + b"\1", data[:-22] + moved + data[-22:], data + data[-22:-1])
    for bad in (*more, b"<html>" + data, data + data):
        (tmp_path / "bad.bitymi").write_bytes(bad)
        with pytest.raises(BundleError, match="not a bundle in one file|truncated"):
            read_bundle(tmp_path / "bad.bitymi")
    with pytest.warns(UserWarning, match="Duplicate"), zipfile.ZipFile(tmp_path / "bad.bitymi", "w") as archive:
        for name in ("bundle.json", "surfels.bin", "texels.bin", "bundle.json"):
            archive.write(folder / name, name)
    with pytest.raises(BundleError, match="two parts have one name"):
        read_bundle(tmp_path / "bad.bitymi")


def test_a_part_said_to_be_larger_than_the_file_is_refused(folder: Path, tmp_path: Path) -> None:
    path = tmp_path / "b.bitymi"
    write_single(folder, path)
    whole = path.read_bytes()
    at = whole.rindex(b"surfels.bin") - 46

    def refused(change: bytes) -> None:
        path.write_bytes(whole[: at + 20] + change + whole[at + 28 :])
        with pytest.raises(BundleError, match="surfels.bin does not lie where its directory says"):
            read_bundle(path)

    for claimed in (1 << 20, (1 << 32) - 2):
        assert peak(lambda claimed=claimed: refused(struct.pack("<2L", claimed, claimed))) < 4 << 20


DAMAGE = json.loads((Path(__file__).parents[2] / "web/test/archive.json").read_text())["damage"]


@pytest.mark.parametrize("kind", DAMAGE)
def test_a_damaged_container_is_read_as_the_page_reads_it(kind: str, tmp_path: Path) -> None:
    """The rows of web/test/archive_parts.py, which archive.test.ts reads, too."""
    (tmp_path / "b.bitymi").write_bytes(base64.b64decode(DAMAGE[kind]["file"]))
    if DAMAGE[kind]["parts"] is None:
        with pytest.raises(BundleError), parts_of(tmp_path / "b.bitymi"):
            pass
        return
    with parts_of(tmp_path / "b.bitymi") as parts:
        for name, text in DAMAGE[kind]["parts"].items():
            if text is None:
                with pytest.raises(BundleError):
                    parts.read(name, 1 << 20)
            else:
                assert parts.read(name, 1 << 20).decode() == text


def test_a_file_beyond_four_gigabytes_is_read(folder: Path, tmp_path: Path, monkeypatch: Patch) -> None:
    monkeypatch.setattr(zipfile, "ZIP64_LIMIT", 100)  # beyond which ZIP64 records are written
    write_single(folder, tmp_path / "b.bitymi")
    assert b"PK\6\6" in (tmp_path / "b.bitymi").read_bytes()
    assert len(read_bundle(tmp_path / "b.bitymi")) == len(read_bundle(folder))


def test_the_parts_of_one_file_are_the_files_of_the_folder(folder: Path, tmp_path: Path) -> None:
    write_single(folder, tmp_path / "b.bitymi")
    with parts_of(folder) as want, parts_of(tmp_path / "b.bitymi") as got:
        for path in folder.iterdir():
            assert got.read(path.name, 1 << 20) == want.read(path.name, 1 << 20) == path.read_bytes()
        with pytest.raises(BundleError, match="at most 10 are read"):
            got.read("surfels.bin", 10)
    assert all(map(is_known, ["bundle.json", "surfels.ply", "photograph-0001.jpg", "cameras.json", "poster.webp"]))
    others = ["photograph-0001.jpg\n", "photograph-1.jpg", "Photograph-0001.jpg", "photograph-0001.jpg.php", "a.svg"]
    assert not any(map(is_known, [*others, "config.yml", "bundle.json/", "../bundle.json", "", "photograph-٠٠٠١.jpg"]))
