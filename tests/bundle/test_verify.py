"""`bitymi verify` detects alterations."""

import numpy as np
import pytest

from bitymi_ns.bake import BakeOptions, bake_field, export
from bitymi_ns.bake.verify import check_view_color
from bitymi_ns.bundle import check_files
from bitymi_ns.cli import main
from tests.bundle.damage import amend, change_columns
from tests.bundle.test_damage import failures


@pytest.fixture
def made(scene, camera, tmp_path):
    trained, views = scene(60), [camera(3.0)]
    options = BakeOptions(format="uint8", tolerance=0.2)
    export(bake_field(trained, views, options), tmp_path / "b", statistics={"options": vars(options)})
    return tmp_path / "b", trained, views


def test_a_bundle_passes_as_it_was_written(made):
    folder, *_ = made
    _, checks = check_files(folder)
    assert all(check.ok for check in checks)
    assert [check.name for check in checks] == [
        "bundle.json", "atlas.ktx2", "surfels.ply", "contents", "tiles", "statistics", "certificate"
    ]  # fmt: skip
    assert main(["verify", str(folder)]) == 0
    assert main(["verify", str(folder), "--views", "2"]) == 1  # of no run


@pytest.mark.parametrize("drop", [True, False])
@pytest.mark.parametrize("tolerance", [0.0, 0.5])
def test_the_error_of_view_colours_that_a_bundle_states_is_found_again(scene, camera, tmp_path, tolerance, drop):
    trained, views = scene(60), [camera(6.0), camera(8.0)]
    trained.surfels["means"][::3, 2] -= 100.0  # behind the cameras
    options = BakeOptions(format="fp16", tolerance=tolerance, drop_unseen=drop)
    baked = bake_field(trained, views, options)
    export(baked, tmp_path / "b", statistics={"options": vars(options)})
    bundle, _ = check_files(tmp_path / "b")
    assert check_view_color(bundle, trained.surfels, views).ok


def test_certificates_count_surfels_that_show_a_residual(scene):
    made, few = scene(60), scene(60)
    made.config.weight_bound = few.config.weight_bound = 0.02
    for each in (made, few):
        each.surfels["opacity_logits"][::2] = -4.5  # never reach the weight bound
    few.surfels = {name: value[1::2] for name, value in few.surfels.items()}
    options = BakeOptions(format="fp16", drop_unseen=False)
    found = [bake_field(each, [], options).statistics.certificate for each in (made, few)]
    counts = [(each.within, each.beyond, each.worst) for each in found]
    assert counts[0] == counts[1] and sum(counts[0][:2]) > 0


def test_contents_that_are_wrong_are_found_behind_a_good_hash(made):
    folder, *_ = made

    def overlap(columns):
        i, j = np.flatnonzero(columns["tile_ru"])[:2]
        for name in ("tile_x", "tile_y"):
            columns[name][j] = columns[name][i]

    amend(folder, lambda info: info["statistics"]["surfels"].update(kept=7))
    assert failures(folder) == ["statistics"]
    amend(folder, lambda info: info["statistics"]["surfels"].update(kept=info["surfels"]["count"]))
    change_columns(folder, overlap)
    assert failures(folder) == ["tiles"]
    change_columns(folder, lambda columns: columns["tile_ru"].__setitem__(np.flatnonzero(columns["tile_ru"])[0], 3))
    assert "tiles" in failures(folder)
    change_columns(folder, lambda columns: columns["opacity"].__setitem__(3, np.nan))
    assert failures(folder) == ["contents"]
