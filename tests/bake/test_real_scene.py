"""The bake of the package's own scene and hash field."""

import torch

from bitymi_ns.bake import BakeOptions, bake_field, export
from bitymi_ns.bundle import read_bundle
from bitymi_ns.ops.reference.render import texel
from bitymi_ns.scene.config import SceneConfig
from bitymi_ns.scene.field import HashField
from bitymi_ns.scene.scene import Scene
from bitymi_ns.train.init import tangents


def real_scene(surfels, count=80, kind="sv"):
    """Make a scene whose field varies over whole voxels that the tiles resolve."""
    generator = torch.Generator().manual_seed(0)
    config = SceneConfig(view_color=kind, min_resolution=8, log2_table_size=14)
    field = HashField(config, (0.1, 0.2, -0.1), 1.0, True, 14, generator)
    with torch.no_grad():
        field.field_table.normal_(0.0, 0.5, generator=generator)
        field.field_w3.normal_(0.0, 0.2, generator=generator)
    return Scene(config, surfels(count, kind), field)


def test_tiles_at_the_nyquist_rate_hold_the_field(surfels, tmp_path):
    scene = real_scene(surfels)
    baked = bake_field(scene, options=BakeOptions(format="fp16", tolerance=0))
    export(baked, tmp_path / "b")
    bundle = read_bundle(tmp_path / "b")
    scales = bundle.scene.surfels["log_scales"].exp()
    axes = tangents(bundle.scene.surfels["quats"]) * scales[:, None]
    errors, values = [], []
    for i, (x, y, layer, r_u, r_v) in enumerate(bundle.scene.tiles.tolist()):
        uv = torch.rand(100, 2, generator=torch.Generator().manual_seed(i)) * 4 - 2
        with torch.no_grad():
            expected = scene.field(bundle.scene.surfels["means"][i] + uv @ axes[i].T)
        tile = bundle.scene.residuals()[layer, y : y + r_v, x : x + r_u]
        errors.append((texel(tile, uv) - expected).square().mean())
        values.append(expected.square().mean())
    assert torch.stack(errors).mean() < 0.02 * torch.stack(values).mean()


def test_tiles_shrink_in_the_contracted_background(surfels):
    near, far = real_scene(surfels), real_scene(surfels)
    with torch.no_grad():
        near.surfels["means"].mul_(0.2)
        far.surfels["means"].copy_(torch.nn.functional.normalize(far.surfels["means"], dim=1) * 20.0)
    rule = BakeOptions(tolerance=0)
    assert bake_field(far, options=rule).packing.texels < 0.3 * bake_field(near, options=rule).packing.texels
