"""Reading of bundles: sizes are checked before reading, and nothing is read twice."""

import builtins
import json
import os
import struct
import tracemalloc
from collections import Counter
from pathlib import Path

import pytest
import torch

from bitymi_ns.bundle import check_files, ktx2, read_bundle
from bitymi_ns.bundle import read as bundle_read
from bitymi_ns.bundle.manifest import BundleError
from bitymi_ns.bundle.parts import parts_of
from bitymi_ns.cli import main
from tests.bundle import made
from tests.bundle.damage import change_columns, change_texel, signed

COUNT = 6


def make(surfels, folder: Path, kind: str = "sv", **options) -> Path:
    """Write a bundle with tiles that end within the disc, and with mean residuals."""
    made.make(surfels, folder, kind, extent=torch.full((COUNT,), 2.0), mean_residual=torch.zeros(COUNT, 3), **options)
    return folder


def sparse(folder: Path, name: str, size: int) -> None:
    """Make a sparse file of `size` bytes and record it in bundle.json."""
    os.truncate(folder / name, size)
    info = json.loads((folder / "bundle.json").read_text())
    info["files"][name]["bytes"] = size
    (folder / "bundle.json").write_bytes(signed(info))


def peak(action) -> int:
    tracemalloc.start()
    try:
        action()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("name, reason", [("atlas.ktx2", "truncated or too long"), ("surfels.ply", "6 of vertex need")])
def test_a_file_longer_than_its_header_says_is_refused_before_it_is_read(surfels, tmp_path, name, reason):
    folder = make(surfels, tmp_path / "b")
    sparse(folder, name, 40 << 30)

    def refused():
        for verify in (True, False):
            with pytest.raises(BundleError, match=f"{name}: .*{reason}"):
                read_bundle(folder, verify=verify)
        checks = {check.name: check for check in check_files(folder)[1]}
        assert not checks[name].ok and reason in checks[name].detail

    assert peak(refused) < 8 << 20


def test_a_header_that_fits_the_file_and_not_the_manifest_is_refused_before_more_is_read(surfels, tmp_path):
    folder = make(surfels, tmp_path / "b")
    path = folder / "atlas.ktx2"
    data = bytearray(path.read_bytes())
    image = ktx2.read_header(data, len(data))
    layers = (40 << 30) // ktx2.layer_bytes(image.format, image.width, image.height)
    texels = layers * ktx2.layer_bytes(image.format, image.width, image.height)
    data[32:36], data[88:104] = struct.pack("<I", layers), struct.pack("<2Q", texels, texels)
    path.write_bytes(data)
    sparse(folder, "atlas.ktx2", image.data_at + texels)
    with pytest.raises(BundleError, match="not those of bundle.json"):
        read_bundle(folder)

    folder = make(surfels, tmp_path / "other")
    path = folder / "surfels.ply"
    head, body = path.read_bytes().split(b"end_header\n")
    count = (40 << 30) // (len(body) // COUNT)
    head = head.replace(b"vertex 6", b"vertex %d" % count) + b"end_header\n"
    path.write_bytes(head)
    sparse(folder, "surfels.ply", len(head) + count * (len(body) // COUNT))
    with pytest.raises(BundleError, match=f"it has {count} surfels, surfels.count of bundle.json says 6"):
        read_bundle(folder)


def test_files_are_read_once_and_those_that_are_not_needed_are_not_kept(surfels, tmp_path, monkeypatch):
    folder = make(surfels, tmp_path / "b", extra_files={"preview.png": bytes(40 << 20)})
    assert peak(lambda: read_bundle(folder)) < 20 << 20
    opened, real = Counter(), builtins.open

    def counting(file, *args, **kwargs):
        opened[Path(file).name] += 1
        return real(file, *args, **kwargs)

    monkeypatch.setattr(builtins, "open", counting)
    assert all(check.ok for check in check_files(folder)[1])
    assert [opened[name] for name in ("surfels.ply", "atlas.ktx2", "preview.png")] == [1, 1, 1]


def test_a_file_that_shrinks_while_it_is_read_is_truncated(surfels, tmp_path, monkeypatch):
    folder = make(surfels, tmp_path / "b")
    size = (folder / "atlas.ktx2").stat().st_size
    real = os.fstat

    def larger(handle):
        found = list(real(handle))
        found[6] = size + 100 if found[6] == size else found[6]
        return os.stat_result(found)

    info = json.loads((folder / "bundle.json").read_text())
    info["files"]["preview.png"] = {"bytes": size + 100, "sha256": "0" * 64}
    (folder / "preview.png").write_bytes(bytes(size))
    (folder / "bundle.json").write_bytes(signed(info))
    monkeypatch.setattr(os, "fstat", larger)
    with parts_of(folder) as parts:
        info = bundle_read.manifest_of(parts)
        with pytest.raises(BundleError, match=f"preview.png is truncated: it ended after {size} bytes"):
            bundle_read.read_file(parts, info, "preview.png", keep=False)


def test_a_lack_of_memory_is_a_sentence(surfels, tmp_path, monkeypatch):
    folder = make(surfels, tmp_path / "b")

    def lacking(*args):
        raise MemoryError

    monkeypatch.setattr(bundle_read, "decode_pages", lacking)
    with pytest.raises(BundleError, match="needs more memory than there is: its files have 0 MB"):
        read_bundle(folder)
    assert "needs more memory" in check_files(folder)[1][-1].detail


# kind, reduced, element, column, a value just within the limit, one beyond it
COLUMNS = [
    ("sv", False, "vertex", "y", 1e9, -1.1e9),
    ("sv", False, "vertex", "scale_1", -104, 105),
    ("sv", False, "vertex", "opacity", -1e4, 1e5),
    ("sv", False, "vertex", "beta", 1e4, -3e38),
    ("sv", False, "vertex", "sv_sites_20", 1e6, 1e7),
    ("sv", False, "vertex", "sv_log_tau_6", -1e4, 2e4),
    ("sv", False, "vertex", "sv_rgb_4", 256, 257),
    ("sh", False, "vertex", "sh_dc_2", -256, 1e4),
    ("sh", False, "vertex", "sh_rest_44", 256, -1e30),
    ("sb", False, "vertex", "sb_lobes_9", 9e3, 1.1e4),
    ("sb", False, "vertex", "sb_lobes_8", 256, 300),
    ("sg", False, "vertex", "sg_lobes_8", -1e6, 2e6),
    ("sg", False, "vertex", "sg_lobes_13", 256, 300),
    ("sv", False, "vertex", "residual_1", -256, -257),
    ("sv", False, "vertex", "tile_extent", 16, 17),
    ("sv", False, "vertex", "tile_extent", 1e-6, 1e-40),
    ("sv", True, "vertex", "view_base_0", 256, 1e5),
    ("sv", True, "view_term", "term_2", 2e7, 1e9),
    ("sv", True, "view_term", "term_3", 256, 257),
    ("sg", True, "view_term", "term_3", 1e4, 1e5),
    ("sh", True, "view_term", "term_1", 256, 257),
    ("sh", True, "vertex", "alpha", 2, 2.5),
    ("sv", False, "vertex", "alpha", 0, -0.1),
]


@pytest.mark.parametrize("kind, reduced, element, column, good, bad", COLUMNS, ids=lambda value: str(value))
def test_values_beyond_limits_are_refused_by_column_and_row(
    surfels, tmp_path, kind, reduced, element, column, good, bad
):
    folder = make(surfels, tmp_path / "b", kind, reduced=reduced, alpha=column == "alpha")
    change_columns(folder, lambda columns: columns[column].__setitem__(2, good), element)
    read_bundle(folder)
    change_columns(folder, lambda columns: columns[column].__setitem__(2, bad), element)
    with pytest.raises(BundleError, match=f"surfels.ply: {column} is .* in row 2; it must be from"):
        read_bundle(folder)


@pytest.mark.parametrize(
    "alpha, texel, told, change, reason",
    [
        (True, (3, -0.5), "the alpha of the texel .* 0 to 2", lambda c: c.pop("alpha"), "the column alpha is missing"),
        (False, (1, 300), "the texel .* -256 to 256", lambda c: c["rot_0"].__setitem__(4, 1.5), "length 1 in row 4"),
    ],
)
def test_texels_and_columns_out_of_range_are_refused(surfels, tmp_path, alpha, texel, told, change, reason):
    folder = make(surfels, tmp_path / "b", format="fp16", alpha=alpha)
    change_texel(folder, *texel)
    with pytest.raises(BundleError, match=rf"atlas.ktx2: {told.replace('.*', r'.5, 3. of layer 0 is not from')}"):
        read_bundle(folder)
    change_columns(folder, change)
    with pytest.raises(BundleError, match=reason):
        read_bundle(folder)


def test_verify_says_what_was_edited_and_what_to_do(surfels, tmp_path, capsys):
    folder = make(surfels, tmp_path / "[b]" / "[/red]")  # markup of the console in a path
    path = folder / "bundle.json"
    whole = path.read_text()

    def verify() -> str:
        status = main(["verify", str(folder)])
        out, err = capsys.readouterr()
        assert err == "" and "Traceback" not in out and (status == 1) == ("FAILED" in out)
        return out

    assert "FAILED" not in verify()
    for text, edited, said in (
        ('"near": 0.2', '"near": 5', "is altered: its digest"),
        ('"near": 0.2', '"near": -5', "render.near must be greater"),
        ('"statistics": {}', '"statistics": [1, 2]', "statistics must be an object, not [1, 2]"),
        ('"file": "atlas.ktx2"', '"file": "../x"', "atlas.file must be 'atlas.ktx2' or 'texels.bin', not '../x'"),
    ):
        assert text in whole
        path.write_text(whole.replace(text, edited))
        out = verify()
        assert "FAILED" in out and f"bundle.json: {path}" in out and said in out and "Copy the bundle again" in out
