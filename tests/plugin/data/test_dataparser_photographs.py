"""The presets' dataparser on photographs and videos without poses."""

import sys
import types
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest
import yaml
from PIL import Image

from bitymi_ns.capture.types import SfmOptions, SfmSettings
from tests.captures import expect, found_poses, load_any, load_with, printed
from tests.plugin.data.test_dataparser import parsed


@pytest.fixture
def finder(project: Path, monkeypatch: pytest.MonkeyPatch) -> list[tuple[Path, SfmOptions]]:
    """Stub of pose estimation, which returns the project's model and records its arguments."""
    asked: list[tuple[Path, SfmOptions]] = []

    def find_poses(source: Path, options: Any, progress: Any, *told: Any) -> Any:
        asked.append((source, options))
        progress("matching", 1, 2)
        doubtful = {"contradicted": 0.27} if source.name == "walk.mp4" else {}
        return found_poses(project / "sparse/0", project / "images", project / "report", **doubtful)

    monkeypatch.setattr("bitymi_ns.capture.poses.find_poses", find_poses)
    progress = types.ModuleType("bitymi_ns.progress")
    progress.rich_progress = lambda: nullcontext(lambda step, done, total: print(step))  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "bitymi_ns.progress", progress)
    return asked


@pytest.mark.parametrize("name", ["photographs", "walk.mp4"])
def test_photographs_and_videos_are_given_to_the_finding_of_poses(
    project: Path, finder: list[Any], tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    given = tmp_path / name
    if given.suffix:
        given.write_bytes(b"")
    else:
        given.mkdir()
        Image.new("RGB", (8, 8)).save(given / "a.png")
    manager = load_any(given)
    assert [source for source, _ in finder] == [given] and len(manager.train_dataset) == 10
    text = printed(capsys)
    assert "matching" in text
    assert f"Poses of 12 of 13 photographs of {given}, to 0.50 pixels" in text
    assert ("27% of what photographs have in common contradicts their poses" in text) == (name == "walk.mp4")
    assert "have no pose in the model and are left out: frame_00099.png (blurred)." in text
    assert "Held out for evaluation: 2 of 12 photographs" in text


def test_options_of_structure_from_motion_reach_it(project: Path, finder: list[Any]) -> None:
    args = ["bitymi-data", "--sfm.matching", "sequential", "--sfm.max-features", "4000"]
    config = parsed(*args, "--sfm.camera-model", "OPENCV", "--sfm.frames", "50")
    load_with(project / "images", config)
    settings = SfmSettings(matching="sequential", max_features=4000, camera_model="OPENCV", frames=50)
    assert [options for _, options in finder] == [SfmOptions(**vars(settings))]
    again = yaml.load(yaml.dump(config), Loader=yaml.Loader)  # like config.yml
    assert again.sfm == settings


def test_options_of_structure_from_motion_that_cannot_be(project: Path, finder: list[Any]) -> None:
    with expect("max_features is 1: give a number from 100 to 1,000,000"):
        load_any(project / "images", sfm=SfmSettings(max_features=1))
    with expect("--sfm is not for .*, which is read as colmap, but for photographs, video"):
        load_any(project, sfm=SfmSettings(max_features=4000))
