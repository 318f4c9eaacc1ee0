"""Skipping levels that no surfel needs changes nothing."""

import pytest
import torch

from bitymi_ns.bake import BakeOptions, bake_field, export
from bitymi_ns.bake.field.lean_field import lean_field, level_changes
from bitymi_ns.bake.verify import check_field
from bitymi_ns.bundle import check_files
from tests.bake.test_real_scene import real_scene


@pytest.mark.parametrize(
    "empty, kept", [((), (0, 4)), ((3,), (0, 3)), ((0,), (1, 3)), ((0, 2, 3), (1, 1)), ((1,), (0, 4)), ((1, 2), (0, 4))]
)
def test_levels_without_content_at_the_ends_are_left_out(surfels, empty, kept):
    scene = real_scene(surfels, 40)
    for level in empty:
        scene.field.field_table.data[level] = 0
    field, found = lean_field(scene.field, scene.surfels, None, 0.0, 0.5)
    assert found.kept == kept and found.levels == 4 and found.change <= 1e-3
    assert [change > 0.05 for change in found.change_of_each] == [level not in empty for level in range(4)]
    x = 3 * torch.randn(500, 3, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(field(x), scene.field(x), rtol=1e-4, atol=1e-6)
    assert field.field_table.shape[0] == kept[1]  # the loads of a point: eight entries a level
    finer = 2.0 ** (4 - sum(kept))
    torch.testing.assert_close(field.voxel_size(x), finer * scene.field.voxel_size(x))


def test_a_change_is_what_the_measure_of_the_tiles_says(surfels):
    """One hard opaque surfel and a field with level 0 only: the change is the residual itself."""
    scene = real_scene(surfels, 1)
    scene.field.field_table.data[1:] = 0
    params = {name: value.detach() for name, value in scene.surfels.items()}
    params["opacity_logits"], params["beta_raw"] = torch.tensor([9.0]), torch.tensor([-20.0])
    params["log_scales"] = torch.full((1, 2), -12.0)  # the field is the same all over it
    change = level_changes(scene.field, params, [(0,), (3,)])
    residual = scene.field(params["means"])[0]
    want = 255 * 0.99 * residual.square().mean().sqrt()
    torch.testing.assert_close(change[0, 0], want.detach(), rtol=1e-2, atol=1e-3)
    assert change[1, 0] == 0
    assert level_changes(scene.field, params, [(0,)], weight_bound=0.995)[0, 0] == 0


def test_a_bake_of_fewer_levels_is_the_same_and_is_verified(surfels, camera, tmp_path):
    scene = real_scene(surfels, 40)
    scene.field.field_table.data[3] = 0
    options = BakeOptions(format="uint8", r_max=16)
    baked = bake_field(scene, [camera()], options)
    assert baked.statistics.field.kept == (0, 3)
    export(baked, tmp_path / "b", statistics={"options": vars(options)})
    bundle, checks = check_files(tmp_path / "b")
    assert all(check.ok for check in checks) and check_field(bundle, scene.field, [camera()]).ok
    smaller = real_scene(surfels, 40)
    smaller.field = scene.field.only(0, 3)
    again = bake_field(smaller, [camera()], options)
    assert torch.equal(again.texels, baked.texels)
    exact = bake_field(scene, [camera()], BakeOptions(format="uint8", r_max=16, tolerance=0.0))
    assert exact.statistics.field is None
