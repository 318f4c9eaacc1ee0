"""The room of the tests as a capture of every format: each function returns what has the poses, a file or a folder.

Those of files turn the room itself into one; those of scanning programs write a scan beside it."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from tests.captures import colmap_model, edit

Form = Callable[[Path], Path]
Y_UP = np.array([[0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
"""From a world with z up to ARKit's axes."""


def nerfstudio(capture: Path) -> Path:
    return capture / "transforms.json"


def instant_ngp(capture: Path) -> Path:
    edit(capture, lambda meta: (meta.pop("ply_file_path"), meta.pop("camera_model"), meta.update(aabb_scale=4)))
    return capture / "transforms.json"


def blender(capture: Path) -> Path:
    (capture / "transforms.json").rename(capture / "transforms_train.json")
    edit(capture / "transforms_train.json", lambda meta: meta.pop("ply_file_path"))
    return capture / "transforms_train.json"


def colmap(capture: Path) -> Path:
    colmap_model(capture, capture / "sparse/0")
    for name in ("transforms.json", "sparse_pc.ply"):
        (capture / name).unlink()
    return capture / "sparse/0"


def room_of(capture: Path) -> tuple[list[tuple[Path, np.ndarray]], dict[str, Any], Path]:
    """Return the room's photographs with their poses, its other entries, and a new folder for a scan of it."""
    meta = json.loads((capture / "transforms.json").read_text())
    folder = capture.parent / "scan"
    folder.mkdir()
    return [(capture / f["file_path"], np.array(f["transform_matrix"])) for f in meta["frames"]], meta, folder


def put(file: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(file, target)


def put_depth(target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.full((36, 48), 2000, np.uint16)).save(target)


def polycam(capture: Path, corrected: bool = True) -> Path:
    frames, meta, folder = room_of(capture)
    for kind in ("", "corrected_") if corrected else ("",):
        for i, (file, pose) in enumerate(frames):
            here = Y_UP @ pose
            here[0, 3] += 0.0 if kind or not corrected else 0.3 * i  # the raw poses drift
            values = {f"t_{r}{c}": here[r, c] for r in range(3) for c in range(4)}
            camera = {"fx": meta["fl_x"], "fy": meta["fl_y"], "cx": meta["cx"], "cy": meta["cy"]}
            camera |= {} if kind else {"width": meta["w"], "height": meta["h"]}  # corrected ones have none since 2025
            put(file, folder / f"keyframes/{kind}images/{i}.png")
            place = folder / f"keyframes/{kind}cameras/{i}.json"
            place.parent.mkdir(parents=True, exist_ok=True)
            place.write_text(json.dumps({**values, **camera, "blur_score": 1.0}))
            put_depth(folder / f"keyframes/depth/{i}.png")
    put(frames[0][0], folder / "thumbnail.png")
    return folder


def polycam_raw(capture: Path) -> Path:
    return polycam(capture, corrected=False)


def record3d(capture: Path) -> Path:
    frames, meta, folder = room_of(capture)
    poses = []
    for i, (file, pose) in enumerate(frames):
        here = Y_UP @ pose
        poses.append([*Rotation.from_matrix(here[:3, :3]).as_quat().tolist(), *here[:3, 3].tolist()])
        put(file, folder / f"rgb/{i}.png")
        put_depth(folder / f"depth/{i}.png")
    K = [2 * meta["fl_x"], 0, 0, 0, 2 * meta["fl_y"], 0, 2 * meta["cx"], 2 * meta["cy"], 1]
    (folder / "metadata").write_text(
        json.dumps({"K": K, "w": 2 * meta["w"], "h": 2 * meta["h"], "poses": poses, "fps": 60})
    )
    return folder


def scannet(capture: Path) -> Path:
    frames, meta, folder = room_of(capture)
    for i, (file, pose) in enumerate(frames):
        put(file, folder / f"color/{i}.png")
        put_depth(folder / f"depth/{i}.png")
        (folder / "pose").mkdir(exist_ok=True)
        np.savetxt(folder / f"pose/{i}.txt", pose @ np.diag([1, -1, -1, 1]))
    (folder / "intrinsic").mkdir()
    K = [[meta["fl_x"], 0, meta["cx"], 0], [0, meta["fl_y"], meta["cy"], 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    np.savetxt(folder / "intrinsic/intrinsic_color.txt", K)
    return folder


def seven_scenes(capture: Path) -> Path:
    frames, meta, folder = room_of(capture)
    for i, (file, pose) in enumerate(frames):
        put(file, folder / f"frame-{i:06d}.color.png")
        put(file, folder / f"frame-{i:06d}.depth.png")
        np.savetxt(folder / f"frame-{i:06d}.pose.txt", pose @ np.diag([1, -1, -1, 1]))
    (folder / "intrinsics.txt").write_text(f"{meta['fl_x']} {meta['fl_y']} {meta['cx']} {meta['cy']}\n")
    return folder


def nsvf(capture: Path) -> Path:
    """NSVF: the first numbers of names are of training, validation and test; f, cx, cy begin the file of the camera."""
    frames, meta, folder = room_of(capture)
    (folder / "pose").mkdir()
    for i, (file, pose) in enumerate(frames):
        name = f"{max(0, i - 9)}_{i:04d}"
        put(file, folder / f"rgb/{name}.png")
        np.savetxt(folder / f"pose/{name}.txt", pose @ np.diag([1, -1, -1, 1]))
    (folder / "intrinsics.txt").write_text(f"{meta['fl_x']} {meta['cx']} {meta['cy']} 0.\n0. 0. 0.\n0.\n1.\n36 48\n")
    return folder


def scanner_app(capture: Path) -> Path:
    """3D Scanner App: every frame has a pose and depth, few have a picture."""
    frames, meta, folder = room_of(capture)
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


def stray_scanner(capture: Path, rows: int = 12) -> Path:
    """Stray Scanner: a video, of which every frame has a pose and depth."""
    frames, meta, folder = room_of(capture)
    with av.open(str(folder / "rgb.mp4"), "w") as container:
        stream = container.add_stream("mpeg4", rate=10)
        stream.width, stream.height, stream.pix_fmt, stream.bit_rate = meta["w"], meta["h"], "yuv420p", 8_000_000
        stream.gop_size = 3
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


JSON = [nerfstudio, instant_ngp, blender]
PHOTOGRAPHS = [*JSON, colmap]
SCANS = [polycam, polycam_raw, record3d, scannet, seven_scenes, scanner_app]
