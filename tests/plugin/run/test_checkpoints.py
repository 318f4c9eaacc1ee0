"""Checkpoints that cannot be used are refused with the file's name and what to do."""

import dataclasses
import errno
import json
from pathlib import Path
from typing import Any

import pytest
import torch

from bitymi_ns.plugin.console import InputError
from bitymi_ns.plugin.run import checkpoints
from bitymi_ns.scene.config import SceneConfig


def state(scene: SceneConfig, rows: int = 5, step: int = 7) -> dict[str, Any]:
    """The parts of a checkpoint that are looked at."""
    pipeline = {
        "_model.scene.surfels.means": torch.zeros(rows, 3),
        "_model.scene.surfels.quats": torch.ones(rows, 4),
        "_model._extra_state": {"version": 1, "scene": json.dumps(dataclasses.asdict(scene))},
    }
    return {"step": step, "pipeline": pipeline, "optimizers": {}, "scalers": {}}


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    path = checkpoints.path_of(tmp_path, 7)
    torch.save(state(SceneConfig()), path)
    return path


def refused(path: Path, message: str, scene: SceneConfig | None = None) -> None:
    with pytest.raises(InputError, match=message) as stop:
        checkpoints.load(path, scene or SceneConfig())
    assert str(path) in str(stop.value)


def test_a_whole_checkpoint_loads(saved: Path) -> None:
    assert checkpoints.load(saved, SceneConfig())["step"] == 7
    assert checkpoints.newest_step(saved.parent) == 7
    other = SceneConfig(near=0.1, weight_bound=0.0, rim=1e-2, texture_moves_surfels=True)  # no parameter depends on it
    assert checkpoints.load(saved, other)["step"] == 7
    refused(saved, "another preset:\n  --pipeline.model.scene.view-color: sv there, sh here", SceneConfig("sh"))


@pytest.mark.parametrize("share", [0.0, 0.3, 0.9])
def test_truncated(saved: Path, share: float) -> None:
    whole = saved.read_bytes()
    saved.write_bytes(whole[: int(share * len(whole))])
    refused(saved, "damaged.*Copy it again")


def test_every_altered_byte_of_a_tensor_is_noticed(saved: Path) -> None:
    whole = bytearray(saved.read_bytes())
    ones = torch.ones(5, 4).numpy().tobytes()
    at = whole.index(ones) + 2
    whole[at] ^= 1  # still a number, and no longer the one that was saved
    saved.write_bytes(whole)
    refused(saved, "damaged.*checksum")
    earlier = checkpoints.path_of(saved.parent, 3)
    earlier.write_bytes(bytes(whole))
    refused(saved, f"Remove it to go back to {earlier.name}")


@pytest.mark.parametrize(
    ("error", "detail"),
    [
        (OSError(errno.ENOSPC, "No space left on device"), "the disk is full: free some space"),
        (OSError(errno.EROFS, "Read-only file system"), "the file system is read-only"),
        (RuntimeError("[enforce fail at inline_container.cc:672] . unexpected pos 9 vs 8"), "took only a part of it"),
    ],
)
@pytest.mark.parametrize("earlier", [True, False])
def test_a_full_disk(
    saved: Path, monkeypatch: pytest.MonkeyPatch, error: Exception, detail: str, earlier: bool
) -> None:
    def full(state: Any, file: Any) -> None:
        file.write(b"half")
        raise error

    monkeypatch.setattr(torch, "save", full)
    whole = saved.read_bytes()
    if not earlier:
        saved.unlink()
    then = "Resume with --load-dir .*intact" if earlier else "Train again"
    with pytest.raises(InputError, match=f"(?s)could not be written: .*{detail}.*{then}"):
        checkpoints.save({}, checkpoints.path_of(saved.parent, 9), scratch=saved.parent)
    assert [p.name for p in saved.parent.iterdir()] == ([saved.name] if earlier else [])
    assert not earlier or saved.read_bytes() == whole


def test_the_folder_above_or_a_folder_for_a_file(saved: Path) -> None:
    run = saved.parent / "run"
    (run / "nerfstudio_models").mkdir(parents=True)
    saved.rename(run / "nerfstudio_models" / saved.name)
    with pytest.raises(InputError, match="they are in .*nerfstudio_models: --load-dir .*/run/nerfstudio_models"):
        checkpoints.newest_step(run)
    with pytest.raises(InputError, match=r"is a folder: give one of the files step-\*.ckpt with --load-checkpoint"):
        checkpoints.load(saved.parent, SceneConfig())


def test_altered_contents(saved: Path, capsys: pytest.CaptureFixture[str]) -> None:
    newer, uneven = state(SceneConfig())["pipeline"], state(SceneConfig())["pipeline"]
    newer["_model._extra_state"]["version"] = checkpoints.STATE_VERSION + 1
    uneven["_model.scene.surfels.quats"] = torch.ones(4, 4)
    for change, message in (
        ({"step": "seven"}, "is not a nerfstudio checkpoint"),
        ({"pipeline": state(SceneConfig(), rows=0)["pipeline"]}, "holds no surfels"),
        ({"pipeline": {"_model.gauss_params.means": torch.zeros(3, 3)}}, "not a checkpoint of this method"),
        ({"pipeline": newer}, "newer bitymi-ns; update"),
        ({"pipeline": uneven}, r"altered: .*5 means, 4 quats"),
    ):
        torch.save(state(SceneConfig()) | change, saved)
        refused(saved, message)
    torch.save([1, 2], saved)
    refused(saved, "not a nerfstudio checkpoint")
    for scene in ("{", "[1]", "3"):
        altered = state(SceneConfig())
        altered["pipeline"]["_model._extra_state"]["scene"] = scene
        torch.save(altered, saved)
        refused(saved, "was altered: it does not say what its scene is made of")
    broken = state(SceneConfig())
    broken["pipeline"]["_model.scene.surfels.quats"][2, 1] = torch.nan
    torch.save(broken, saved)
    checkpoints.load(saved, SceneConfig())
    assert "numbers that are not finite, in scene.surfels.quats" in " ".join(capsys.readouterr().out.split())
