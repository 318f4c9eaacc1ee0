"""Compact bundles round-trip, and contradictory ones are refused before they take memory."""

import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from bitymi_ns import ply
from bitymi_ns.bundle import BundleError, check_files, read, read_bundle, sizes
from bitymi_ns.bundle.manifest import EARLIER
from bitymi_ns.bundle.read import read_manifest
from bitymi_ns.bundle.sizes import least_memory
from bitymi_ns.cli import main
from bitymi_ns.codec.limits import ALPHA_SCALE
from bitymi_ns.codec.pages import covered_blocks, texel_alpha
from bitymi_ns.codec.quantise import encode
from bitymi_ns.ops.baked_cuda import decoded
from bitymi_ns.ops.view_kinds import VIEW_COLORS
from tests.bundle.compact_scene import (
    FINEST,
    RANGE,
    earlier,
    make_codes,
    pages_of,
    scene_of,
    write_compact,
    write_earlier,
)
from tests.bundle.damage import amend, recode
from tests.bundle.test_read import peak, sparse


@pytest.mark.parametrize("kind", sorted(VIEW_COLORS))
@pytest.mark.parametrize("textured, alpha", [(True, False), (True, True), (False, False)])
def test_it_holds_what_its_codes_stand_for(tmp_path: Path, kind: str, textured: bool, alpha: bool) -> None:
    codes = make_codes(kind, textured=textured, alpha=alpha)
    folder = write_compact(tmp_path / "b", codes)
    names = {"bundle.json", "surfels.bin"} | ({"texels.bin"} if textured else set())
    assert {path.name for path in folder.iterdir()} == names
    bundle, checks = check_files(folder)
    assert bundle is not None and all(check.ok for check in checks), checks
    assert bundle.info.version == "6.0"
    want, got = scene_of(codes), bundle.scene
    for name, value in want.surfels.items():
        torch.testing.assert_close(got.surfels[name], value, rtol=0, atol=0)
    assert torch.equal(got.tiles, want.tiles)
    tiled = want.tiles[:, 3] > 0
    assert torch.equal(got.extent[tiled], want.extent[tiled])
    if textured:
        stored = encode(*pages_of(codes), "uint8", RANGE)
        assert got.atlas.numpy().tobytes() == b"".join(stored.payload)
        torch.testing.assert_close(got.mean_residual, codes.texels.constants)
    assert got.alpha_scale == (ALPHA_SCALE if alpha else 0.0) and (got.mean_alpha is not None) == alpha
    if alpha:
        assert torch.equal(got.mean_alpha, codes.texels.alpha.means)
        assert torch.equal(texel_alpha(got).values, codes.texels.alphas())


@pytest.mark.parametrize("count", [1, 2, 12])
def test_places_may_need_every_bit_of_their_grid(tmp_path: Path, count: int) -> None:
    codes = make_codes(count=count, steps=FINEST)
    folder = write_compact(tmp_path / "b", codes)
    if count == 12:
        assert codes.surfels.columns["place"].max() >= 1 << 48  # seven bytes
    torch.testing.assert_close(read_bundle(folder).scene.surfels["means"], codes.surfels.surfels()["means"])


def test_it_is_much_smaller_than_a_plain_one_and_can_carry_the_ply(tmp_path: Path) -> None:
    folder = write_compact(tmp_path / "b", make_codes(count=400, alpha=True), interchange=True)
    sizes = {path.name: path.stat().st_size for path in folder.iterdir()}
    assert sizes["surfels.bin"] < sizes["surfels.ply"] / 4
    columns = ply.parse_ply((folder / "surfels.ply").read_bytes())["vertex"]
    bundle = read_bundle(folder)
    np.testing.assert_array_equal(columns["x"], bundle.scene.surfels["means"][:, 0].numpy())
    np.testing.assert_array_equal(columns["alpha"], bundle.scene.mean_alpha.numpy())
    np.testing.assert_array_equal(columns["tile_ru"], bundle.scene.tiles[:, 3].numpy())


@pytest.mark.parametrize("alpha", [False, True])
def test_many_texels_become_blocks_for_a_card_where_they_are_asked_for(tmp_path: Path, monkeypatch, alpha) -> None:
    folder = write_compact(tmp_path / "b", make_codes(count=400, alpha=alpha))
    whole = read_bundle(folder).scene
    few = read_bundle(folder, decode=False).scene
    assert torch.equal(few.atlas, whole.atlas) and few.blocks is None  # a small atlas stays as it is
    monkeypatch.setattr(read, "LARGE_ATLAS", whole.atlas.numel())
    many = read_bundle(folder, decode=False).scene
    assert many.atlas is None and many.blocks.numel() == whole.atlas.numel() / 4
    layers, height, width = whole.atlas.shape[:3]
    owned = covered_blocks(whole.tiles.numpy(), width, height, layers).repeat(4, 1).repeat(4, 2)
    error = (decoded(many.blocks)[owned].float() - whole.atlas[owned].float()).square().mean(0).sqrt()
    assert 0 < error[:3].max() < 40  # steps of 255, of texels that are noise of a deviation of 37
    assert (0 < error[3] < 40) == alpha
    assert read_bundle(folder).scene.blocks is None  # the CPU needs none
    monkeypatch.setitem(sys.modules, "ispc_texcomp", None)
    with pytest.warns(UserWarning, match="pip install ispc_texcomp"):
        without = read_bundle(folder, decode=False).scene
    assert torch.equal(without.atlas, whole.atlas) and without.blocks is None
    monkeypatch.setattr(read, "bc7_blocks", fails_for_lack_of_memory)
    with pytest.raises(BundleError, match="needs more memory than there is"):
        read_bundle(folder, decode=False)


def fails_for_lack_of_memory(*_: object, **options: object) -> None:
    raise RuntimeError("DefaultCPUAllocator: not enough memory")


def _column(info: dict, name: str) -> dict:
    found = [*info["surfels"]["columns"], *info["atlas"]["columns"]]
    return next(column for column in found if column["name"] == name)


@pytest.mark.parametrize(
    "change, reason",
    [
        (lambda i: i["surfels"].update(count=13), "a column is damaged"),
        (lambda i: i["surfels"].update(view_color="sh"), "term_shape needs 0 numbers, not 3"),
        (lambda i: i["surfels"].update(columns=i["surfels"]["columns"][1:]), "truncated or too long"),
        (lambda i: i["surfels"]["columns"].reverse(), "the columns are"),
        (lambda i: i["surfels"].pop("frame"), "surfels.bin needs surfels.frame, columns and terms"),
        (lambda i: i["surfels"].update(file="surfels.ply"), "files must list surfels.ply"),
        (lambda i: i.update(version="4.0"), "version 4.0 with 'surfels.bin', which is read no longer: export it again"),
        (lambda i: _column(i, "rotation").update(step=None), "rotation has no step"),
        (lambda i: _column(i, "rotation").update(step=-1.0), "must be greater than or equal to"),
        (lambda i: _column(i, "rotation")["bytes"].append(0), "rotation needs 3 numbers, not 4"),
        (lambda i: _column(i, "rotation").pop("bytes"), "columns.2.bytes is missing"),
        (lambda i: i["atlas"].update(texels=5), "atlas.texels says 5"),
        (lambda i: i["atlas"].update(height=i["atlas"]["height"] + 4), "width, height and layers of the atlas are oth"),
        (lambda i: i["atlas"].update(page_width=4), "wide, more than the page width"),
        (lambda i: i["atlas"].update(format="uint8"), "do not fit each other"),
        (lambda i: i["atlas"].pop("step"), "do not fit each other"),
        (lambda i: i["atlas"].update(alpha_scale=None), "the columns are"),
        (lambda i: i["atlas"].update(alpha_scale=0), "alpha_scale must be greater than 0"),
        (lambda i: i["atlas"].update(alpha_scale=1.0), "must have alpha_scale 1.9921875, as its format is dct"),
        (lambda i: _column(i, "alpha").update(name="m"), "the columns are"),
        (lambda i: _column(i, "alpha_8x8").update(step=None), "the column alpha_8x8 has no step"),
        (lambda i: _column(i, "alpha_8x4").update(step=1.0), "the columns of alphas have different steps"),
        (lambda i: _column(i, "alpha_8x8").update(name="alpha_4x8"), "the columns are"),
    ],
)
def test_what_contradicts_itself_is_refused(tmp_path: Path, change, reason: str) -> None:
    folder = write_compact(tmp_path / "b", make_codes(alpha=True))
    amend(folder, change)
    with pytest.raises(BundleError, match=reason):
        read_bundle(folder)


def _set(row: int, value: int):
    def change(codes: np.ndarray) -> None:
        codes[row] = value

    return change


@pytest.mark.parametrize(
    "name, change, reason",
    [
        ("largest", _set(3, 4), "a rotation's largest number is not one of four"),
        ("size", _set(3, 17), "a tile has a side that is not a power of two"),
        ("view_count", _set(3, 40), "do not have the terms that bundle.json counts"),
        ("place", _set(0, 2**40), None),
        ("place", _set(3, -(2**40)), "not in ascending order"),
        ("grade", _set(3, 99), "a grade is not from"),
        ("alpha", _set(3, -1), "the mean alpha of a surfel is -1; it must be from 0 to 255"),
        ("alpha", _set(3, 260), "the mean alpha of a surfel is 260; it must be from 0 to 255"),
        ("opacity", _set(3, 2**51), None),  # clipped
    ],
)
def test_numbers_that_no_column_has_are_refused(tmp_path: Path, name: str, change, reason: str | None) -> None:
    folder = write_compact(tmp_path / "b", make_codes(alpha=True))
    recode(folder, name, change, rows=9 if name == "grade" else 12)
    if reason is None:  # other numbers are as valid
        assert len(read_bundle(folder)) == 12
        return
    with pytest.raises(BundleError, match=reason):
        read_bundle(folder)


@pytest.mark.parametrize("version", EARLIER)
def test_bundles_of_earlier_versions_are_read_as_they_were(tmp_path: Path, version: str) -> None:
    folder = write_earlier(version, tmp_path / "b")
    bundle, checks = check_files(folder)
    assert bundle is not None and all(check.ok for check in checks), checks
    assert bundle.info.version == version
    scene, want = bundle.scene, earlier(version)["scene"]
    found = {**scene.surfels, **{name: getattr(scene, name) for name in want if name not in scene.surfels}}
    assert set(found) == set(want)
    for key, data in want.items():
        assert np.ascontiguousarray(found[key].numpy()).tobytes() == data, key


@pytest.mark.parametrize("name", ["surfels.bin", "texels.bin"])
def test_files_of_another_size_are_refused_before_they_are_read(tmp_path: Path, name: str) -> None:
    folder = write_compact(tmp_path / "b", make_codes())
    sparse(folder, name, 40 << 30)
    with pytest.raises(BundleError, match=f"{name}: truncated or too long"):
        read_bundle(folder, verify=False)


@pytest.mark.parametrize("what", ["count", "terms", "texels", "width"])
def test_a_small_file_is_not_said_to_hold_what_takes_gigabytes(what: str, tmp_path: Path) -> None:
    """Constant columns take a few bytes, so the claim is bounded by the file size."""
    folder = write_compact(tmp_path / "b", make_codes())
    size = (folder / "surfels.bin").stat().st_size
    rows = size + (1 << 12) + 1
    many = 64 * (size + (folder / "texels.bin").stat().st_size) + (1 << 20) + 1
    part = "surfels" if what in ("count", "terms") else "atlas"
    amend(folder, lambda i: i[part].update({what: rows if part == "surfels" else many}))

    def refused() -> None:
        with pytest.raises(BundleError, match="cannot be in|must be less than"):
            read_bundle(folder)

    assert peak(refused) < 4 << 20


@pytest.mark.parametrize("name", ["surfels.bin", "texels.bin"])
def test_more_than_the_memory_is_refused_unread(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = write_compact(tmp_path / "b", make_codes())
    info = read_manifest(folder)
    enough = max(least_memory(info, each) for each in ("surfels.bin", "texels.bin"))
    monkeypatch.setattr(sizes, "machine_memory", lambda: enough)
    read_bundle(folder)
    monkeypatch.setattr(sizes, "machine_memory", lambda: least_memory(info, name) - 1)
    with pytest.raises(BundleError, match="needs more memory than there is: its contents take at least"):
        read_bundle(folder)
    assert main(["verify", str(folder)]) == 1
