"""Captures of scanning programs are read with their poses, and only their photographs."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from bitymi_ns.capture.depth_normal_maps import read_depth
from bitymi_ns.capture.scanner_views import _intrinsics
from tests.capture.test_video import overwrite_packets
from tests.captures import held_out, load_any, printed
from tests.formats import SCANS, nsvf, scanner_app, seven_scenes, stray_scanner


def from_first(poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return rotations and positions in the first camera's frame."""
    first = poses[0, :, :3]
    return first.T @ poses[:, :, :3], (poses[:, :, 3] - poses[0, :, 3]) @ first


@pytest.mark.parametrize("layout", SCANS)
def test_scans_are_read_with_their_poses(
    capture: Path, tmp_path: Path, layout: Callable[[Path], Path], capsys: pytest.CaptureFixture[str]
) -> None:
    one = load_any(capture, eval_mode="all").train_dataset
    capsys.readouterr()
    other = load_any(layout(capture), eval_mode="all").train_dataset
    assert len(other) == 12 and len({path.parent for path in other.image_filenames}) == 1
    assert not any("depth" in str(path) or "thumb" in path.name for path in other.image_filenames)
    shown = [
        int(path.name.removesuffix(".png").removesuffix(".color").replace("frame_", "").rpartition("-")[2])
        for path in other.image_filenames
    ]
    shown = [number // (5 if layout is scanner_app else 1) for number in shown]
    a = one.cameras.camera_to_worlds.double().numpy()[shown]
    b = other.cameras.camera_to_worlds.double().numpy()
    scale = np.linalg.norm(a[1:, :, 3] - a[0, :, 3]) / np.linalg.norm(b[1:, :, 3] - b[0, :, 3])
    (turns, places), (their_turns, their_places) = map(from_first, (a, b))
    np.testing.assert_allclose(turns, their_turns, atol=1e-4)
    np.testing.assert_allclose(places, scale * their_places, atol=1e-4)
    assert np.allclose(other.cameras.fx, one.cameras.fx, atol=1e-3) and np.allclose(other.cameras.cy, one.cameras.cy)
    assert b[:, 2, 1].mean() > 0.5  # z is up
    depth = [each.depth for each in other.facts.maps]
    assert len(set(depth)) == (0 if layout is seven_scenes else 12)
    if layout is scanner_app:
        assert other.facts.maps[1].depth.name == "depth_00005.png"
        assert other.facts.maps[1].confidence.name == "conf_00005.png"
    assert "12 photographs with their poses" in (text := printed(capsys))
    assert "depth maps" in text or "depth map" in text


def test_cameras_of_folders_with_poses(tmp_path: Path) -> None:
    matrix = np.array([[40, 0, 24, 0], [0, 41, 18, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    for numbers, fy in (
        (matrix, 41), (matrix[:3, :3], 41), (matrix[:2], 41), (matrix.reshape(1, 16), 41),
        (matrix[:3, :3].reshape(1, 9), 41), ([[40, 41, 24, 18]], 41), ([[40, 24, 18]], 40), ([[40, 24, 18, 0]], 40),
        ([[40, 24, 18, 0], [0, 0, 0], [0], [1], [36, 48]], 40), ([[40, 24, 18], [0, 0, 0], [0.5]], 40),
    ):  # fmt: skip
        (tmp_path / "intrinsics.txt").write_text("\n".join(" ".join(map(str, row)) for row in numbers))
        assert _intrinsics(tmp_path) == (40, fy, 24, 18)


def test_nsvfs_names_are_its_split(capture: Path, capsys: pytest.CaptureFixture[str]) -> None:
    manager = load_any(folder := nsvf(capture))
    assert held_out(manager) == ["1_0010.png", "2_0011.png"] and len(manager.train_dataset) == 10
    assert "2 of 12 photographs, by NSVF's names (1_0010.png, 2_0011.png)" in printed(capsys)
    for file in [*folder.glob("*/1_*"), *folder.glob("*/2_*")]:
        file.rename(file.with_name(f"0{file.name[1:]}"))
    assert held_out(load_any(folder)) == ["0_0000.png", "0_0008.png"]


@pytest.mark.parametrize("damaged", [False, True])
def test_a_capture_of_stray_scanner(capture: Path, capsys: pytest.CaptureFixture[str], damaged: bool) -> None:
    one = load_any(capture, eval_mode="all").train_dataset
    frames = json.loads((capture / "transforms.json").read_text())["frames"]
    folder = stray_scanner(capture)
    if damaged:
        overwrite_packets(folder / "rgb.mp4", 4)
    capsys.readouterr()
    other = load_any(folder, eval_mode="all").train_dataset
    shown = [int(path.stem.removeprefix("frame_")) for path in other.image_filenames]
    assert shown == sorted(set(shown)) and len(shown) > 6
    a = one.cameras.camera_to_worlds.double().numpy()[shown]
    b = other.cameras.camera_to_worlds.double().numpy()
    np.testing.assert_allclose(from_first(a)[0], from_first(b)[0], atol=1e-4)
    assert b[:, 2, 1].mean() > 0.5 and np.allclose(other.cameras.fx, one.cameras.fx[:1], atol=1e-3)
    for i, number in enumerate(shown):  # picture and pose belong together
        difference = np.abs(other.get_numpy_image(i).astype(int) - one.get_numpy_image(number).astype(int))
        assert difference.mean() < 12
    maps = other.facts.maps
    assert [each.depth.name for each in maps] == [f"{number:06d}.png" for number in shown]
    assert all(each.confidence == folder / f"confidence/{each.depth.name}" for each in maps)
    for number, files, lens in zip(shown, maps, other.facts.lenses, strict=True):
        assert np.allclose(read_depth(files, lens), 0.0 if number == 3 else 2.0)
    apart = np.linalg.norm(b[1:, :, 3] - b[0, :, 3], axis=1) / other._dataparser_outputs.dataparser_scale
    poses = np.array([frame["transform_matrix"] for frame in frames])[shown]
    assert np.allclose(apart, np.linalg.norm(poses[1:, :3, 3] - poses[0, :3, 3], axis=1))  # metres stay metres
    text = printed(capsys)
    assert "(stray-scanner, " in text
    assert ("rgb.mp4 is damaged: 2 of its 12 frames are left out" if damaged else "") in text
    assert ("rgb.mp4" in text) is damaged
    before = sorted(path.stat().st_mtime_ns for path in (folder / ".bitymi").rglob("*.jpg"))
    load_any(folder)
    assert before == sorted(path.stat().st_mtime_ns for path in (folder / ".bitymi").rglob("*.jpg"))
