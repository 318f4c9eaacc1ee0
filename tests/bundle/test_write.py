"""Written bundles round-trip, and a failed write leaves the earlier one."""

import errno
import hashlib
import os

import numpy as np
import pytest
import torch

from bitymi_ns import ply
from bitymi_ns.bundle import BundleError, World, ktx2, read_bundle
from bitymi_ns.bundle import write as bundle_module
from bitymi_ns.bundle.cameras import CapturedCamera, cameras_data
from bitymi_ns.bundle.parts import check_target
from bitymi_ns.ops.reference import view_color as reference
from bitymi_ns.ops.view_kinds import VIEW_COLORS
from tests.bake.scenes import write
from tests.bundle.damage import amend
from tests.bundle.made import make
from tests.cuda.baked_scenes import front


def names_beside(folder):
    return sorted(path.name for path in folder.parent.iterdir())


@pytest.mark.parametrize("kind, format", [("sv", "bc7"), ("sh", "uint8"), ("sb", "fp16"), ("sg", None)])
def test_what_is_written_is_read(surfels, tmp_path, kind, format):
    params, tiles, texels, atlas = make(
        surfels, tmp_path / "b", kind, format, near=0.3, weight_bound=0.02, background=(1, 0.5, 0)
    )
    loaded = read_bundle(tmp_path / "b")
    assert loaded.scene.view_color == kind and len(loaded) == 6
    np.testing.assert_array_equal(loaded.scene.tiles.numpy(), tiles)
    assert loaded.scene.tiles.dtype == torch.int32
    torch.testing.assert_close(loaded.scene.surfels["log_scales"], params["log_scales"], rtol=0, atol=0)
    stated = dict(near=0.3, weight_bound=0.02, low_pass=1.0, photographed=None)
    limits = dict(alpha_max=0.99, alpha_min=1 / 255, t_min=1e-4, background=(1, 0.5, 0))
    assert loaded.info.render.model_dump() == stated | limits
    if format is None:
        assert loaded.scene.atlas is None and loaded.info.atlas is None
        assert sorted(os.listdir(tmp_path / "b")) == ["bundle.json", "surfels.ply"]
        return
    assert loaded.scene.atlas.shape == (*texels.shape[:3], 4)
    assert loaded.scene.atlas.dtype == (torch.float32 if format == "fp16" else torch.uint8)
    assert (loaded.scene.offset, loaded.scene.scale) == ((0, 1) if format == "fp16" else (-0.5, 2.0))
    error = float((loaded.scene.residuals() - torch.from_numpy(texels)).square().mean())
    if format != "bc7":  # block compression cannot hold random texels
        assert error < (1e-6 if format == "fp16" else (2.0 / 255) ** 2 / 11)
    assert error == pytest.approx(atlas.mse, rel=0.2)
    assert loaded.info.atlas.psnr == pytest.approx(atlas.psnr)


@pytest.mark.parametrize("correction", [torch.tensor([0.5, 1.0, 2.0]), torch.arange(12.0).view(3, 4), None])
def test_photographs_keep_their_resolution_and_correction(surfels, tmp_path, correction) -> None:
    points = torch.tensor([[0.0, 1.0, -2.5, 30.0], [1e-3, 7.0, 0.25, 1e6]])
    text = cameras_data([CapturedCamera.of("a", front(), True, correction=correction)])
    make(surfels, tmp_path / "b", photographed=points, extra_files={"cameras.json": text})
    bundle = read_bundle(tmp_path / "b")
    assert torch.equal(bundle.scene.photographed, points) and (b"correction" in text) == (correction is not None)
    (row,) = bundle.cameras
    assert row.exposure is None if correction is None else torch.equal(row.exposure, correction)


@pytest.mark.parametrize("reduced", [False, True])
@pytest.mark.parametrize("format", ["bc7", "uint8", "fp16"])
def test_alphas_are_read_as_they_were_written(surfels, tmp_path, format, reduced):
    _, _, texels, atlas = make(surfels, tmp_path / "b", "sh", format, reduced=reduced, alpha=True)
    loaded = read_bundle(tmp_path / "b")
    assert loaded.info.version == "6.0" and loaded.scene.alpha_scale == loaded.info.atlas.alpha_scale
    torch.testing.assert_close(loaded.scene.mean_alpha, torch.linspace(0, 2, 6), rtol=0, atol=0)
    alphas = loaded.scene.alphas()
    torch.testing.assert_close(alphas, torch.from_numpy(atlas.decoded()[..., 3]))
    if format != "bc7":
        assert float((alphas - torch.from_numpy(texels[..., 3])).abs().max()) < (
            1e-3 if format == "fp16" else 0.51 / 128
        )
    assert float((loaded.scene.residuals() - torch.from_numpy(texels[..., :3])).square().mean()) < 2 * atlas.mse


@pytest.mark.parametrize("kind", VIEW_COLORS)
def test_reduced_view_colours_are_read_as_they_were_written(surfels, tmp_path, kind):
    params, *_ = make(surfels, tmp_path / "b", kind, None, reduced=True)
    loaded = read_bundle(tmp_path / "b")
    assert loaded.scene.view_color == kind and loaded.info.version == "6.0"
    assert set(loaded.scene.surfels) == set(params)
    d = torch.nn.functional.normalize(params["means"], dim=1)
    want = reference.reduced(kind, params["view_base"], params["view_span"], params["view_terms"], d)
    got = reference.reduced(kind, *(loaded.scene.surfels[name] for name in ("view_base", "view_span", "view_terms")), d)
    assert torch.equal(got, want)  # the terms are in the order of the surfels now


def test_reduced_view_colours_that_do_not_fit_are_refused(surfels, tmp_path):
    target = tmp_path / "b"
    params, *_ = make(surfels, target, format=None, reduced=True)
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
    info = read_bundle(tmp_path / "b").info.model_dump(mode="json")
    assert (info["format"], info["version"]) == ("bitymi-bundle", "6.0")
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
    with pytest.raises(BundleError, match="is there already: .* or add --overwrite True"):
        make(surfels, target, "sh")
    assert read_bundle(target).scene.view_color == "sv"
    make(surfels, target, "sh", overwrite=True)
    assert read_bundle(target).scene.view_color == "sh"
    assert names_beside(target) == ["b"]
    (target / "thesis.tex").write_text("years of work")
    with pytest.raises(BundleError, match="also holds thesis.tex, which would be lost"):
        make(surfels, target, overwrite=True)
    assert (target / "thesis.tex").read_text() == "years of work" and read_bundle(target).scene.view_color == "sh"
    (target / "thesis.tex").rename(target / "bundle.json")
    with pytest.raises(BundleError, match="bundle.json cannot be read"):
        make(surfels, target, overwrite=True)
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
    with pytest.raises(BundleError, match="the disk reports an error"):
        make(surfels, target, overwrite=True)
    monkeypatch.undo()
    assert read_bundle(target).scene.view_color == "sg" and names_beside(target) == ["b"]
