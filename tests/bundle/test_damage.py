"""Damaged or contradictory bundles are refused with the file's name; random damage: tests/stress."""

import base64

import numpy as np
import pytest
import torch

from bitymi_ns.bundle import BundleError, check_files, read_bundle
from bitymi_ns.bundle.manifest import POSTER, points_text
from bitymi_ns.codec.packing import pack
from bitymi_ns.codec.quantise import encode
from tests.bake.scenes import write
from tests.bundle.damage import amend
from tests.bundle.made import make


@pytest.mark.parametrize(
    "change, options, reason",
    [
        (("log_scales", (1, 0), float("nan")), {}, "log_scales is not finite in row 1"),
        (("sv_rgb", (3, 1, 2), 1e4), {}, "sv_rgb_5 is 10000 in row 3; it must be from -256 to 256"),
        (("quats", 2, 0.0), {}, "quats has the length 0 in row 2"),
        (None, {"tiles": np.zeros((2, 5), dtype=np.int32)}, "rows"),
        (None, {"background": (255, 0, 0)}, "render.background.0 must be less than or equal to 1"),
        (None, {"extra_files": {"../escape": b""}}, "cannot be the name"),
        *((None, {"extra_files": {name: b""}}, f"may not replace {name}") for name in ("surfels.ply", POSTER)),
    ],
)
def test_what_would_be_refused_is_not_written(surfels, tmp_path, change, options, reason):
    params = surfels(6)
    if change is not None:
        name, entry, value = change
        params[name][entry] = value
    with pytest.raises(BundleError, match=reason):
        write(tmp_path / "b", params, **options)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "means, reason",
    [
        (None, "the atlas has alphas, the surfels have no mean alphas"),
        (torch.full((6,), 2.5), "alpha is 2.5 in row 0; it must be from 0 to 2"),
    ],
)
def test_alphas_without_their_means_are_not_written(surfels, tmp_path, means, reason):
    with pytest.raises(BundleError, match=reason):
        make(surfels, tmp_path / "b", alpha=True, mean_alpha=means)
    assert list(tmp_path.iterdir()) == []


def failures(folder):
    return [check.name for check in check_files(folder)[1] if not check.ok]


def test_damage_is_named(surfels, tmp_path):
    target = tmp_path / "b"
    make(surfels, target, extra_files={"preview.png": b"picture"})
    originals = {path.name: path.read_bytes() for path in target.iterdir()}
    for name in ("surfels.ply", "atlas.ktx2", "preview.png"):
        path, whole = target / name, originals[name]
        altered = whole[:-1] + bytes([whole[-1] ^ 1])
        for data, problem in ((whole[:-1], "truncated"), (altered, "altered"), (None, "missing")):
            path.unlink() if data is None else path.write_bytes(data)
            expected = pytest.raises(BundleError, match=f"{name} is {problem}")
            if name == "preview.png":
                expected = pytest.warns(UserWarning, match=f"{name} is {problem}.* It is left out")
            with expected:
                read_bundle(target)
            assert failures(target) == [name]
        path.write_bytes(whole)
    read_bundle(target)
    (target / "bundle.json").unlink()
    assert failures(target) == ["bundle.json"]
    with pytest.raises(BundleError, match="not a bundle"):
        read_bundle(target)
    with pytest.raises(BundleError, match="not a bundle"):
        read_bundle(tmp_path / "nothing")


POINTS = ([0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, float("nan")], [float("inf"), 0.0, 0.0, 1.0])
PHOTOGRAPHED = [points_text(torch.tensor([point])) for point in POINTS]
PHOTOGRAPHED += ["no base64!", base64.b64encode(b"12345").decode(), points_text(torch.ones(5000, 4))]


@pytest.mark.parametrize(
    "change, reason",
    [
        (lambda i: i.update(format="zip"), "not a bundle"),
        (lambda i: i["surfels"].update(count=7), "it has 6 surfels, surfels.count of bundle.json says 7"),
        (lambda i: i["surfels"].update(count=-1), "surfels.count must be greater than or equal to 0, not -1"),
        (lambda i: i["surfels"].update(count=True), "surfels.count must be a valid integer, not True"),
        (lambda i: i["surfels"].pop("count"), "surfels.count is missing"),
        (lambda i: i.pop("surfels"), "surfels is missing"),
        (lambda i: i["render"].update(near="close"), "render.near must be a valid number, not 'close'"),
        (lambda i: i["surfels"].update(view_color="sh"), "surfels.ply"),
        (lambda i: i["atlas"].update(width=20), "not those of"),
        (lambda i: i["atlas"].update(offset=10**400), "atlas.offset must be a finite number"),
        (lambda i: i["atlas"].update(scale=0), "atlas.scale must be greater than 0, not 0"),
        (lambda i: i["atlas"].update(scale=1e30), r"atlas.scale must be less than or equal to 512, not 1e\+30"),
        (lambda i: i["atlas"].update(file="../surfels.ply"), "atlas.file must be .* or 'texels.bin', not '../surfels"),
        (lambda i: i["surfels"].update(file="atlas.ktx2"), "surfels.file must be 'surfels.ply'"),
        (lambda i: i.update(atlas=None), "disagree"),
        (lambda i: i["files"].pop("atlas.ktx2"), "disagree"),
        (lambda i: i["files"].update({"../../etc/passwd": {"bytes": 1, "sha256": "0" * 64}}), "cannot be the name"),
        (lambda i: i["files"].update({"extra": []}), "files.extra must be an object"),
        (lambda i: i["files"]["surfels.ply"].update(sha256="no"), "files.surfels.ply.sha256 must match"),
        (lambda i: i["render"].update(near=0), "render.near must be greater than or equal to .*, not 0"),
        (lambda i: i["render"].update(background=[0, 9e29, 0]), "render.background.1 must be less than or equal to 1"),
        (lambda i: i["render"].update(weight_bound=False), "render.weight_bound must be a valid number, not False"),
        (lambda i: i["render"].update(prefilter="pixel"), "render.prefilter must be 'low_pass', not 'pixel'"),
        (lambda i: i["render"].update(t_min=1e-3), "render.t_min must be 0.0001, which is what is drawn"),
        (lambda i: i["surfels"].update(support=4), "surfels.support must be 3.0"),
        (lambda i: i.update(color_bias=0), "color_bias must be 0.5"),
        (lambda i: i["world"].update(transform=[[1]]), r"transform.0.1 is .*0.3 is missing \(and 2 more\)"),
        (lambda i: i["world"].update(scale=-1), "world.scale must be greater than 0"),
        (lambda i: i["bounds"].update(min=[0, 0, 1e300]), "bounds.min.2 must be"),
        (lambda i: i.update(statistics=[1, 2]), r"statistics must be an object, not \[1, 2\]"),
        (lambda i: i["statistics"].update(options={"r_max": "wide"}), "statistics.options.r_max must be a valid"),
        (lambda i: i["statistics"].update(certificate=3), "statistics.certificate must be an object, not 3"),
        *((lambda i, text=text: i["render"].update(photographed=text), "photographed") for text in PHOTOGRAPHED),
    ],
)
def test_a_manifest_that_contradicts_the_files_is_refused(surfels, tmp_path, change, reason):
    make(surfels, tmp_path / "b")
    amend(tmp_path / "b", change)
    with pytest.raises(BundleError, match=reason):
        read_bundle(tmp_path / "b")


def test_tiles_outside_the_atlas_are_refused(surfels, tmp_path, monkeypatch):
    params = surfels(1)
    packing = pack([[8, 8]])
    atlas = encode(np.zeros((1, 8, 8, 3), dtype=np.float32), packing, "uint8")
    bad_tiles = [[4, 0, 0, 8, 8], [0, 4, 0, 8, 8], [0, 0, 1, 8, 8], [-4, 0, 0, 8, 8], [0, 0, 0, 8, 0]]
    for i, tile in enumerate(bad_tiles):
        with pytest.raises(BundleError, match="was not written.*outside the atlas"):
            write(tmp_path / str(i), params, np.array([tile], dtype=np.int32), atlas)
        assert not list(tmp_path.iterdir())
    monkeypatch.setattr("bitymi_ns.bundle.write.read_bundle", str)  # as a program that does not read what it wrote
    for i, tile in enumerate(bad_tiles):
        write(tmp_path / str(i), params, np.array([tile], dtype=np.int32), atlas)
        with pytest.raises(BundleError, match="outside the atlas"):
            read_bundle(tmp_path / str(i))
