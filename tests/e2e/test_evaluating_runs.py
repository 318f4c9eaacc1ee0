"""Selection of the checkpoint to evaluate, and refusals."""

import shutil
from pathlib import Path
from typing import Any

import pytest
import torch
from nerfstudio.scripts.eval import ComputePSNR
from nerfstudio.utils.eval_utils import eval_setup

from bitymi_ns.plugin.console import InputError
from bitymi_ns.plugin.run.config import BitymiTrainerConfig
from tests.e2e.runs import a_run_of, rewrite


def test_evaluation_refuses_a_damaged_or_missing_checkpoint(trained: BitymiTrainerConfig, tmp_path: Path) -> None:
    folder = a_run_of(trained, tmp_path)
    newest = folder / "nerfstudio_models" / "step-000000059.ckpt"
    newest.write_bytes(newest.read_bytes()[:1000])
    with pytest.raises(
        InputError, match=f"{newest} cannot be read(.|\n)*It is damaged(.|\n)*go back to step-000000040.ckpt"
    ):
        eval_setup(folder / "config.yml")
    newest.unlink()
    assert eval_setup(folder / "config.yml")[3] == 40
    shutil.rmtree(newest.parent)
    newest.parent.mkdir()
    with pytest.raises(InputError, match="holds no checkpoint"):
        eval_setup(folder / "config.yml")


def test_evaluation_of_a_resumed_run_takes_its_own_checkpoint(trained: BitymiTrainerConfig, tmp_path: Path) -> None:
    folder = a_run_of(trained, tmp_path)
    rewrite(folder, lambda config: setattr(config, "load_step", 7))  # of the run it resumed from
    assert eval_setup(folder / "config.yml")[3] == 59


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"output_path": Path("e")}, "--output-path must end in .json, e does not"),
        ({"render_output_path": Path(__file__)}, r"_runs.py is not a folder: .* \(--render-output-path\)"),
    ],
)
def test_paths_that_cannot_be_written_are_refused_before_the_scene_is_loaded(
    trained: BitymiTrainerConfig, options: Any, message: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("bitymi_ns.plugin.run.checkpoints.load", lambda *_: pytest.fail("the scene is loaded"))
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=message):
        ComputePSNR(load_config=trained.get_base_dir() / "config.yml", **options).main()
    assert list(tmp_path.iterdir()) == []


def test_the_near_plane_is_the_one_of_the_training(trained: BitymiTrainerConfig, tmp_path: Path) -> None:
    scene = eval_setup(trained.get_base_dir() / "config.yml")[1].model.scene
    assert 0.02 < scene.near < 0.04  # nerfstudio scales the cameras to 1
    folder = a_run_of(trained, tmp_path)
    path = max((folder / "nerfstudio_models").iterdir())
    state = torch.load(path, weights_only=True)
    state["pipeline"]["_model._extra_state"]["near"] = 0.5
    torch.save(state, path)
    assert eval_setup(folder / "config.yml")[1].model.scene.near == 0.5
    rewrite(folder, lambda config: setattr(config.pipeline.model.scene, "near", 0.1))
    assert eval_setup(folder / "config.yml")[1].model.scene.near == 0.1
