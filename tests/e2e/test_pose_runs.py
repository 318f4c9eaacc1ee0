"""Refined poses through nerfstudio's entry points: checkpoints, resume, the bundle's cameras, ns-eval."""

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from nerfstudio.scripts import train as ns_train

from bitymi_ns.bundle.parts import CAMERAS
from bitymi_ns.plugin.export.trained import load_trained
from bitymi_ns.plugin.run.callbacks import FILE
from bitymi_ns.train.poses import moved
from tests.captures import edit_frames
from tests.e2e.exports import TOLERANCE, evaluate, run_export
from tests.e2e.runs import Start, checkpoint, different


@pytest.fixture
def askew(capture: Path) -> Path:
    """The room with poses that are a pixel off."""
    generator = torch.Generator().manual_seed(0)

    def move(frame: dict[str, Any]) -> None:
        pose = torch.tensor(frame["transform_matrix"], dtype=torch.float64)
        motion = 0.02 * torch.randn(6, dtype=torch.float64, generator=generator)
        frame["transform_matrix"] = torch.linalg.inv(moved(torch.linalg.inv(pose), motion)).tolist()

    edit_frames(capture, move)
    return capture


def test_poses_are_refined_resumed_exported_and_judged(askew: Path, start: Start, tmp_path: Path) -> None:
    whole = start(data=askew, name="whole")
    whole.save_only_latest_checkpoint = False
    whole.pipeline.model.train.refine_poses = "on"
    ns_train.main(whole)
    motions = checkpoint(whole, 59)["pipeline"]["_model._extra_state"]["run"]["poses"]["motions"]
    assert motions.shape == (10, 6) and motions.abs().max() > 1e-4
    *others, last = map(json.loads, (whole.get_base_dir() / FILE).read_text().splitlines())
    assert last["refined_psnr"] > last["psnr"] and not any("refined_psnr" in point for point in others)

    resumed = start(data=askew, name="resumed")
    resumed.pipeline.model.train.refine_poses = "on"
    resumed.load_dir, resumed.load_step = whole.get_checkpoint_dir(), 20
    ns_train.main(resumed)
    assert different(checkpoint(whole, 59), checkpoint(resumed, 59)) == []

    found = evaluate(whole.get_base_dir() / "config.yml", tmp_path / "eval.json")
    assert found["refined_psnr"] == pytest.approx(last["refined_psnr"], abs=0.01)
    assert found["carried_psnr"] == pytest.approx(last["carried_psnr"], abs=0.01)
    assert found["psnr"] == pytest.approx(last["psnr"], abs=0.01)

    given = start(data=askew, name="given").pipeline.datamanager.setup(device="cpu", test_mode="test")
    _, pipeline = load_trained(whole.get_base_dir() / "config.yml")
    before, after = (manager.train_dataset.cameras.camera_to_worlds for manager in (given, pipeline.datamanager))
    torch.testing.assert_close(after[:, :, 3], (before[:, :, 3] + motions[:, 3:]).float())
    folder = tmp_path / "bundle"
    run_export(whole, folder, tolerance=TOLERANCE, finetune_steps=0)
    rows = [row for row in json.loads((folder / CAMERAS).read_text())["cameras"] if not row["held_out"]]
    for row, pose in zip(rows, after, strict=True):
        viewmat = torch.tensor(row["viewmat"]).view(4, 4)
        torch.testing.assert_close(-viewmat[:3, :3].T @ viewmat[:3, 3], pose[:, 3], atol=1e-5, rtol=0)
