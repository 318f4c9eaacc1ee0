from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from bitymi_ns.bake import BakeOptions, RefineOptions, TuneOptions, bake, bake_field, export
from bitymi_ns.bake.compact import Compact
from bitymi_ns.bundle import read_bundle
from bitymi_ns.progress import rich_progress
from bitymi_ns.scene import Camera
from bitymi_ns.train.init import tangents
from bitymi_ns.train.views import View


def bilinear(bundle, surfel, u, v, extent=3.0):
    """Evaluate the residual at (u, v) in [-3, 3]^2 of a surfel, clamped to the outer texel centres."""
    x, y, layer, r_u, r_v = bundle.scene.tiles[surfel].tolist()
    texels = bundle.scene.residuals()[layer, y : y + r_v, x : x + r_u].permute(2, 0, 1)[None]
    grid = torch.stack([u, v], dim=-1)[None, None] / extent
    sampled = torch.nn.functional.grid_sample(texels, grid, padding_mode="border", align_corners=False)
    return sampled[0, :, 0].T


@pytest.mark.parametrize("format, tolerance", [("fp16", 1e-3), ("uint8", 4e-3), ("bc7", 2e-2)])
def test_the_bundle_gives_the_field_back_between_texels(scene, tmp_path, format, tolerance):
    made = scene(60)
    made.field.voxel = 0.02  # well below the wavelength, to exclude interpolation error
    export(bake_field(made, options=BakeOptions(format=format, tolerance=0)), tmp_path / "b")
    bundle = read_bundle(tmp_path / "b")
    scales = bundle.scene.surfels["log_scales"].exp()
    axes = tangents(bundle.scene.surfels["quats"]) * scales[:, None]
    errors = []
    for i in torch.nonzero(scales.amax(1) < 0.08).squeeze(1).tolist():
        uv = torch.rand(50, 2, generator=torch.Generator().manual_seed(i)) * 4 - 2
        x = bundle.scene.surfels["means"][i] + uv @ axes[i].T
        errors.append(bilinear(bundle, i, uv[:, 0], uv[:, 1]) - made.field(x))
    errors = torch.cat(errors)
    assert len(errors) > 1000
    assert errors.abs().mean() < tolerance


def test_what_cannot_be_drawn_is_left_out_and_counted(scene, tmp_path):
    made = scene(100)
    made.surfels["opacity_logits"][:7] = -8.0
    made.surfels["means"][7, 1] = float("nan")
    made.surfels["log_scales"][8, 0] = 1e30
    made.surfels["quats"][9] = 0.0
    made.surfels["sv_rgb"][10, 3, 1] = float("inf")
    made.surfels["sv_rgb"][11, 0, 0] = 1e4  # beyond a bundle's limit
    made.surfels["means"][12, 2] = -1e12
    baked = bake_field(made)
    assert baked.statistics.surfels.model_dump() == {
        "trained": 100,
        "kept": 87,
        "left_out": {"not_finite": 4, "beyond_limits": 2, "transparent": 7},
        "without_tile": int((baked.packing.tiles[:, 3] == 0).sum()),
    }
    assert baked.rows.tolist() == list(range(13, 100))
    torch.testing.assert_close(baked.scene.surfels["means"], made.surfels["means"][13:])
    export(baked, tmp_path / "b", statistics={"psnr": 30.0})
    info = read_bundle(tmp_path / "b").info
    assert info.statistics.surfels.left_out.transparent == 7 and info.statistics.psnr == 30.0
    assert info.render.near == 0.25 and info.atlas.extent == 3.0
    made.surfels["opacity_logits"][:] = -20.0
    with pytest.raises(ValueError, match="no surfel is left.*'transparent': 9"):
        bake_field(made)


def test_views_cap_the_tiles_and_say_what_that_saved(scene, camera):
    made = scene(80)
    rule = BakeOptions(tolerance=0, drop_unseen=False)
    free = bake_field(made, [camera()], replace(rule, cap_by_views=False)).statistics.texels
    statistics = bake_field(made, [camera()], rule).statistics
    assert statistics.certificate is None  # without a tolerance
    capped = statistics.texels
    assert free.nyquist == free.after_cap_by_views == free.kept == capped.nyquist
    assert capped.after_cap_by_views == capped.kept < free.nyquist / 2
    assert bake_field(made, [], rule).statistics.texels == free  # no views, no cap


def test_the_papers_rule_has_one_voxel_size_and_wider_tiles(scene):
    made = scene(60)
    made.field.voxel_size = lambda x: (0.02 * (1 + x.square().sum(-1, keepdim=True))).expand(-1, 2)
    rule = BakeOptions(tolerance=0, drop_unseen=False, cap_by_views=False, r_max=1024)
    local = bake_field(made, [], rule).statistics.texels
    finest = bake_field(made, [], replace(rule, local_voxel=False)).statistics.texels
    paper = bake_field(made, [], replace(rule, local_voxel=False, extent=4.0)).statistics.texels
    assert local.kept < finest.kept < paper.kept
    assert paper.kept == paper.nyquist == paper.paper == finest.paper == local.paper


def test_unseen_surfels_get_the_smallest_tile_or_are_dropped(scene, camera):
    made = scene(50)
    made.surfels["means"] *= 0.3
    made.surfels["means"][::2, 2] -= 100.0  # behind the camera
    kept = bake_field(made, [camera()], BakeOptions(drop_unseen=False, tolerance=0))
    assert (kept.packing.tiles[::2, 3:] == 4).all() and len(kept.rows) == 50
    # surfels that no view sees are treated as unoccluded
    within = bake_field(made, [camera()], BakeOptions(drop_unseen=False))
    assert within.packing.tiles[::2].any() and within.packing.tiles[::2, 3:].max() == 4
    assert (within.scene.surfels["view_span"][::2, 1] > 0).any()
    dropped = bake_field(made, [camera()])
    assert dropped.rows.tolist() == list(range(1, 50, 2))
    assert dropped.statistics.surfels.left_out.unseen == 25
    assert dropped.statistics.texels.paper == within.statistics.texels.paper  # the paper's rule counts them


def test_a_scene_without_texture_has_no_atlas(scene, tmp_path):
    baked = bake_field(scene(20, field=None, kind="sh"))
    assert baked.atlas is None and not baked.textured and not baked.packing.tiles.any()
    export(baked, tmp_path / "b")
    loaded = read_bundle(tmp_path / "b")
    assert loaded.scene.atlas is None and not loaded.scene.tiles.any() and loaded.info.atlas is None


def test_a_bake_tells_its_steps_and_is_the_same_again(scene, capsys):
    with rich_progress() as progress:
        baked = bake_field(scene(30), progress=progress)
    out = capsys.readouterr().out
    assert "choosing the tiles" in out and "evaluating texels" in out and "encoding the atlas" in out
    again = bake_field(scene(30))  # the layout does not depend on the run
    np.testing.assert_array_equal(again.packing.tiles, baked.packing.tiles)
    assert again.atlas.payload == baked.atlas.payload and again.atlas.range == baked.atlas.range


class Elsewhere(Camera):
    """A camera on another device: its matrices have no values before it is moved."""

    def to(self, device):
        assert device == torch.device("cpu") or device == "cpu"
        return self.__dict__["there"]

    @classmethod
    def of(cls, camera):
        made = cls(camera.viewmat.to("meta"), camera.K.to("meta"), camera.width, camera.height)
        made.__dict__["there"] = camera
        return made


@pytest.mark.parametrize("compact", [None, Compact(share=0.5, views=1)], ids=["pages", "compact"])
def test_the_scenes_device_does_the_work_and_not_that_of_the_cameras(scene, camera, compact):
    made, background, found = scene(60), torch.zeros(3), []
    refine = RefineOptions(tune=TuneOptions(steps=2, coded_steps=2), compact=compact)
    for cameras in ([camera(4.0 + i) for i in range(4)], [Elsewhere.of(camera(4.0 + i)) for i in range(4)]):
        photographs = [View(each, torch.full((48, 64, 3), 0.5)) for each in cameras]
        found.append(bake(made, cameras, photographs, background, BakeOptions(format="uint8"), refine))
    here, there = found
    assert torch.equal(here.shown, there.shown) and torch.equal(here.rows, there.rows)
    assert here.statistics.certificate == there.statistics.certificate


def test_the_field_may_state_its_centre_for_anisotropic_voxels(scene):
    made = scene(60)
    made.field.voxel_size = lambda x: torch.tensor([0.4, 0.05]).expand(len(x), 2)
    isotropic = bake_field(made).statistics.texels.nyquist
    made.field.geometry = SimpleNamespace(mid=(0.0, 0.0, 0.0))
    assert bake_field(made).statistics.texels.nyquist < isotropic


@pytest.mark.parametrize(
    "options, reason",
    [
        (BakeOptions(extent=0.0), "extent"),
        (BakeOptions(range_samples=0), "range_samples"),
        (BakeOptions(tolerance=-1.0), "tolerance"),
        (BakeOptions(format="jpeg"), "no format 'jpeg': choose among compact, bc7, uint8, fp16"),
        (BakeOptions(format="compact", tolerance=0.0), "compact bundle needs a tolerance"),
        (BakeOptions(bc7_profile="basic"), "bc7_profile is for the format bc7"),
        (BakeOptions(format="bc7", bc7_profile="best"), "profile"),
        (BakeOptions(r_max=50), "r_max"),
        (BakeOptions(page_width=100), "page width"),
        (BakeOptions(range="sigma1"), "range must be"),
    ],
)
def test_options_out_of_range_are_refused(scene, options, reason):
    with pytest.raises(ValueError, match=reason):
        bake_field(scene(5), options=options)
