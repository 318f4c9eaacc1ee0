"""Up vector and metric scale of a capture with estimated poses, from reader to bundle."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from bitymi_ns.bundle import check_files, check_world
from bitymi_ns.bundle.manifest import Manifest
from bitymi_ns.capture.frame import WorldFrame, write_frame
from bitymi_ns.plugin.data.datamanager import BitymiDataManager
from bitymi_ns.plugin.export.trained import world_of
from tests.bake.conftest import surfels
from tests.bake.scenes import write
from tests.captures import colmap_model, found_poses, images_of, load_any

__all__ = ["surfels"]

UNIT = 2.5
"""Metres per unit of the room's world, which has z up."""


def frame(up: str = "gps", metres: float | None = UNIT) -> WorldFrame:
    return WorldFrame(up, metres, None, None, 0, np.eye(4)[:3].tolist())


def known_places(capture: Path) -> np.ndarray:
    """Return the positions [n, 3] of the training cameras, metres, z up."""
    frames = json.loads((capture / "transforms.json").read_text())["frames"]
    places = {Path(f["file_path"]).name: np.array(f["transform_matrix"])[:3, 3] for f in frames}
    return UNIT * np.array([places[path.name] for path in images_of(capture)])


def photographs(capture: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The capture's photographs alone; pose estimation is stubbed to return its own poses."""
    colmap_model(capture, capture / "found/sparse/0")
    write_frame(capture / "found", frame())

    found = found_poses(capture / "found/sparse/0", capture / "images", capture / "found", left_out={}, given=12)
    monkeypatch.setattr("bitymi_ns.capture.poses.find_poses", lambda *arguments: found)
    folder = capture.parent / "photographs"
    shutil.copytree(capture / "images", folder)
    return folder


def bundled(manager: BitymiDataManager, surfels: Any, folder: Path) -> Manifest:
    write(folder, surfels(4, "sv"), world=world_of(manager))
    bundle, checks = check_files(folder)
    assert bundle is not None and all(check.ok for check in checks)
    return bundle.info


@pytest.mark.parametrize("read", ["transforms", "photographs"])
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"orientation_method": "vertical", "scale_factor": 3.0},
        {"orientation_method": "none", "auto_scale_poses": False},
    ],
    ids=["up", "vertical", "none"],
)
def test_heights_and_distances_are_those_of_the_world(
    capture: Path, tmp_path: Path, surfels: Any, monkeypatch: pytest.MonkeyPatch, read: str, options: Any
) -> None:
    data = capture if read == "transforms" else photographs(capture, monkeypatch)
    if read == "transforms":
        write_frame(capture, frame())
    manager = load_any(data, eval_mode="all", **options)
    world = bundled(manager, surfels, tmp_path / "bundle").world
    assert world.up_from == "gps"
    places = manager.train_dataset.cameras.camera_to_worlds[:, :, 3].double().numpy()
    known = known_places(capture)
    heights = places @ world.up * world.metres_per_unit
    np.testing.assert_allclose(heights - heights[0], known[:, 2] - known[0, 2], atol=1e-4)
    spans = np.linalg.norm(places - places[0], axis=1) * world.metres_per_unit
    np.testing.assert_allclose(spans, np.linalg.norm(known - known[0], axis=1), atol=1e-4)
    assert check_world(world, world_of(manager)).ok
    for wrong in ({"up": (0.0, 0.6, 0.8)}, {"metres_per_unit": 1.01 * world.metres_per_unit}, {"scale": 7.0}):
        assert not check_world(world.replace(**wrong), world_of(manager)).ok


def test_up_without_a_scale(capture: Path, tmp_path: Path, surfels: Any) -> None:
    write_frame(capture, frame("cameras", None))
    info = bundled(load_any(capture), surfels, tmp_path / "bundle")
    assert info.world.up_from == "cameras" and info.world.metres_per_unit is None
    assert "metres_per_unit" not in json.loads((tmp_path / "bundle/bundle.json").read_text())["world"]


@pytest.mark.parametrize(
    "text", [None, "{}", "no json", "[1]", json.dumps({**frame().__dict__, "up": "aliens"}),
             json.dumps({**frame().__dict__, "metres_per_unit": -1})]
)  # fmt: skip
def test_a_capture_that_came_with_its_poses_states_neither(
    capture: Path, tmp_path: Path, surfels: Any, text: str | None
) -> None:
    if text is not None:  # by another program
        (capture / "frame.json").write_text(text)
    manager = load_any(capture)
    assert world_of(manager).up is None
    stated = bundled(manager, surfels, tmp_path / "bundle").world.model_dump()
    assert set(stated) == {"transform", "scale"}
    assert torch.tensor(stated["transform"]).shape == (3, 4)
