"""Training on faulty captures: faults that are tolerated, and faults that stop the run before it starts."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from nerfstudio.scripts import train as ns_train
from nerfstudio.scripts.eval import ComputePSNR

from bitymi_ns.plugin.console import InputError
from bitymi_ns.plugin.export.command import ExportAtlas
from bitymi_ns.plugin.run import callbacks
from bitymi_ns.plugin.run.callbacks import FILE
from bitymi_ns.plugin.run.config import BitymiTrainerConfig as Run
from tests.captures import add_masks, mixed_project, write_cloud
from tests.e2e.runs import Start
from tests.typed import Patch, Printed


def curve(config: Run) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (config.get_base_dir() / FILE).read_text().splitlines()]


@pytest.mark.slow
def test_no_quality_is_reported_over_no_pixels(start: Start, capture: Path, capsys: Printed) -> None:
    add_masks(capture, lambda i: 0 if i in (0, 8) else 255)
    config = start(data=capture)
    config.steps_per_eval_image = config.steps_per_eval_all_images = 30
    config.vis = "tensorboard"
    ns_train.main(config)
    assert all("psnr" not in point for point in curve(config)) and len(curve(config)) == 3
    output = capsys.readouterr().out
    assert "dB held out" not in output
    assert "The masks of 2 of 2 held-out photographs exclude every pixel" in " ".join(output.split())


def test_points_that_no_view_sees(start: Start, capture: Path) -> None:
    write_cloud(capture / "sparse_pc.ply", np.random.default_rng(0).normal(1000.0, 1.0, (200, 3)))
    with pytest.raises(InputError, match="none of the 200 initial points lies in any training view.*in another frame"):
        ns_train.main(start(data=capture))


def test_a_view_without_points(start: Start, room: Path, monkeypatch: Patch, capsys: Printed) -> None:
    monkeypatch.setattr(callbacks, "views_without_surfels", lambda scene, cameras: [1])
    config = start()
    config.max_num_iterations = 2
    ns_train.main(config)
    output = " ".join(capsys.readouterr().out.split())
    assert f"{room}/images/frame_00003.png sees no initial point: " in output


@pytest.mark.slow
def test_several_cameras_train_and_are_exported(start: Start, tmp_path: Path, capsys: Printed) -> None:
    """Landscape with distortion, portrait, and fisheye, in one COLMAP model."""
    mixed_project(tmp_path / "mixed")
    config = start(data=tmp_path / "mixed")
    ns_train.main(config)
    assert len(curve(config)) == 3 and np.isfinite([point["psnr"] for point in curve(config)]).all()
    assert "training photographs of up to " in " ".join(capsys.readouterr().out.split())
    place = json.loads((config.get_base_dir() / "dataparser_transforms.json").read_text())
    run = config.get_base_dir() / "config.yml"
    ExportAtlas(load_config=run, output_dir=tmp_path / "bundle", polish_steps=4, finetune_steps=4).main()
    world = json.loads((tmp_path / "bundle/bundle.json").read_text())["world"]
    assert np.allclose(world["transform"], place["transform"], atol=1e-6)
    assert world["scale"] == pytest.approx(place["scale"], rel=1e-6)
    ComputePSNR(load_config=run, output_path=tmp_path / "eval.json").main()
    assert np.isfinite(json.loads((tmp_path / "eval.json").read_text())["results"]["psnr"])
