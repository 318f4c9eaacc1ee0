"""Captures of scanning programs are read with their poses, and only their photographs."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from bitymi_ns.capture.maps import read_depth
from tests.captures import expect, load_any, printed

Y_UP = np.array([[0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
"""From a world with z up to ARKit's axes."""


def frames_of(capture: Path) -> tuple[list[tuple[Path, np.ndarray]], dict[str, Any]]:
    meta = json.loads((capture / "transforms.json").read_text())
    return [(capture / f["file_path"], np.array(f["transform_matrix"])) for f in meta["frames"]], meta


def put(file: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(file, target)


def put_depth(target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.full((36, 48), 2000, np.uint16)).save(target)


def polycam(capture: Path, folder: Path, corrected: bool = True) -> Path:
    frames, meta = frames_of(capture)
    for kind in ("", "corrected_") if corrected else ("",):
        for i, (file, pose) in enumerate(frames):
            here = Y_UP @ pose
            here[0, 3] += 0.0 if kind or not corrected else 0.3 * i  # the raw poses drift
            values = {f"t_{r}{c}": here[r, c] for r in range(3) for c in range(4)}
            camera = {"fx": meta["fl_x"], "fy": meta["fl_y"], "cx": meta["cx"], "cy": meta["cy"], "width": 48}
            put(file, folder / f"keyframes/{kind}images/{i}.png")
            place = folder / f"keyframes/{kind}cameras/{i}.json"
            place.parent.mkdir(parents=True, exist_ok=True)
            place.write_text(json.dumps({**values, **camera, "height": 36, "blur_score": 1.0}))
            put_depth(folder / f"keyframes/depth/{i}.png")
    put(frames[0][0], folder / "thumbnail.png")
    return folder


def polycam_raw(capture: Path, folder: Path) -> Path:
    return polycam(capture, folder, corrected=False)


def record3d(capture: Path, folder: Path) -> Path:
    frames, meta = frames_of(capture)
    poses = []
    for i, (file, pose) in enumerate(frames):
        here = Y_UP @ pose
        poses.append([*Rotation.from_matrix(here[:3, :3]).as_quat().tolist(), *here[:3, 3].tolist()])
        put(file, folder / f"rgb/{i}.png")
        put_depth(folder / f"depth/{i}.png")
    K = [2 * meta["fl_x"], 0, 0, 0, 2 * meta["fl_y"], 0, 2 * meta["cx"], 2 * meta["cy"], 1]
    (folder / "metadata").write_text(json.dumps({"K": K, "w": 96, "h": 72, "poses": poses, "fps": 60}))
    return folder


def scannet(capture: Path, folder: Path) -> Path:
    frames, meta = frames_of(capture)
    for i, (file, pose) in enumerate(frames):
        put(file, folder / f"color/{i}.png")
        put_depth(folder / f"depth/{i}.png")
        (folder / "pose").mkdir(exist_ok=True)
        np.savetxt(folder / f"pose/{i}.txt", pose @ np.diag([1, -1, -1, 1]))
    (folder / "intrinsic").mkdir()
    K = [[meta["fl_x"], 0, meta["cx"], 0], [0, meta["fl_y"], meta["cy"], 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    np.savetxt(folder / "intrinsic/intrinsic_color.txt", K)
    return folder


def seven_scenes(capture: Path, folder: Path) -> Path:
    frames, meta = frames_of(capture)
    for i, (file, pose) in enumerate(frames):
        put(file, folder / f"frame-{i:06d}.color.png")
        put(file, folder / f"frame-{i:06d}.depth.png")
        np.savetxt(folder / f"frame-{i:06d}.pose.txt", pose @ np.diag([1, -1, -1, 1]))
    (folder / "intrinsics.txt").write_text(f"{meta['fl_x']} {meta['fl_y']} {meta['cx']} {meta['cy']}\n")
    return folder


def scanner_app(capture: Path, folder: Path) -> Path:
    """3D Scanner App: every frame has a pose and depth, few have a picture."""
    frames, meta = frames_of(capture)
    folder.mkdir()
    for i, (file, pose) in enumerate(frames):
        number = f"{5 * i:05d}"
        matrix = {"cameraPoseARFrame": (Y_UP @ pose).ravel().tolist(), "frame_index": 5 * i, "motionQuality": 1}
        K = [meta["fl_x"], 0, meta["cx"], 0, meta["fl_y"], meta["cy"], 0, 0, 1]
        for name in (number, f"{5 * i + 1:05d}"):
            (folder / f"frame_{name}.json").write_text(json.dumps({**matrix, "intrinsics": K}))
            put_depth(folder / f"depth_{name}.png")
            Image.fromarray(np.full((36, 48), 2, np.uint8)).save(folder / f"conf_{name}.png")
        put(file, folder / f"frame_{number}.png")
    (folder / "info.json").write_text("{}")
    put(frames[0][0], folder / "thumb_00.png")
    return folder


LAYOUTS = [polycam, polycam_raw, record3d, scannet, seven_scenes, scanner_app]


@pytest.mark.parametrize("layout", LAYOUTS)
def test_scans_are_read_with_their_poses(
    capture: Path, tmp_path: Path, layout: Callable[[Path, Path], Path], capsys: pytest.CaptureFixture[str]
) -> None:
    one = load_any(capture, eval_mode="all").train_dataset
    capsys.readouterr()
    other = load_any(layout(capture, tmp_path / "scan"), eval_mode="all").train_dataset
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
    for x, y in zip(a, b, strict=True):  # relative to the first camera
        np.testing.assert_allclose(a[0, :, :3].T @ x[:, :3], b[0, :, :3].T @ y[:, :3], atol=1e-4)
        here, there = (m[0, :, :3].T @ (n[:, 3] - m[0, :, 3]) for m, n in ((a, x), (b, y)))
        np.testing.assert_allclose(here, scale * there, atol=1e-4)
    assert np.allclose(other.cameras.fx, one.cameras.fx, atol=1e-3) and np.allclose(other.cameras.cy, one.cameras.cy)
    assert b[:, 2, 1].mean() > 0.5  # z is up
    depth = [each.depth for each in other.metadata.get("maps", [])]
    assert len(set(depth)) == (0 if layout is seven_scenes else 12)
    if layout is scanner_app:
        assert other.metadata["maps"][1].depth.name == "depth_00005.png"
        assert other.metadata["maps"][1].confidence.name == "conf_00005.png"
    assert "12 photographs with their poses" in (text := printed(capsys))
    assert "depth maps" in text or "depth map" in text


def test_scans_that_are_damaged(capture: Path, tmp_path: Path) -> None:
    folder = polycam(capture, tmp_path / "scan")
    path = folder / "keyframes/corrected_cameras/3.json"
    values = json.loads(path.read_text())
    values.pop("t_01")
    path.write_text(json.dumps(values))
    with expect("corrected_cameras/3.json cannot be read: the entry 't_01' is missing"):
        load_any(folder)
    for change, why in (
        ({"t_01": float("nan")}, "the pose or camera of 3.png is not finite"),
        ({"t_01": 0.0, "width": 0}, "its picture has no pixels"),
        ({"t_01": 0.0, "width": 2**62}, "or its picture has no pixels"),
        ({"t_01": 0.0, "width": float("inf")}, "3.json cannot be read: a number in it is too large"),
        ({"t_01": 10**400}, "3.json cannot be read: a number in it is too large"),
        ({"t_01": [[]] * 3}, "3.json cannot be read: float"),
    ):
        path.write_text(json.dumps({**values, **change}))
        with expect(why):
            load_any(folder)
    path.write_text("[" * 100_000)
    with expect("3.json cannot be read: it is nested too deeply"):
        load_any(folder)
    path.unlink()
    (folder / "keyframes/corrected_images/5.png").unlink()
    with expect(r"1 of 11 photographs of .* are missing:\s+.*corrected_images/5"):
        load_any(folder)
    folder = scannet(capture, tmp_path / "set")
    shutil.rmtree(folder / "intrinsic")
    with expect("has poses, but no file with the camera .* `bitymi-data --format photographs`"):
        load_any(folder)


def test_a_pose_that_was_lost(capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = scannet(capture, tmp_path / "set")
    np.savetxt(folder / "pose/4.txt", np.full((4, 4), -np.inf))
    assert len(load_any(folder, eval_mode="all").train_dataset) == 11
    assert "1 photographs of" in printed(capsys)


def test_pictures_of_another_shape(capture: Path, tmp_path: Path) -> None:
    folder = record3d(capture, tmp_path / "scan")
    Image.new("RGB", (36, 48)).save(folder / "rgb/2.png")
    with expect("2.png has 36 x 48 pixels, but its camera is for 96 x 72, which is another shape"):
        load_any(folder)


def stray_scanner(capture: Path, folder: Path, rows: int = 12) -> Path:
    """Stray Scanner: a video, of which every frame has a pose and depth."""
    frames, meta = frames_of(capture)
    folder.mkdir()
    with av.open(str(folder / "rgb.mp4"), "w") as container:
        stream = container.add_stream("mpeg4", rate=10)
        stream.width, stream.height, stream.pix_fmt, stream.bit_rate = 48, 36, "yuv420p", 8_000_000
        for file, _ in frames:
            container.mux(stream.encode(av.VideoFrame.from_image(Image.open(file).convert("RGB"))))
        container.mux(stream.encode())
    K = [[meta["fl_x"], 0, meta["cx"]], [0, meta["fl_y"], meta["cy"]], [0, 0, 1]]
    (folder / "camera_matrix.csv").write_text("\n".join(", ".join(map(str, row)) for row in K))
    lines = ["timestamp, frame, x, y, z, qx, qy, qz, qw"]
    for i in range(rows):
        here = Y_UP @ frames[i % 12][1]
        quaternion = Rotation.from_matrix(here[:3, :3] @ np.diag([1, -1, -1])).as_quat()
        lines.append(", ".join(map(str, [0.1 * i, f"{i:06d}", *here[:3, 3], *quaternion])))
        put_depth(folder / f"depth/{i:06d}.png")
        (folder / "confidence").mkdir(exist_ok=True)
        Image.fromarray(np.full((36, 48), i != 3, np.uint8)).save(folder / f"confidence/{i:06d}.png")
    (folder / "odometry.csv").write_text("\n".join(lines) + "\n")
    (folder / "imu.csv").write_text("timestamp, a_x\n")
    return folder


def test_a_capture_of_stray_scanner(capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    one = load_any(capture, eval_mode="all").train_dataset
    folder = stray_scanner(capture, tmp_path / "scan")
    capsys.readouterr()
    other = load_any(folder, eval_mode="all").train_dataset
    shown = [int(path.stem.removeprefix("frame_")) for path in other.image_filenames]
    assert shown == sorted(set(shown)) and len(shown) > 6
    a = one.cameras.camera_to_worlds.double().numpy()[shown]
    b = other.cameras.camera_to_worlds.double().numpy()
    for x, y in zip(a, b, strict=True):
        np.testing.assert_allclose(a[0, :, :3].T @ x[:, :3], b[0, :, :3].T @ y[:, :3], atol=1e-4)
    assert b[:, 2, 1].mean() > 0.5 and np.allclose(other.cameras.fx, one.cameras.fx[:1], atol=1e-3)
    for i, number in enumerate(shown):  # picture and pose belong together
        difference = np.abs(other.get_numpy_image(i).astype(int) - one.get_numpy_image(number).astype(int))
        assert difference.mean() < 12
    maps = other.metadata["maps"]
    assert [each.depth.name for each in maps] == [f"{number:06d}.png" for number in shown]
    assert all(each.confidence == folder / f"confidence/{each.depth.name}" for each in maps)
    for number, files, lens in zip(shown, maps, other.metadata["lenses"], strict=True):
        assert np.allclose(read_depth(files, lens), 0.0 if number == 3 else 2.0)
    apart = np.linalg.norm(b[1:, :, 3] - b[0, :, 3], axis=1) / other._dataparser_outputs.dataparser_scale
    poses = np.array([pose for _, pose in frames_of(capture)[0]])[shown]
    assert np.allclose(apart, np.linalg.norm(poses[1:, :3, 3] - poses[0, :3, 3], axis=1))  # metres stay metres
    text = printed(capsys)
    assert "(stray-scanner, " in text and "rgb.mp4" not in text
    before = sorted(path.stat().st_mtime_ns for path in (folder / ".bitymi").rglob("*.jpg"))
    load_any(folder)
    assert before == sorted(path.stat().st_mtime_ns for path in (folder / ".bitymi").rglob("*.jpg"))


def test_captures_of_the_apps_that_are_damaged(capture: Path, tmp_path: Path) -> None:
    with expect("has 12 frames, but 30 poses: .*--data .*rgb.mp4"):
        load_any(stray_scanner(capture, tmp_path / "longer", rows=30))
    folder = stray_scanner(capture, tmp_path / "scan")
    text = (folder / "odometry.csv").read_text()
    for changed, message in (
        (text.replace("qw", "w", 1), "odometry.csv: pose 0 .* cannot be read: the entry 'qw' is missing"),
        (text.replace("0.1, 000001", "0.1, one"), "odometry.csv: pose 1 .* cannot be read: invalid literal"),
    ):
        (folder / "odometry.csv").write_text(changed)
        with expect(message):
            load_any(folder)
    (folder / "camera_matrix.csv").write_text("1, 2\n")
    with expect("camera_matrix.csv cannot be read"):
        load_any(folder)
    scan = scanner_app(capture, tmp_path / "app")
    for values, message in (
        ({"intrinsics": [1] * 9}, "frame_00010.json cannot be read: the entry 'cameraPoseARFrame' is missing"),
        ({"intrinsics": [1] * 9, "cameraPoseARFrame": [1.0] * 12}, "it has 12 numbers, not 16"),
    ):
        (scan / "frame_00010.json").write_text(json.dumps(values))
        with expect(message):
            load_any(scan)
