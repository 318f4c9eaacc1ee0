"""Results beside photographs are not read as photographs, and are named."""

import errno
import json
import os
from collections.abc import Callable
from pathlib import Path

import pytest
from PIL import Image

from bitymi_ns.bundle.manifest import FORMAT
from bitymi_ns.capture.folder_contents import passed_over, poses_in, result_in
from bitymi_ns.capture.kinds import RENDERED
from bitymi_ns.capture.poses import find_poses
from bitymi_ns.capture.recognise import recognise
from bitymi_ns.capture.sfm_photos import find_photos
from bitymi_ns.capture.types import CaptureError

MANIFEST = json.dumps({"format": FORMAT})
CONFIG = "!!python/object:nerfstudio.engine.trainer.TrainerConfig\nmethod_name: x\n"
CAPTURE = json.dumps({"frames": [{"file_path": "images/a.jpg", "transform_matrix": []}]})
RESULTS = {
    "scene/preview.jpg": "pictures of a bundle",
    "scene/photograph-0001.jpg": "pictures of a bundle",
    "mine/room/bitymi/2026/poses/images/a.jpg": "pictures of a training run",
    "maps/test/rgb/a.jpg": "renders of ns-render",
    "maps/test/beta/a.jpg": "renders of ns-render",
    "frames/00000.jpg": "renders of ns-render",
    "frames2/00000.png": "renders of ns-render",
    "compared/eval_img_0000.png": "renders of ns-eval",
    "worst/view0003-photo.png": "pictures of `bitymi bench pictures`",
    "processed/images/a.jpg": "pictures of another capture",
    "processed/images_2/a.jpg": "pictures of another capture",
    "exports/mesh/material_0.png": "results of programs",
}
MARKS = {
    "scene/bundle.json": MANIFEST,
    "mine/room/bitymi/2026/config.yml": CONFIG,
    "worst/pictures.json": '{"bitymi_pictures": 1}',
    "processed/transforms.json": CAPTURE,
}


def save(path: Path, **options: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", (8, 8)).save(path, **options)


@pytest.fixture
def photographs(tmp_path: Path) -> Path:
    """A flat folder with three photographs and every kind of result."""
    folder = tmp_path / "walk"
    for name in "abc":
        save(folder / f"{name}.jpg")
    save(folder / ".hidden/masks/a.jpg")
    for name in RESULTS:
        save(folder / name, **({"comment": RENDERED} if name.startswith("frames/") else {}))
    data = (folder / "frames2/00000.png").read_bytes()
    (folder / "frames2/00000.png").write_bytes(data[:33] + b"tEXt" + RENDERED + data[33:])
    for name, text in MARKS.items():
        (folder / name).write_text(text)
    return folder


def test_results_beside_photographs_are_named_and_not_read(photographs: Path) -> None:
    found = recognise(photographs)
    assert (found.format, found.path) == ("photographs", photographs)
    assert find_photos(photographs) == ["a.jpg", "b.jpg", "c.jpg"]
    named = passed_over(photographs)
    assert sum(int(each.rpartition(": ")[2].rstrip(")")) for each in named) == len(RESULTS)
    for name, what in RESULTS.items():
        assert any(each.startswith(name.split("/")[0]) and f"({what}: " in each for each in named), name


def test_files_of_these_names_that_are_something_else(tmp_path: Path) -> None:
    for name, text in (("bundle.json", "{}"), ("config.yml", "iso: 100\n"), ("transforms_eval.json", '{"frames": []}')):
        save(tmp_path / f"{name}-/a.jpg")
        (tmp_path / f"{name}-" / name).write_text(text)
    for name in ("test/rgb/a.jpg", "mixed/eval_img_0001.png", "mixed/train_img_0002.png", "eval/eval_frame_0001.png"):
        save(tmp_path / name)
    assert len(find_photos(tmp_path)) == 7 and passed_over(tmp_path) == []


@pytest.mark.parametrize(("mark", "text", "message"), [
    ("bundle.json", MANIFEST, "is a bundle, not a capture: give the folder of its photographs. `bitymi view"),
    ("config.yml", CONFIG, "is a training run, not a capture: give the folder of its photographs; --load-dir"),
])  # fmt: skip
def test_a_result_is_no_capture(tmp_path: Path, mark: str, text: str, message: str) -> None:
    for name in "abcd":
        save(tmp_path / f"{name}.jpg")
    (tmp_path / mark).write_text(text)
    with pytest.raises(CaptureError, match=message):
        recognise(tmp_path)
    with pytest.raises(CaptureError, match=message):
        find_poses(tmp_path)
    assert len(list(tmp_path.iterdir())) == 5
    (tmp_path / "room.bitymi").write_bytes(b"PK")
    with pytest.raises(CaptureError, match="is a bundle in one file"):
        recognise(tmp_path / "room.bitymi")


def test_a_folder_of_results_alone_says_what_it_holds(photographs: Path) -> None:
    for name in "abc":
        (photographs / f"{name}.jpg").unlink()
    (photographs / "processed/transforms.json").unlink()
    for path in (photographs / "processed").rglob("*.jpg"):
        path.unlink()
    with pytest.raises(CaptureError, match=r"not taken for photographs: compared \(renders of ns-eval: 1\)"):
        recognise(photographs)


def test_a_camera_export_is_no_blender_data_set(tmp_path: Path) -> None:
    save(tmp_path / "images/a.jpg")
    (tmp_path / "poses").mkdir()
    for name in ("transforms_train.json", "transforms_eval.json"):
        (tmp_path / "poses" / name).write_text(json.dumps([{"file_path": "a.jpg", "transform": []}], indent=4))
    assert recognise(tmp_path).format == "photographs"
    assert result_in(tmp_path / "poses")


def test_a_film_of_ours_is_no_video_to_train_on(tmp_path: Path) -> None:
    (tmp_path / "film.mp4").write_bytes(b"ftyp" + RENDERED)
    (tmp_path / "walk.mp4").write_bytes(b"ftyp")
    found = recognise(tmp_path)
    assert (found.path, found.beside) == (tmp_path / "walk.mp4", ())
    assert passed_over(tmp_path) == ["film.mp4 (a film of ns-render)"]


def test_what_converts_poses_of_other_programs(tmp_path: Path) -> None:
    (tmp_path / "Cameras.xml").write_text('<document><chunk><cameras><camera id="0"/></cameras></chunk></document>')
    (tmp_path / "cameras.npz").mkdir()
    command = f"ns-process-data metashape --data {tmp_path} --xml {tmp_path}/Cameras.xml --output-dir NEW"
    assert poses_in(tmp_path) == (f"Cameras.xml (Metashape; `{command}`, which needs the program ffmpeg, converts it)",)


def test_raw_data_beside_photographs_do_not_count(tmp_path: Path) -> None:
    for name in ("a.DNG", "b.dng", "c.nef", "notes.txt"):
        (tmp_path / name).touch()
    save(tmp_path / "a.jpg")
    assert [each.split(" of ")[0] for each in passed_over(tmp_path)] == ["1 .dng", "1 .nef"]


@pytest.mark.parametrize("read", [recognise, find_poses])
def test_a_folder_that_cannot_be_listed_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, read: Callable[[Path], object]
) -> None:
    (tmp_path / "photos").mkdir()
    scandir = os.scandir

    def refused(path: Path) -> object:
        if str(path).endswith("photos"):
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return scandir(path)

    monkeypatch.setattr(os, "scandir", refused)
    with pytest.raises(CaptureError, match=f"{tmp_path / 'photos'} cannot be read: Permission denied"):
        read(tmp_path)
