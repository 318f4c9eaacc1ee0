import errno
import hashlib
import json
import os
import stat

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from bitymi_ns.bake.packing import pack
from bitymi_ns.bake.quantise import Range, encode
from bitymi_ns.bundle import BundleError, World, check_target, ktx2, ply, read_bundle, verify_bundle
from bitymi_ns.bundle import write as bundle_module
from bitymi_ns.bundle.manifest import parse
from bitymi_ns.ops.reference import view_color as reference
from bitymi_ns.ops.view_kinds import VIEW_COLORS
from tests.bake.scenes import write
from tests.bundle.damage import amend, signed
from tests.ops.test_view_color import lean_parameters


def make(surfels, folder, kind="sv", format="uint8", count=6, **kwargs):
    """A bundle of a few surfels and random texels; returns what went in."""
    params = surfels(count, kind)
    packing = pack([[8, 4]] * count)
    texels = np.random.default_rng(0).random((packing.layers, packing.height, packing.width, 3)).astype(np.float32)
    atlas = None if format is None else encode(texels, packing, format, Range(-0.5, 2.0, "test"))
    tiles = packing.tiles if atlas else np.zeros_like(packing.tiles)
    write(folder, params, tiles, atlas, **kwargs)
    return params, tiles, texels, atlas


def make_lean(surfels, folder, kind="sv", count=6):
    """A bundle with lean view colours and without texture; returns its surfels."""
    params = {k: v for k, v in surfels(count, kind).items() if k not in VIEW_COLORS[kind].names}
    params |= lean_parameters(kind, count, torch.float32)
    write(folder, params, np.zeros((count, 5), dtype=np.int32), None, kind=kind)
    return params


def names_beside(folder):
    return sorted(path.name for path in folder.parent.iterdir())


@pytest.mark.parametrize("kind", ["sv", "sh", "sb", "sg"])
@pytest.mark.parametrize("format", ["bc7", "uint8", "fp16", None])
def test_what_is_written_is_read(surfels, tmp_path, kind, format):
    params, tiles, texels, atlas = make(
        surfels, tmp_path / "b", kind, format, near=0.3, weight_bound=0.02, background=(1, 0.5, 0)
    )
    loaded = read_bundle(tmp_path / "b")
    assert loaded.scene.view_color == kind and len(loaded) == 6
    np.testing.assert_array_equal(loaded.scene.tiles.numpy(), tiles)
    assert loaded.scene.tiles.dtype == torch.int32
    torch.testing.assert_close(loaded.scene.surfels["log_scales"], params["log_scales"], rtol=0, atol=0)
    assert loaded.info.render.model_dump() == {
        "alpha_max": 0.99,
        "alpha_min": 1 / 255,
        "t_min": 1e-4,
        "near": 0.3,
        "weight_bound": 0.02,
        "low_pass": 1.0,
        "prefilter": "low_pass",
        "background": (1, 0.5, 0),
    }
    if format is None:
        assert loaded.scene.atlas is None and loaded.info.atlas is None
        assert sorted(os.listdir(tmp_path / "b")) == ["bundle.json", "surfels.ply"]
        return
    assert loaded.scene.atlas.shape == (*texels.shape[:3], 4)
    assert loaded.scene.atlas.dtype == (torch.float32 if format == "fp16" else torch.uint8)
    assert (loaded.scene.offset, loaded.scene.scale) == ((0, 1) if format == "fp16" else (-0.5, 2.0))
    error = float((loaded.scene.residuals() - torch.from_numpy(texels)).square().mean())
    if format != "bc7":  # random texels are what block compression cannot hold
        assert error < (1e-6 if format == "fp16" else (2.0 / 255) ** 2 / 11)
    assert error == pytest.approx(atlas.mse, rel=0.2)
    assert loaded.info.atlas.psnr == pytest.approx(atlas.psnr)


@pytest.mark.parametrize("kind", ["sv", "sh", "sb", "sg"])
def test_lean_view_colours_are_read_as_they_were_written(surfels, tmp_path, kind):
    params = make_lean(surfels, tmp_path / "b", kind)
    loaded = read_bundle(tmp_path / "b")
    assert loaded.scene.view_color == kind and loaded.info.version == "2.1"
    assert set(loaded.scene.surfels) == set(params)
    d = torch.nn.functional.normalize(params["means"], dim=1)
    want = reference.lean(kind, params["view_base"], params["view_span"], params["view_terms"], d)
    got = reference.lean(kind, *(loaded.scene.surfels[name] for name in ("view_base", "view_span", "view_terms")), d)
    assert torch.equal(got, want)  # the terms are in the order of the surfels now


def test_lean_view_colours_that_do_not_fit_are_refused(surfels, tmp_path):
    target = tmp_path / "b"
    params = make_lean(surfels, target)
    with pytest.raises(BundleError, match="surfel 2"):
        bad = {**params, "view_span": params["view_span"].clone()}
        bad["view_span"][2, 1] = 99
        write(tmp_path / "bad", bad, np.zeros((6, 5), dtype=np.int32), None, kind="sv")
    elements = ply.parse_ply((target / "surfels.ply").read_bytes())

    def rewrite(columns=None, terms=None):
        more = {"view_term": terms or elements["view_term"]} if terms != {} else {}
        ply.write_ply(target / "surfels.ply", columns or elements["vertex"], more=more)
        amend(target)
        return read_bundle(target)

    rewrite()
    counts = elements["vertex"]["view_terms"]
    for change in ([1, 0, 0, 0, 0, 0], [-1, 1, 0, 0, 0, 0], [2**31 - 1, 0, 0, 0, 0, 0], [30, -30, 0, 0, 0, 0]):
        with pytest.raises(BundleError, match="does not count"):
            rewrite({**elements["vertex"], "view_terms": (counts + np.int32(change)).astype(np.int32)})
    with pytest.raises(BundleError, match="view_terms is missing"):
        rewrite({k: v for k, v in elements["vertex"].items() if k != "view_terms"})
    with pytest.raises(BundleError, match="needs the properties"):
        rewrite(terms={k: v for k, v in elements["view_term"].items() if k != "term_5"})
    with pytest.raises(BundleError, match="surfels.terms of bundle.json says"):
        rewrite(terms={k: v[:-1] for k, v in elements["view_term"].items()})
    with pytest.raises(BundleError, match="None view-colour terms, surfels.terms"):
        rewrite(terms={})
    with pytest.raises(BundleError, match="not finite"):
        rewrite(terms={k: v * np.float32("nan") for k, v in elements["view_term"].items()})
    rewrite()
    amend(target, lambda info: info["surfels"].update(terms=None))
    with pytest.raises(BundleError, match="surfels.terms"):
        read_bundle(target)


def test_the_manifest_states_files_world_and_statistics(surfels, tmp_path):
    world = World(np.arange(12).reshape(3, 4), 0.25)
    statistics = {"psnr": np.float32(27.5), "never": float("nan"), "views": torch.tensor([1, 2]), "path": tmp_path}
    extra = {"preview.png": b"\x89PNG...", "config.yml": b"method: bitymi\n"}
    params, *_ = make(surfels, tmp_path / "b", world=world, statistics=statistics, extra_files=extra)
    info = verify_bundle(tmp_path / "b").model_dump(mode="json")
    assert (info["format"], info["version"]) == ("bitymi-bundle", "1.2")
    assert info["generator"].startswith("bitymi-ns ")
    assert info["world"] == {"transform": [[0, 1, 2, 3], [4, 5, 6, 7], [8, 9, 10, 11]], "scale": 0.25}
    assert info["statistics"] == {"psnr": 27.5, "never": None, "views": [1, 2], "path": str(tmp_path)}
    assert info["bounds"]["min"] == pytest.approx(params["means"].amin(0).tolist())
    assert info["color_bias"] == 0.5 and info["surfels"]["sites"] == 7 and info["surfels"]["support"] == 3
    assert sorted(info["files"]) == ["atlas.ktx2", "config.yml", "preview.png", "surfels.ply"]
    for name, entry in info["files"].items():
        data = (tmp_path / "b" / name).read_bytes()
        assert entry == {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}


def test_an_existing_folder_is_refused_unless_it_is_a_bundle_to_overwrite(surfels, tmp_path):
    target = tmp_path / "b"
    target.mkdir()
    make(surfels, target)  # an empty folder is no loss
    with pytest.raises(BundleError, match="is a bundle already"):
        make(surfels, target, "sh")
    assert read_bundle(target).scene.view_color == "sv"
    make(surfels, target, "sh", overwrite=True)
    assert read_bundle(target).scene.view_color == "sh"
    assert names_beside(target) == ["b"]
    home = tmp_path / "home"
    home.mkdir()
    (home / "thesis.tex").write_text("years of work")
    with pytest.raises(BundleError, match="not a bundle"):
        make(surfels, home, overwrite=True)
    with pytest.raises(BundleError, match="not a folder"):
        make(surfels, home / "thesis.tex", overwrite=True)
    with pytest.raises(BundleError, match="not a bundle"):
        check_target(home, overwrite=True)
    assert (home / "thesis.tex").read_text() == "years of work"


def raiser(error):
    def fail(*args, **kwargs):
        raise error

    return fail


@pytest.mark.parametrize("step", [(ply, "write_ply"), (ktx2, "write_ktx2"), (bundle_module, "_fingerprint")])
@pytest.mark.parametrize("overwrite", [False, True])
def test_a_full_disk_leaves_nothing_behind(surfels, tmp_path, monkeypatch, step, overwrite):
    target = tmp_path / "b"
    if overwrite:
        make(surfels, target, "sg")
    monkeypatch.setattr(*step, raiser(OSError(errno.ENOSPC, "No space left on device")))
    with pytest.raises(BundleError, match=r"needs about [1-9].* (bytes|kB)\): the disk is full"):
        make(surfels, target, overwrite=overwrite)
    assert names_beside(target) == (["b"] if overwrite else [])
    if overwrite:
        assert read_bundle(target).scene.view_color == "sg"


@pytest.mark.parametrize("error", [KeyboardInterrupt(), MemoryError(), RuntimeError("bug")])
def test_an_interrupted_write_leaves_nothing_behind(surfels, tmp_path, monkeypatch, error):
    monkeypatch.setattr(ktx2, "write_ktx2", raiser(error))
    with pytest.raises(type(error)):
        make(surfels, tmp_path / "b")
    assert list(tmp_path.iterdir()) == []


def test_a_failed_swap_puts_the_old_bundle_back(surfels, tmp_path, monkeypatch):
    target = tmp_path / "b"
    make(surfels, target, "sg")
    rename = type(target).rename

    def fail_for_the_new_one(self, to):
        if self.name.endswith(".new"):
            raise OSError(errno.EIO, "Input/output error")
        return rename(self, to)

    monkeypatch.setattr(type(target), "rename", fail_for_the_new_one)
    with pytest.raises(BundleError, match="Input/output error"):
        make(surfels, target, overwrite=True)
    monkeypatch.undo()
    assert read_bundle(target).scene.view_color == "sg" and names_beside(target) == ["b"]


@pytest.mark.parametrize(
    ("number", "why"), [(errno.EROFS, "the file system is read-only"), (errno.EDQUOT, "your quota"), (errno.EIO, "I/O")]
)
def test_what_cannot_be_written_is_explained_by_its_cause(surfels, tmp_path, monkeypatch, number, why):
    monkeypatch.setattr(ply, "write_ply", raiser(OSError(number, "I/O")))
    with pytest.raises(BundleError, match=why) as error:
        make(surfels, tmp_path / "b")
    assert ("needs about" in str(error.value)) == (number == errno.EDQUOT)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_without_permission_is_a_clear_error(surfels, tmp_path):
    tmp_path.chmod(stat.S_IRUSR | stat.S_IXUSR)
    try:
        with pytest.raises(BundleError, match="cannot be written"):
            make(surfels, tmp_path / "b")
    finally:
        tmp_path.chmod(stat.S_IRWXU)


def test_parameters_that_are_not_finite_are_not_written(surfels, tmp_path):
    params = surfels(3)
    params["log_scales"][1, 0] = float("nan")
    with pytest.raises(BundleError, match="log_scales is not finite in row 1"):
        write(tmp_path / "b", params, np.zeros((3, 5), dtype=np.int32), None)
    with pytest.raises(BundleError, match="rows"):
        write(tmp_path / "b", surfels(3), np.zeros((2, 5), dtype=np.int32), None)
    with pytest.raises(BundleError, match="cannot be the name"):
        make(surfels, tmp_path / "b", extra_files={"../escape": b""})
    with pytest.raises(BundleError, match="may not replace"):
        make(surfels, tmp_path / "b", extra_files={"surfels.ply": b""})
    assert list(tmp_path.iterdir()) == []


def test_damage_is_named(surfels, tmp_path):
    target = tmp_path / "b"
    make(surfels, target, extra_files={"preview.png": b"picture"})
    originals = {path.name: path.read_bytes() for path in target.iterdir()}
    for name in ("surfels.ply", "atlas.ktx2", "preview.png"):
        path = target / name
        path.write_bytes(originals[name][:-1])
        with pytest.raises(BundleError, match=f"{name} is truncated"):
            read_bundle(target)
        path.write_bytes(originals[name][:-1] + bytes([originals[name][-1] ^ 1]))
        with pytest.raises(BundleError, match=f"{name} is altered"):
            read_bundle(target)
        path.unlink()
        with pytest.raises(BundleError, match=f"{name} is missing"):
            read_bundle(target)
        path.write_bytes(originals[name])
    read_bundle(target)
    (target / "bundle.json").unlink()
    with pytest.raises(BundleError, match="not a bundle"):
        read_bundle(target)
    with pytest.raises(BundleError, match="not a bundle"):
        read_bundle(tmp_path / "nothing")


def test_versions(surfels, tmp_path):
    target = tmp_path / "b"
    make(surfels, target)
    amend(target, lambda info: info.update(version="1.7", holograms={"yes": True}))
    assert read_bundle(target).info.holograms == {"yes": True}
    amend(target, lambda info: info.update(version="3.0"))
    with pytest.raises(BundleError, match="update bitymi-ns"):
        read_bundle(target)
    amend(target, lambda info: info.update(version="one"))
    with pytest.raises(BundleError, match="must look like"):
        read_bundle(target)


@pytest.mark.parametrize(
    "change, reason",
    [
        (lambda i: i.update(format="zip"), "not a bundle"),
        (lambda i: i.pop("surfels"), "surfels is missing"),
        (lambda i: i["surfels"].update(count=7), "it has 6 surfels, surfels.count of bundle.json says 7"),
        (lambda i: i["surfels"].update(count=-1), "surfels.count must be greater than or equal to 0, not -1"),
        (lambda i: i["surfels"].update(count=True), "surfels.count must be a valid integer, not True"),
        (lambda i: i["surfels"].update(count=6.0), "surfels.count must be a valid integer, not 6.0"),
        (lambda i: i["surfels"].pop("count"), "surfels.count is missing"),
        (lambda i: i["surfels"].update(view_color="sh"), "surfels.ply"),
        (lambda i: i["atlas"].update(width=20), "not those of"),
        (lambda i: i["atlas"].update(offset=10**400), "atlas.offset must be a finite number"),
        (lambda i: i["atlas"].update(scale=0), "atlas.scale must be greater than 0, not 0"),
        (lambda i: i["atlas"].update(scale=1e30), r"atlas.scale must be less than or equal to 512, not 1e\+30"),
        (lambda i: i["atlas"].update(file="../surfels.ply"), "atlas.file must be 'atlas.ktx2', not '../surfels.ply'"),
        (lambda i: i["surfels"].update(file="atlas.ktx2"), "surfels.file must be 'surfels.ply'"),
        (lambda i: i.update(atlas=None), "disagree"),
        (lambda i: i["files"].pop("atlas.ktx2"), "disagree"),
        (lambda i: i["files"].update({"../../etc/passwd": {"bytes": 1, "sha256": "0" * 64}}), "cannot be the name"),
        (lambda i: i["files"].update({"extra": []}), "files.extra must be an object"),
        (lambda i: i["files"]["surfels.ply"].update(sha256="no"), "files.surfels.ply.sha256 must match"),
        (lambda i: i["files"]["surfels.ply"].update(bytes=-1), "files.surfels.ply.bytes must be"),
        (lambda i: i["render"].update(near="close"), "render.near must be a valid number, not 'close'"),
        (lambda i: i["render"].update(near=0), "render.near must be greater than or equal to .*, not 0"),
        (lambda i: i["render"].update(background=[0, 9e29, 0]), "render.background.1 must be less than or equal to 1"),
        (lambda i: i["render"].update(weight_bound=False), "render.weight_bound must be a valid number, not False"),
        (
            lambda i: i["render"].update(t_min=1e-3),
            "render.t_min must be 0.0001, which is what is drawn",
        ),
        (lambda i: i["surfels"].update(support=4), "surfels.support must be 3.0"),
        (lambda i: i.update(color_bias=0), "color_bias must be 0.5"),
        (
            lambda i: i["world"].update(transform=[[1]]),
            r"transform.0.1 is .*0.3 is missing \(and 2 more\)",
        ),
        (lambda i: i["world"].update(scale=-1), "world.scale must be greater than 0"),
        (lambda i: i["bounds"].update(min=[0, 0, 1e300]), "bounds.min.2 must be"),
        (lambda i: i.update(statistics=[1, 2]), r"statistics must be an object, not \[1, 2\]"),
        (
            lambda i: i["statistics"].update(options={"r_max": "wide"}),
            "statistics.options.r_max must be a valid",
        ),
        (lambda i: i["statistics"].update(error=3), "statistics.error must be an object, not 3"),
        (lambda i: i.update(generator="\ud800"), "hex escape"),
    ],
)
def test_a_manifest_that_contradicts_the_files_is_refused(surfels, tmp_path, change, reason):
    make(surfels, tmp_path / "b")
    amend(tmp_path / "b", change)
    with pytest.raises(BundleError, match=reason):
        read_bundle(tmp_path / "b")


def test_tiles_outside_the_atlas_are_refused(surfels, tmp_path):
    params = surfels(1)
    packing = pack([[8, 8]])
    atlas = encode(np.zeros((1, 8, 8, 3), dtype=np.float32), packing, "uint8")
    bad_tiles = [[4, 0, 0, 8, 8], [0, 4, 0, 8, 8], [0, 0, 1, 8, 8], [-4, 0, 0, 8, 8], [0, 0, 0, 8, 0]]
    for i, tile in enumerate(bad_tiles):
        write(tmp_path / str(i), params, np.array([tile], dtype=np.int32), atlas)
        with pytest.raises(BundleError, match="outside the atlas"):
            read_bundle(tmp_path / str(i))


@pytest.fixture(scope="module")
def good_bundle(tmp_path_factory):
    return tmp_path_factory.mktemp("damage") / "b"


@settings(deadline=None, max_examples=250)
@given(st.data())
def test_damaged_files_raise_only_bundle_errors(surfels, good_bundle, data):
    if not good_bundle.exists():
        make(surfels, good_bundle, "sb", "bc7", count=2)
    name = data.draw(st.sampled_from(["surfels.ply", "atlas.ktx2", "bundle.json"]))
    path = good_bundle / name
    good = path.read_bytes()
    bad = bytearray(good[: data.draw(st.one_of(st.just(len(good)), st.integers(0, len(good))))])
    for _ in range(data.draw(st.integers(0, 3))):
        if bad:
            bad[data.draw(st.integers(0, len(bad) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(bad)
    try:
        for verify in (True, False):
            try:
                read_bundle(good_bundle, verify)
                same = parse if name == "bundle.json" else bytes  # of JSON, white space may differ
                assert same(bytes(bad)) == same(good) or (name != "bundle.json" and not verify)
            except BundleError as error:
                assert str(error)
    finally:
        path.write_bytes(good)


@settings(deadline=None, max_examples=100)
@given(st.recursive(st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
                    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner)), st.data())  # fmt: skip
def test_any_json_in_any_place_raises_only_bundle_errors(surfels, good_bundle, value, data):
    if not good_bundle.exists():
        make(surfels, good_bundle, "sb", "bc7", count=2)
    path = good_bundle / "bundle.json"
    good = path.read_bytes()
    info = json.loads(good)
    at = info
    while True:
        key = data.draw(st.sampled_from(sorted(at)))
        if not isinstance(at[key], dict) or not at[key] or data.draw(st.booleans()):
            break
        at = at[key]
    at[key] = value
    try:
        path.write_bytes(signed(info))
    except ValueError:  # a number that is not finite
        path.write_bytes(json.dumps(info).encode("utf-8", "surrogatepass"))
    try:
        read_bundle(good_bundle)
    except BundleError as error:
        assert str(error)
    finally:
        path.write_bytes(good)
