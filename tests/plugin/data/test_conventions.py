"""Poses of every format in another convention than the file's are read as meant, as the photographs show."""

import copy
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from scipy.spatial.transform import Rotation

from bitymi_ns import load_capture
from bitymi_ns.capture import readings
from bitymi_ns.capture.points import read_cloud
from bitymi_ns.plugin.data.dataparser import BitymiDataParserConfig
from bitymi_ns.plugin.run.config import method_config
from bitymi_ns.ply import write_cloud
from tests.captures import edit, edit_frames, load_any, printed
from tests.formats import JSON, SCANS, Form, colmap, scannet, stray_scanner
from tests.typed import Patch, Printed

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
MIRROR = np.diag([1.0, 1.0, -1.0, 1.0])
QUARTER = np.array([[0.0, -1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
Pose = np.ndarray
Change = Callable[[Pose], Pose]


@pytest.fixture(scope="session")
def large_room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The room at a size at which photographs can be matched. Not to be changed."""
    from bitymi_ns.sample import generate

    return generate(tmp_path_factory.mktemp("large") / "room", views=12, width=320, height=240, seed=0, points=200)


@pytest.fixture
def capture(large_room: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(large_room, tmp_path / "room"))


@pytest.fixture
def decided(monkeypatch: Patch) -> Callable[[], str]:
    """A function that returns the reading that matches decided, once, and of which there were enough."""
    decisions, decide = [], readings.decide
    monkeypatch.setattr(readings, "decide", lambda *given: decisions.append(decide(*given)) or decisions[-1])

    def decided() -> str:
        (decision,) = decisions
        assert decision.reading is not None and decision.share > 0.5
        return decision.reading.name

    return decided


def of_json(capture: Path, change: Change) -> Path:
    edit_frames(capture, lambda f: f.update(transform_matrix=change(np.array(f["transform_matrix"])).tolist()))
    return capture


def model(capture: Path) -> Path:
    folder = colmap(capture)
    (folder / "cameras.txt").write_text("1 PINHOLE 320 240 256 256 160 120\n")
    return folder


def of_model(capture: Path, change: Change, order: str = "wxyz") -> Path:
    """Change the poses, world to camera, of the room as a COLMAP model, and write quaternions in an order."""
    path, lines = model(capture) / "images.txt", []
    for line in filter(None, path.read_text().splitlines()):
        number, *pose, camera, name = line.split()
        w2c = np.eye(4)
        w2c[:3, :3], w2c[:3, 3] = Rotation.from_quat([*map(float, [*pose[1:4], pose[0]])]).as_matrix(), pose[4:]
        other = change(w2c)
        numbers = dict(zip("xyzw", Rotation.from_matrix(other[:3, :3]).as_quat(), strict=True))
        written = [*(numbers[letter] for letter in order), *other[:3, 3]]
        lines.append(f"{' '.join(map(str, [number, *written, camera, name]))}\n\n")
    path.write_text("".join(lines))
    return capture


def of_scan(capture: Path, change: Change) -> Path:
    folder = scannet(capture)
    for path in (folder / "pose").iterdir():
        np.savetxt(path, change(np.loadtxt(path)))
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("form", [*JSON, model, *SCANS, stray_scanner])
def test_right_ones_are_nothing_to_speak_of(
    capture: Path, form: Form, decided: Callable[[], str], capsys: Printed
) -> None:
    place = form(capture)
    load_any(capture if place.is_relative_to(capture) else place)
    text = printed(capsys)
    assert decided() and "poses are read as" not in text and "badly" not in text


@pytest.mark.slow
@pytest.mark.parametrize(
    ("write", "name"),
    [
        (lambda c: of_json(c, lambda pose: pose @ FLIP), "opencv-c2w"),
        (lambda c: of_json(c, np.linalg.inv), "opengl-w2c"),
        (lambda c: of_json(c, lambda pose: np.linalg.inv(pose @ FLIP)), "opencv-w2c"),
        (lambda c: of_json(c, lambda pose: pose @ MIRROR), "left-handed-c2w"),
        (lambda c: of_json(c, lambda pose: pose @ QUARTER), "opengl-c2w-turn270"),
        (lambda c: of_model(c, lambda w2c: FLIP @ w2c), "opengl-w2c-wxyz"),
        (lambda c: of_model(c, np.linalg.inv), "opencv-c2w-wxyz"),
        (lambda c: of_model(c, np.linalg.inv, "xyzw"), "opencv-c2w-xyzw"),
        (lambda c: of_scan(c, lambda pose: pose @ FLIP), "opengl-c2w"),
    ],
)  # fmt: skip
def test_others_are_read_as_meant(
    capture: Path, write: Form, name: str, decided: Callable[[], str], capsys: Printed
) -> None:
    right = load_any(capture, poses_as="written").train_dataset.cameras.camera_to_worlds
    data = write(capture)
    manager = load_any(data)
    text = printed(capsys)
    assert decided() == name
    assert re.search(rf"the poses are read as {name}, which explains \d\d% .*; as written .*, \d+%", text)
    assert "`bitymi-data --poses-as written`" in text
    found = manager.train_dataset.cameras.camera_to_worlds
    np.testing.assert_allclose(relative(found), relative(right), atol=1e-3)
    again = load_any(data, poses_as=name).train_dataset.cameras.camera_to_worlds
    assert (again == found).all() and "poses are read as" not in printed(capsys)


def relative(poses: Any) -> Any:
    """Compute the positions in the first camera's frame, over the distance of the second one."""
    first, places = poses[0, :, :3].double().numpy(), poses[:, :, 3].double().numpy()
    local = (places - places[0]) @ first
    return local / np.linalg.norm(local[1])


def test_a_left_handed_world_is_mirrored_with_its_cloud(capture: Path, decided: Callable[[], str]) -> None:
    right = load_any(capture, poses_as="written").train_dataparser_outputs
    of_json(capture, lambda pose: MIRROR @ pose @ MIRROR)
    cloud = capture / "sparse_pc.ply"
    points = read_cloud(cloud, "")[0]
    write_cloud(cloud, points.xyz * (1, 1, -1), points.rgb)
    found = load_any(capture).train_dataparser_outputs
    assert decided() == "left-handed-c2w"
    np.testing.assert_allclose(found.metadata["points3D_xyz"], right.metadata["points3D_xyz"], atol=1e-5)
    np.testing.assert_allclose(found.cameras.camera_to_worlds, right.cameras.camera_to_worlds, atol=1e-5)


def test_cameras_at_one_place_as_written(capture: Path, decided: Callable[[], str]) -> None:
    """Poses of a turntable, read in the wrong direction, put all cameras at one place: no reason to stop."""
    edit(capture, lambda meta: meta.pop("ply_file_path"))
    of_json(capture, lambda pose: np.linalg.inv(pose))
    views = load_capture(capture, points="random")[0]
    assert decided() == "opengl-w2c"
    as_written = load_capture(capture, points="random", poses_as="written")[0]
    assert not torch.allclose(views[0].camera.viewmat, as_written[0].camera.viewmat)


def test_a_run_records_its_reading(capture: Path, tmp_path: Path) -> None:
    """config.yml has the reading, for commands that need no photographs and for resuming; one from before has none."""
    of_json(capture, lambda pose: pose @ FLIP)

    def configured(**options: Any) -> Any:
        config = copy.deepcopy(method_config("bitymi").config)
        config.pipeline.datamanager.data, config.output_dir = capture, tmp_path / "runs"
        for name, value in options.items():
            setattr(config, name, value)
        config.set_timestamp()
        return config

    config = configured()
    config.save_config()
    path = config.get_base_dir() / "config.yml"
    recorded = yaml.load(path.read_text(), yaml.UnsafeLoader).pipeline.datamanager.dataparser
    assert recorded.poses_as == "opencv-c2w" and BitymiDataParserConfig().poses_as == "auto"
    resumed = configured(load_dir=path.parent / "nerfstudio_models").pipeline.datamanager.dataparser
    assert resumed.poses_as == "opencv-c2w"
    shutil.rmtree(capture / "images")
    recorded.data = capture
    parser = recorded.setup()
    parser.downscale_factor = 1  # how nerfstudio says that photographs are not needed
    assert parser.get_dataparser_outputs("train").cameras.shape and parser.capture.poses_as == "opencv-c2w"
    path.write_text("".join(line for line in path.read_text().splitlines(True) if "poses_as" not in line))
    assert yaml.load(path.read_text(), yaml.UnsafeLoader).pipeline.datamanager.dataparser.poses_as == "written"
    resumed = configured(load_dir=path.parent / "nerfstudio_models").pipeline.datamanager.dataparser
    assert resumed.poses_as == "written"
