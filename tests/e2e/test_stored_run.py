"""A run and its bundle of an earlier version, as users have them: they go on in this one."""

import json
import re
import shutil
from pathlib import Path

import pytest
import torch
from nerfstudio.scripts import train as ns_train
from nerfstudio.scripts.eval import ComputePSNR
from nerfstudio.scripts.render import DatasetRender
from nerfstudio.scripts.viewer.run_viewer import RunViewer

from bitymi_ns.cli import main
from bitymi_ns.plugin.console import InputError
from bitymi_ns.plugin.export.command import ExportAtlas
from bitymi_ns.plugin.export.mesh import ExportMesh
from tests.e2e.exports import evaluate, run_export
from tests.e2e.runs import checkpoint, config_of
from tests.hostile import KNOWN

STORED = Path(__file__).parent / "stored"
"""The run was written by commit f4259ca8: 80 steps of `ns-train bitymi` on eight views of the sample room, with
`--pipeline.model.train.exposure gain --pipeline.model.train.refine-poses on`. The bundle is its `ns-export
bitymi-atlas` of version 6.0. In dB, what `ns-eval` says of both:"""
TRAINED, REFINED, BUNDLE = 19.774, 19.779, 19.050


@pytest.fixture
def stored(tmp_path: Path) -> Path:
    folder = Path(shutil.copytree(STORED, tmp_path / "stored"))
    for config in folder.rglob("config.yml"):
        config.write_text(re.sub(r"- /\n *- stored\n", f"- {folder}\n", config.read_text()))
    return folder


def test_the_run_is_evaluated_resumed_and_exported(stored: Path, tmp_path: Path) -> None:
    run = stored / "outputs" / "stored" / "bitymi" / "run"
    found = evaluate(run / "config.yml", tmp_path / "run.json")
    assert found["refined_psnr"] == pytest.approx(REFINED, abs=0.02)
    config = config_of(run)
    run_export(config, tmp_path / "bundle", format="compact", finetune_steps=2)
    assert evaluate(tmp_path / "bundle" / "config.yml", tmp_path / "new.json")["psnr"] > BUNDLE - 0.3
    config.load_dir, config.max_num_iterations, config.timestamp = run / "nerfstudio_models", 90, "resumed"
    ns_train.main(config)
    before, after = checkpoint(config_of(run), 79), checkpoint(config, 89)
    names = [name for name in before["pipeline"] if isinstance(before["pipeline"][name], torch.Tensor)]
    assert names == [name for name in after["pipeline"] if isinstance(after["pipeline"][name], torch.Tensor)]
    runs = [state["pipeline"]["_model._extra_state"]["run"] for state in (before, after)]
    assert [int(each["exposure"]["optimizer"]["state"][0]["step"]) for each in runs] == [80, 90]
    assert not torch.equal(*(each["poses"]["motions"] for each in runs))


def test_nothing_stored_needs_torch_load(stored: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch, "load", lambda *_, **__: pytest.fail("torch.load was called"))
    run = stored / "outputs" / "stored" / "bitymi" / "run"
    for folder, loaded in ((run, "nerfstudio_models/step-000000079.ckpt"), (stored / "bundle", "bundle.json")):
        evaluate(folder / "config.yml", tmp_path / "e.json")
        assert json.loads((tmp_path / "e.json").read_text())["checkpoint"] == str(folder / loaded)


def test_options_that_this_version_lacks_are_refused(stored: Path, tmp_path: Path) -> None:
    run = stored / "outputs" / "stored" / "bitymi" / "run"
    text = (run / "config.yml").read_text()
    (run / "config.yml").write_text(text.replace("prefilter: low_pass", "prefilter: pixel"))
    again = config_of(run)
    again.timestamp = "again"
    for command in (lambda: evaluate(run / "config.yml", tmp_path / "e.json"), lambda: ns_train.main(again)):
        with pytest.raises(InputError, match="scene.prefilter pixel, which is gone: train the scene again") as stop:
            command()
        assert "\n" not in str(stop.value)


@pytest.mark.parametrize("command", ["eval", "export", "mesh", "render", "viewer", "load_dir", "load_checkpoint"])
def test_hostile_checkpoints_are_refused_by_every_command(stored: Path, tmp_path: Path, command: str) -> None:
    run, out = stored / "outputs" / "stored" / "bitymi" / "run", tmp_path / "out"
    path, opened = run / "nerfstudio_models" / "step-000000079.ckpt", run / "config.yml"
    whole = path.read_bytes()

    def train() -> None:
        config = config_of(run)
        config.timestamp = str(len(list(run.parent.iterdir())))
        setattr(config, command, path.parent if command == "load_dir" else path)
        ns_train.main(config)

    main = {
        "eval": lambda: ComputePSNR(load_config=opened, output_path=out.with_suffix(".json")).main(),
        "export": lambda: ExportAtlas(load_config=opened, output_dir=out).main(),
        "mesh": lambda: ExportMesh(load_config=opened, output_dir=out).main(),
        "render": lambda: DatasetRender(load_config=opened, output_path=out).main(),
        "viewer": lambda: RunViewer(load_config=opened).main(),
    }.get(command, train)
    for make, message in KNOWN.values():
        path.write_bytes(make(whole, tmp_path / "ran"))
        with pytest.raises(InputError, match=message) as stop:
            main()
        assert str(path) in str(stop.value) and "\n" not in str(stop.value)
        assert not (tmp_path / "ran").exists() and not out.exists()


def test_the_bundle_is_shown_and_verified(stored: Path, tmp_path: Path) -> None:
    found = evaluate(stored / "bundle" / "config.yml", tmp_path / "bundle.json")
    assert found["psnr"] == pytest.approx(BUNDLE, abs=0.02)
    assert main(["verify", str(stored / "bundle")]) == 0
