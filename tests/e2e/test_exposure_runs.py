"""Exposure corrections through nerfstudio's entry points: checkpoints, export, messages."""

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from nerfstudio.scripts import train as ns_train
from PIL import Image

from bitymi_ns.bake import pipeline
from bitymi_ns.bundle.parts import CAMERAS
from bitymi_ns.plugin.export.command import ExportAtlas
from bitymi_ns.plugin.run.callbacks import FILE
from tests.captures import images_of, printed
from tests.e2e.exports import evaluate
from tests.e2e.runs import Start, checkpoint, different
from tests.typed import Patch, Printed


@pytest.fixture
def uneven(capture: Path) -> Path:
    """The room with every other photograph darkened to 0.7."""
    for path in images_of(capture)[::2]:
        Image.open(path).point(lambda value: round(0.7 * value)).save(path)
    return capture


def test_a_resumed_run_goes_on_with_its_corrections(
    uneven: Path, start: Start, capsys: Printed, monkeypatch: Patch, tmp_path: Path
) -> None:
    whole, resumed = (start(data=uneven, name=name) for name in ("whole", "resumed"))
    whole.save_only_latest_checkpoint = False
    for config in (whole, resumed):
        config.pipeline.model.train.exposure, config.pipeline.model.train.lr.exposure = "gain", (0.05, 0.02)
    ns_train.main(whole)
    assert "The exposure of each photograph is learned" in (said := printed(capsys)) and "as asked for" in said
    state = checkpoint(whole, 59)["pipeline"]["_model._extra_state"]["run"]["exposure"]
    table = state["table"]
    assert table.shape == (10, 3) and table.abs().max() > 0.02
    torch.testing.assert_close(table.mean(0), torch.zeros(3), atol=1e-6, rtol=0)
    last = json.loads((whole.get_base_dir() / FILE).read_text().splitlines()[-1])
    assert last["fitted_psnr"] > last["psnr"]
    wrong = last["mean_exposure_psnr"] - last["psnr"]  # the neighbours of dark photographs are bright
    assert wrong > 0.3

    resumed.load_dir, resumed.load_step = whole.get_checkpoint_dir(), 20
    ns_train.main(resumed)
    assert different(checkpoint(whole, 59), checkpoint(resumed, 59)) == []

    given = []

    def tune(baked: Any, views: Any, *rest: Any) -> Any:
        given.extend(view.correction for view in views)
        return baked.encoded()

    monkeypatch.setattr(pipeline, "tune_atlas", tune)
    ExportAtlas(
        load_config=whole.get_base_dir() / "config.yml", output_dir=tmp_path / "bundle", polish_steps=0, tolerance=0.02
    ).main()
    torch.testing.assert_close(torch.stack(given), table.exp())
    bundle = json.loads((tmp_path / "bundle" / "bundle.json").read_text())
    held_out = bundle["statistics"]["held_out"]
    assert held_out["fitted_psnr_neural_against_photos"] > held_out["psnr_neural_against_photos"]
    assert held_out["fitted_psnr_baked_against_photos"] > held_out["psnr_baked_against_photos"]
    assert "after a fit of the colours" in " ".join(capsys.readouterr().out.split())

    # of the held-out photographs, the first has one neighbour
    rows = json.loads((tmp_path / "bundle" / CAMERAS).read_text())["cameras"]
    found = torch.tensor([row["correction"] for row in rows]).log()
    expected = torch.cat([table, table[:1], 0.5 * (table[6:7] + table[7:8])])
    torch.testing.assert_close(found, expected, atol=1e-6, rtol=0)
    of_run, of_bundle = (
        evaluate(folder / "config.yml", tmp_path / "results.json")
        for folder in (whole.get_base_dir(), tmp_path / "bundle")
    )
    assert of_run["psnr"] == pytest.approx(last["psnr"], abs=0.01)
    assert of_bundle["mean_exposure_psnr"] - of_bundle["psnr"] == pytest.approx(wrong, abs=0.1)
    assert held_out["psnr_baked_against_photos"] == pytest.approx(of_bundle["psnr"], abs=0.01)
    assert of_bundle["ssim"] < of_bundle["mean_exposure_ssim"]
