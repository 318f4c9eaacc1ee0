"""bundle.json: every change is detected, and refusals are one sentence."""

import hashlib
import json
import re
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from bitymi_ns.bundle import check_files, strict_json
from bitymi_ns.bundle.manifest import AtlasEntry, BundleError, describe, dump, parse
from bitymi_ns.bundle.single import write_single
from bitymi_ns.codec.limits import BRIGHTEST, COLOR_LIMIT, RESIDUAL_LIMIT
from bitymi_ns.ops.view_color import MAX_TERMS
from tests.bundle.compact_scene import make_codes, write_compact
from tests.bundle.damage import amend, signed
from tests.bundle.made import make

INFO = {
    "format": "bitymi-bundle",
    "version": "6.0",
    "surfels": {"count": 3, "view_color": "sv"},
    "atlas": None,
    "render": {"near": 0.2, "weight_bound": 0.02, "background": [0, 0.5, 1]},
    "world": {"transform": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]], "scale": 1.0},
    "bounds": {"min": [0, 0, 0], "max": [1, 1, 1]},
    "statistics": {"views": 7, "never": None, "surfels": {"kept": 3}},
    "files": {"surfels.ply": {"bytes": 10, "sha256": "0" * 64}},
}


def refusal(data: bytes) -> str:
    with pytest.raises(BundleError) as refused:
        parse(data, "b/bundle.json")
    assert "\n" not in str(refused.value) and len(str(refused.value)) < 300
    return str(refused.value)


def test_what_is_written_is_read_and_nothing_is_added_by_writing_again():
    manifest = describe(INFO)
    data = dump(manifest)
    assert parse(data) == manifest.model_copy(update={"digest": json.loads(data)["digest"]})
    assert dump(parse(data)) == data
    stated = json.loads(data)
    assert stated["statistics"] == INFO["statistics"] and stated["atlas"] is None and "held_out" not in stated
    assert stated["render"]["alpha_max"] == 0.99 and "terms" not in stated["surfels"]


def test_a_digest_covers_everything_else_and_not_the_layout():
    data = dump(describe(INFO))
    info = json.loads(data)
    backwards = dict(reversed(info.items()))
    assert parse(json.dumps(backwards).encode()) == parse(data)
    found = strict_json.digest({key: value for key, value in info.items() if key != "digest"})
    assert info["digest"] == found

    for change in ({"generator": "other"}, {"note": 1}, {"statistics": {}}, {"version": "6.1"}):
        edited = {**info, **change}
        message = refusal(json.dumps(edited).encode())
        assert "is altered: its digest is not that of its contents" in message
        right = message.rsplit('"', 2)[1]  # the digest to insert for a deliberate edit
        assert parse(json.dumps({**edited, "digest": right}).encode()).digest == right


def test_a_bundle_without_a_digest_and_of_another_version_is_refused():
    message = refusal(json.dumps(INFO).encode())
    assert 'digest is missing; if you have edited it on purpose, set "digest" to "' in message
    for version in ("0.9", "1.3", "2.2", "3.0", "5.0"):
        assert "is read no longer: export it again" in refusal(signed({**INFO, "version": version}))
    assert "update bitymi-ns" in refusal(signed({**INFO, "version": "7.0"}))
    assert "version must look like" in refusal(signed({**INFO, "version": "one"}))
    assert parse(signed({**INFO, "version": "6.7", "holograms": {"yes": True}})).holograms == {"yes": True}


@pytest.mark.parametrize(
    "text, reason",
    [
        (b'"count": 3, "count": 3', "the key 'count' occurs twice"),
        (b'"count": NaN', "NaN is not a finite number"),
        (b'"count": -Infinity', "-Infinity is not a finite number"),
        (b'"count": 1e999', "1e999 is not a finite number"),
        (b'"count": ' + b"9" * 5000, "cannot be read as JSON"),
        (b'"count": ' + b"[" * 100_000, "nested too deeply"),
        (b'"count": ' + b"[" * 400 + b"]" * 400, "recursion limit"),
        (b'"count": 03', "cannot be read as JSON"),
        (b'"count": "\xff"', "cannot be read as JSON"),
        (b'"count": "\\ud800"', "cannot be read|hex escape"),
    ],
    ids=lambda value: str(value[:24]),
)
def test_traps_of_json_are_refused(text, reason):
    data = signed(INFO).replace(b'"count": 3', text)
    assert re.search(reason, refusal(data))


def test_a_value_that_would_be_refused_is_not_written():
    with pytest.raises(BundleError, match="cannot be described: render.near must be"):
        describe({**INFO, "render": {**INFO["render"], "near": 0.0}})
    manifest = describe(INFO)
    manifest.render.near = float("nan")
    with pytest.raises(BundleError, match="render.near"):
        dump(manifest)


def test_the_limits_keep_colours_below_the_stated_bound():
    lobes = (1 + MAX_TERMS) * COLOR_LIMIT + MAX_TERMS * 0.1  # softplus adds 0.1 at 0
    harmonics = COLOR_LIMIT * 16 * (16 / 12.57) ** 0.5  # the squares of the basis add up to 16 / 4 pi
    residual = 3 * RESIDUAL_LIMIT  # the largest offset and the largest scale
    atlas = {"format": "bc7", "width": 4, "height": 4, "layers": 1, "offset": RESIDUAL_LIMIT}
    AtlasEntry.model_validate({**atlas, "scale": 2 * RESIDUAL_LIMIT})
    with pytest.raises(ValueError):
        AtlasEntry.model_validate({**atlas, "scale": 2.01 * RESIDUAL_LIMIT})
    assert max(lobes, harmonics) + 0.5 + residual + 1.0 < BRIGHTEST


def quick(action: Callable[[], object]) -> None:
    begin = time.process_time()
    action()
    assert time.process_time() - begin < 2


@pytest.mark.parametrize("where", ["at the end", "at the start"])
def test_a_key_that_is_there_twice_among_many_is_found_at_once(where: str) -> None:
    keys = [f'"k{k}":0' for k in range(100_000)]
    keys.insert(len(keys) if where == "at the end" else 1, keys[-1] if where == "at the end" else keys[0])

    def refused() -> None:
        with pytest.raises(ValueError, match="the key 'k[0-9]+' occurs twice"):
            strict_json.loads(f"{{{','.join(keys)}}}".encode())

    quick(refused)


@pytest.mark.parametrize(
    "change",
    [
        lambda info: info["files"].update({f"f{k}": {"bytes": 0, "sha256": "0" * 64} for k in range(30_000)}),
        lambda info: info["files"].update({f"f{k}": [] for k in range(30_000)}),
        lambda info: info["statistics"].update({"finetune": {"curve": ["x"] * 200_000}}),
        lambda info: info["surfels"].update(columns=["x"] * 200_000),
        lambda info: info["surfels"].update(activations={f"a{k}": 1 for k in range(50_000)}),
    ],
    ids=["files", "wrong files", "a curve", "columns", "activations"],
)
def test_a_refusal_of_much_takes_no_longer_than_reading_it(surfels, tmp_path: Path, change: Callable[[dict], object]):
    make(surfels, tmp_path / "b")
    info = json.loads((tmp_path / "b" / "bundle.json").read_text())
    change(info)
    text = signed(info)

    def refused() -> None:
        with pytest.raises(BundleError) as error:
            parse(text)
        assert len(str(error.value)) < 500

    quick(refused)


def test_many_files_are_verified_in_a_folder_and_in_one_file(tmp_path: Path) -> None:
    folder, count = write_compact(tmp_path / "b", make_codes(count=40)), 1000
    for k in range(count):
        (folder / f"photograph-{k:05d}.jpg").touch()
    empty = {"bytes": 0, "sha256": hashlib.sha256(b"").hexdigest()}
    amend(folder, lambda info: info["files"].update({f"photograph-{k:05d}.jpg": empty for k in range(count)}))
    quick(lambda: write_single(folder, tmp_path / "b.bitymi"))

    def verified(path: Path) -> None:
        _, checks = check_files(path)
        assert len(checks) > count and all(check.ok for check in checks)

    quick(lambda: verified(folder))
    quick(lambda: verified(tmp_path / "b.bitymi"))
