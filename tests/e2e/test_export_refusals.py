"""Exports refused before the work starts, and bundles that are not opened."""

import json
import math
import shutil
import sys
from pathlib import Path
from typing import Any

import pytest
from nerfstudio.utils.eval_utils import eval_setup

from bitymi_ns.plugin.console import InputError
from bitymi_ns.plugin.export import command, target
from bitymi_ns.plugin.export.command import ExportAtlas
from bitymi_ns.plugin.run.config import BitymiTrainerConfig as Run
from tests.e2e.exports import run_export
from tests.e2e.runs import rewrite
from tests.typed import Patch


def test_an_existing_bundle_is_replaced_only_on_request(trained: Run, copied: Path) -> None:
    before = (copied / "bundle.json").read_bytes()
    with pytest.raises(InputError, match="is there already.*--overwrite True"):
        run_export(trained, copied)
    assert (copied / "bundle.json").read_bytes() == before
    run_export(trained, copied, overwrite=True, tolerance=2.0, compare=False, finetune_steps=0)
    info = json.loads((copied / "bundle.json").read_text())
    assert info["statistics"]["options"]["tolerance"] == 2 and "held_out" not in info["statistics"]


def test_a_folder_that_is_no_bundle_is_never_replaced(trained: Run, tmp_path: Path) -> None:
    (tmp_path / "precious.txt").write_text("x")
    with pytest.raises(InputError, match="is not a bundle"):
        run_export(trained, tmp_path, overwrite=True)
    with pytest.raises(InputError, match="is not a bundle") as stop:
        run_export(trained, tmp_path)
    assert "--overwrite" not in str(stop.value)  # it would not help
    (tmp_path / "link").symlink_to(tmp_path / "nowhere")
    with pytest.raises(InputError, match="link is a link to nothing"):
        run_export(trained, tmp_path / "link")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["link", "precious.txt"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"finetune_steps": -1}, "--finetune-steps must be greater than or equal to 0, not -1"),
        ({"polish_steps": -1}, "--polish-steps must be greater"),
        ({"finetune_memory": math.inf}, "--finetune-memory must be less than or equal to 1000000, not inf"),
        ({"finetune_memory": math.nan}, "--finetune-memory must be "),
        ({"page_width": 100}, "page width must be a power of two"),
        ({"r_max": 48}, "r_max must be a power of two"),
        ({"r_max": 8192}, "do not fit pages"),
        ({"seed": -1}, "seed must be greater than or equal to 0, not -1"),
        ({"r_min": 5}, "cannot be baked: .*power of two"),
        ({"format": "compact", "exact": True}, "needs a tolerance"),
        ({"interchange": True}, "--interchange is for --format compact, not bc7"),
        ({"target_mb": 1.0}, "--target-mb is for"),
        ({"compact_error": 0.2}, "--compact-error is for"),
        ({"format": None, "compact_error": 0.0}, "--compact-error must be greater than 0, not 0.0"),
        ({"format": "fp16", "target_psnr": 30.0}, "--target-psnr is for .* fp16"),
        ({"format": None, "target_psnr": 200.0}, "--target-psnr must be less than or equal to 100, not 200.0"),
        ({"format": None, "target_mb": 0.0}, "takes from 0.01 to 100,000 MB.*--target-mb"),
        ({"format": None, "target_psnr": 30.0, "target_mb": 1.0}, "cannot be combined"),
        ({"format": None, "bc7_profile": "basic"}, "bc7_profile is for the format bc7, and this bundle's is compact"),
        ({"format": None, "exact": True, "interchange": True}, "--interchange is for --format compact, not bc7"),
    ],
)
def test_wrong_options_are_found_early(
    trained: Run, tmp_path: Path, monkeypatch: Patch, options: Any, message: str
) -> None:
    monkeypatch.setattr(command, "load_trained", None)  # not called
    with pytest.raises(InputError, match=message):
        run_export(trained, tmp_path / "b", **options)
    assert list(tmp_path.iterdir()) == []


def test_options_of_fields_are_refused_for_trained_texels(trained: Run, tmp_path: Path) -> None:
    for options in ({"r_max": 16}, {"extent": 1.5}, {"r_min": 8, "local_voxel": False}):
        with pytest.raises(InputError, match=f"cannot be baked: .*{next(iter(options))}.* for a field.*tolerance"):
            run_export(trained, tmp_path / "b", **options)
    assert list(tmp_path.iterdir()) == []


def test_unusable_places_are_found_early(trained: Run, tmp_path: Path, monkeypatch: Patch) -> None:
    monkeypatch.setattr(command, "load_trained", None)  # not called
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="b cannot be written: .*file is not a folder.*--output-dir"):
        run_export(trained, tmp_path / "file" / "b")
    with pytest.raises(InputError, match="cannot be written: the name is too long"):
        run_export(trained, tmp_path / ("b" * 300))
    monkeypatch.setattr(target, "free_bytes", lambda path: 34_500)
    with pytest.raises(
        InputError,
        match=r"may take up to \d.* MB, by a generous estimate, and 34.5 kB are free.*--check-room False",
    ):
        run_export(trained, tmp_path / "b")
    with pytest.raises(TypeError):  # raised by the work, which is reached
        run_export(trained, tmp_path / "b", check_room=False)
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_no_encoder_is_named(trained: Run, tmp_path: Path, monkeypatch: Patch) -> None:
    monkeypatch.setitem(sys.modules, "ispc_texcomp", None)
    with pytest.raises(InputError, match="pip install ispc_texcomp"):
        run_export(trained, tmp_path / "b")
    assert list(tmp_path.iterdir()) == []


def test_a_configuration_that_is_not_there_or_not_one(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="there is no .*config.yml"):
        ExportAtlas(load_config=tmp_path / "config.yml", output_dir=tmp_path / "b").main()
    for text in ("a: [", "just text"):
        (tmp_path / "config.yml").write_text(text)
        with pytest.raises(InputError, match="is not the configuration of a trained scene"):
            ExportAtlas(load_config=tmp_path / "config.yml", output_dir=tmp_path / "b").main()


def test_a_bundle_cannot_be_baked_again(bundle: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is a bundle's"):
        ExportAtlas(load_config=bundle / "config.yml", output_dir=tmp_path / "b").main()


def test_bundles_that_are_damaged_newer_or_gone(copied: Path, tmp_path: Path) -> None:
    (tmp_path / "alone").mkdir()
    shutil.copy(copied / "config.yml", tmp_path / "alone")
    rewrite(tmp_path / "alone", lambda config: setattr(config.pipeline.model, "bundle", tmp_path / "gone"))
    with pytest.raises(InputError, match="no bundle found"):
        eval_setup(tmp_path / "alone" / "config.yml")
    path = copied / "atlas.ktx2"
    path.write_bytes(path.read_bytes()[:-9])
    with pytest.raises(InputError, match="atlas.ktx2 is truncated.*or export the scene again"):
        eval_setup(copied / "config.yml")
    info = json.loads((copied / "bundle.json").read_text())
    (copied / "bundle.json").write_text(json.dumps({**info, "version": "7.0"}))
    with pytest.raises(InputError, match="version 7.0.*update bitymi-ns"):
        eval_setup(copied / "config.yml")
