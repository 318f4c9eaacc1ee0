"""A compact bundle from a trained scene, and back into nerfstudio's tools."""

import json
from pathlib import Path

import pytest

from bitymi_ns.bundle import check_files, read_bundle
from bitymi_ns.plugin.export.trained import check_run
from bitymi_ns.plugin.run.config import BitymiTrainerConfig as Run
from tests.e2e.exports import TOLERANCE, evaluate, run_export
from tests.typed import Printed


def test_it_is_the_default(trained: Run, bundle: Path, tmp_path: Path, capsys: Printed) -> None:
    folder = tmp_path / "b"
    run_export(trained, folder, format=None, tolerance=TOLERANCE, finetune_steps=30, interchange=True, target_mb=9.0)
    out = " ".join(capsys.readouterr().out.split())
    assert "MB dct" in out and "per surfel" in out and "surfels within the tolerance" in out
    assert "with --target-mb, about" in out and "MB suffice, of the 9 MB that were asked for" in out
    assert {path.name for path in folder.iterdir()} == {
        "bundle.json", "surfels.bin", "texels.bin", "surfels.ply", "config.yml", "preview.jpg", "cameras.json",
        "poster.webp",
    }  # fmt: skip
    read, checks = check_files(folder)
    assert read is not None and all(check.ok for check in checks), checks
    assert (folder / "surfels.bin").stat().st_size < (bundle / "surfels.ply").stat().st_size / 3
    info = json.loads((folder / "bundle.json").read_text())
    held_out, rounding = info["statistics"]["held_out"], info["statistics"]["rounding"]
    assert held_out["psnr_baked_against_photos"] > held_out["psnr_neural_against_photos"] - 0.2
    assert rounding["mse"] >= 0 and set(rounding["steps"]) > {"place", "rotation", "view_base"}
    assert info["statistics"]["atlas"]["bytes"] == (folder / "texels.bin").stat().st_size
    stock = evaluate(folder / "config.yml", tmp_path / "baked.json")
    assert stock["psnr"] == pytest.approx(held_out["psnr_baked_against_photos"], abs=0.05)
    assert stock["atlas_bytes"] == (folder / "texels.bin").stat().st_size
    results = check_run(read, trained.get_base_dir() / "config.yml", 2)
    assert all(check.ok for check in results), results


def test_it_can_be_as_small_as_is_asked_for(trained: Run, tmp_path: Path) -> None:
    fine = {"tolerance": TOLERANCE, "format": "compact", "compact_error": 1e-4}  # makes the scene large

    def sizes(name: str, **options) -> dict[str, int]:
        run_export(trained, tmp_path / name, **fine, **options)
        return {path.name: path.stat().st_size for path in (tmp_path / name).iterdir()}

    def scene(found: dict[str, int]) -> int:
        return found["surfels.bin"] + found["texels.bin"]

    free = sizes("b", finetune_steps=0)
    # the bytes reserved for bundle.json and pictures are about 9 kB more than this small run needs
    target = sum(free.values()) + 7000
    bounded = sizes("c", finetune_steps=30, target_mb=target / 1e6)
    assert scene(bounded) < scene(free) and sum(bounded.values()) <= target
    assert len(read_bundle(tmp_path / "c")) == len(read_bundle(tmp_path / "b"))
