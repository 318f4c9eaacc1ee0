"""Loading and editing of captures in tests."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from bitymi_ns.capture.types import CaptureError, FoundPoses


def load(data: Path, device: Any = "cpu", **options: Any) -> Any:
    """Load a capture in nerfstudio's format, every eighth view held out."""
    return load_any(data, device, format="nerfstudio", **options)


def load_any(data: Path, device: Any = "cpu", **options: Any) -> Any:
    from bitymi_ns.plugin.data.dataparser import BitymiDataParserConfig

    return load_with(data, BitymiDataParserConfig(**options), device)


def load_with(data: Path, dataparser: Any, device: Any = "cpu") -> Any:
    from bitymi_ns.plugin.data.datamanager import BitymiDataManagerConfig

    return BitymiDataManagerConfig(data=data, dataparser=dataparser).setup(device=device, test_mode="val")


def images_of(capture: Path) -> list[Path]:
    """List its photographs in order; the first and the ninth are held out."""
    return sorted(p for p in (capture / "images").iterdir() if p.is_file())


def held_out(manager: Any) -> list[str]:
    return [path.name for path in manager.eval_dataset.image_filenames]


def edit(path: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    """Apply `change` to a JSON file, that of a capture by default."""
    path = path / "transforms.json" if path.is_dir() else path
    meta = json.loads(path.read_text("utf8"))
    change(meta)
    path.write_text(json.dumps(meta), "utf8")


def edit_frames(path: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    edit(path, lambda meta: [change(frame) for frame in meta["frames"]])


def save_masks(capture: Path, mask: Any, folder: str = "masks", ending: str = ".png") -> None:
    """Write masks beside the photographs from an array or a value; `mask(i)` gives the i-th."""
    (capture / folder).mkdir()
    for i, path in enumerate(images_of(capture)):
        values = np.full((36, 48), mask(i) if callable(mask) else mask, np.uint8)
        Image.fromarray(values).save(capture / folder / (path.stem + ending))


def add_masks(capture: Path, mask: Any) -> None:
    """Write masks and name them in transforms.json."""
    save_masks(capture, mask)
    edit_frames(capture, lambda frame: frame.update(mask_path=f"masks/{Path(frame['file_path']).stem}.png"))


def reduce_photographs(capture: Path, factor: int, size: tuple[int, int]) -> None:
    """Write smaller copies into images_<factor>."""
    (capture / f"images_{factor}").mkdir()
    for path in images_of(capture):
        Image.open(path).resize(size, Image.Resampling.BOX).save(capture / f"images_{factor}" / path.name)


def write_cloud(path: Path, xyz: Any, rgb: str | None = "200 10 10") -> None:
    """Write a text point cloud of one colour."""
    header = f"ply\nformat ascii 1.0\nelement vertex {len(xyz)}\n" + "".join(f"property double {c}\n" for c in "xyz")
    header += "" if rgb is None else "".join(f"property uchar {c}\n" for c in ("red", "green", "blue"))
    rows = [f"{x!r} {y!r} {z!r} {rgb or ''}\n" for x, y, z in np.asarray(xyz, float).tolist()]
    path.write_text(f"{header}end_header\n{''.join(rows)}")


def expect(message: str) -> Any:
    """Expect the line with which a command of nerfstudio's ends."""
    from bitymi_ns.plugin.console import InputError

    return pytest.raises(InputError, match=message)


def refused(message: str) -> Any:
    """Expect the exception of the package that reads captures."""
    return pytest.raises(CaptureError, match=message)


def printed(capsys: pytest.CaptureFixture[str]) -> str:
    """Return what was printed, on one line."""
    return " ".join(capsys.readouterr().out.split())


def found_poses(model: Path, images: Path, report: Path, **changes: Any) -> FoundPoses:
    """Make poses of twelve photographs, as pose estimation returns them; one was left out."""
    found = dict(left_out={"frame_00099.png": "blurred"}, registered=12, given=13, reprojection_error=0.5)
    return FoundPoses(model, images, report, **{**found, "track_length": 3.0, "seconds": {}, **changes})


def colmap_model(capture: Path, folder: Path, scale: float = 1.0) -> None:
    """Write the capture's views as a COLMAP text model; the fourth quaternion has length `scale`."""
    folder.mkdir(parents=True)
    (folder / "cameras.txt").write_text("1 PINHOLE 48 36 40 40 24 18\n")
    lines = []
    frames = json.loads((capture / "transforms.json").read_text())["frames"]
    for i, frame in enumerate(frames):
        w2c = np.linalg.inv(np.array(frame["transform_matrix"]) @ np.diag([1, -1, -1, 1]))
        quaternion = Rotation.from_matrix(w2c[:3, :3]).as_quat()[[3, 0, 1, 2]] * (scale if i == 3 else 1.0)
        numbers = " ".join(map(str, [i + 1, *quaternion, *w2c[:3, 3], 1]))
        lines.append(f"{numbers} {Path(frame['file_path']).name}\n\n")
    (folder / "images.txt").write_text("".join(lines))
    (folder / "points3D.txt").write_text("1 0 0 0.5 200 10 10 0.5 1 0 2 0\n2 0.1 0 0.5 200 10 10 0.5 1 0 2 0\n")


def as_binary(model: Path) -> None:
    from nerfstudio.data.utils import colmap_parsing_utils as reader

    for what in ("cameras", "images", "points3D"):
        read, write = getattr(reader, f"read_{what}_text"), getattr(reader, f"write_{what}_binary")
        write(read(model / f"{what}.txt"), model / f"{what}.bin")
        (model / f"{what}.txt").unlink()


def mixed_project(folder: Path) -> Path:
    """Make a COLMAP project of nine photographs by three cameras: landscape with distortion, portrait, fisheye."""
    sizes = {1: (48, 36), 2: (30, 40), 3: (40, 40)}
    cameras = {
        1: "SIMPLE_RADIAL 48 36 40 24 18 0.08",
        2: "PINHOLE 30 40 40 41 15 20",
        3: "OPENCV_FISHEYE 40 40 16 16 20 20 0.01 0 0 0",
    }
    model = folder / "sparse/0"
    model.mkdir(parents=True)
    (model / "cameras.txt").write_text("".join(f"{number} {line}\n" for number, line in cameras.items()))
    (model / "points3D.txt").write_text("".join(f"{i} 0.{i} 0.{i % 3} 0.2 200 10 10 0.5\n" for i in range(1, 100)))
    lines = []
    for i, number in enumerate([1, 2, 3] * 3):
        name, half = f"cam{number}/IMG {i} \u00fc.jpg", np.pi * i / 9
        lines.append(f"{i + 1} {np.cos(half)} 0 {np.sin(half)} 0 0 0 3 {number} {name}\n\n")
        path = folder / "images" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        noise = np.random.default_rng(i).integers(0, 255, (*sizes[number][::-1], 3), np.uint8)
        Image.fromarray(noise).save(path)
    (model / "images.txt").write_text("".join(lines), "utf8")
    return folder
