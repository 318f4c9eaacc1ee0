"""Captures with photographs of wide cameras, some or all."""

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from PIL import Image

from bitymi_ns.capture.lens import FACES
from bitymi_ns.plugin.data.facts import CaptureFacts
from bitymi_ns.plugin.data.views import with_lenses
from tests.captures import as_binary, colmap_model, edit, edit_frames, expect, held_out, images_of, load_any, printed
from tests.typed import Printed

SIZE = (96, 48)


def panoramas(capture: Path, count: int) -> list[str]:
    """Turn the first photographs into panoramas; returns their names."""
    names = [file.name for file in images_of(capture)[:count]]
    for i, name in enumerate(names):
        noise = np.random.default_rng(i).integers(0, 255, (*SIZE[::-1], 3), np.uint8)
        Image.fromarray(noise).save(capture / "images" / name)
    camera = dict(camera_model="EQUIRECTANGULAR", w=SIZE[0], h=SIZE[1], cx=SIZE[0] / 2, cy=SIZE[1] / 2)
    edit_frames(capture, lambda frame: Path(frame["file_path"]).name in names and frame.update(camera))
    return names


def test_a_capture_of_both_kinds(capture: Path, capsys: Printed) -> None:
    names = panoramas(capture, 3)
    manager = load_any(capture, eval_interval=2)
    said = printed(capsys)
    assert "is EQUIRECTANGULAR: its photographs become pinhole pictures (front 31 x 31" in said
    count = len(images_of(capture))
    assert f"Held out for evaluation: {(count + 1) // 2} of {count} photographs" in said
    held_out, train = manager.eval_dataset, manager.train_dataset
    stem = Path(names[0]).stem
    assert [path.name for path in held_out.image_filenames[:6]] == [f"{stem}-{face}.png" for face in FACES]
    assert not set(held_out.facts.files) & set(train.facts.files)
    assert {path.name for path in train.facts.files} & set(names) == {names[1]}
    assert len(set(train.facts.files[:6])) == 1 and train.facts.files[6] != train.facts.files[5]
    assert len(held_out) == (count + 1) // 2 + 10 and manager.eval_view(0)[1]["image"].shape == (31, 31, 3)
    poses = held_out.cameras.camera_to_worlds[:6]
    assert torch.allclose(poses[:, :, 3], poses[:1, :, 3].expand(6, 3))
    assert torch.allclose(poses[0, :, 2], -poses[2, :, 2], atol=1e-6)  # front and back


def test_only_panoramas_need_no_focal_length(capture: Path) -> None:
    panoramas(capture, len(images_of(capture)))
    edit(capture, lambda meta: [meta.pop(key, None) for key in ("fl_x", "fl_y", "cx", "cy", "w", "h")])
    manager = load_any(capture)
    assert len(manager.eval_dataset) == 6 * ((len(images_of(capture)) + 7) // 8)


def test_a_mask_goes_with_each_face_and_a_face_without_pixels_is_left_out(capture: Path, capsys: Printed) -> None:
    count = len(images_of(capture))
    panoramas(capture, count)
    mask = np.full(SIZE[::-1], 255, np.uint8)
    mask[30:] = 0  # the whole bottom face, and parts of those around it
    Image.fromarray(mask).save(capture / "mask.png")
    edit_frames(capture, lambda frame: frame.update(mask_path="mask.png"))
    manager = load_any(capture)
    assert "These views are left out" in printed(capsys)
    files = manager.train_dataset.facts.files
    assert len(files) == 5 * (count - 2) and len(set(files)) == count - 2
    assert not any(path.stem.endswith("down") for path in manager.train_dataset.image_filenames)
    front = manager.train_view(0)[1]["mask"][..., 0]
    assert front[: len(front) // 2].all() and not front[-5:].any()


def test_a_wide_fisheye_among_others(capture: Path) -> None:
    first = images_of(capture)[1]
    Image.new("RGB", (60, 60), (200, 50, 20)).save(first)
    camera = dict(camera_model="OPENCV_FISHEYE", w=60, h=60, fl_x=19.0, fl_y=19.0, cx=30.0, cy=30.0)
    edit_frames(capture, lambda frame: Path(frame["file_path"]).name == first.name and frame.update(camera))
    manager = load_any(capture)
    names = [path.name for path in manager.train_dataset.image_filenames[:6]]
    assert names[:5] == [f"{first.stem}-{face}.png" for face in ("front", "right", "left", "up", "down")]
    assert "mask" not in manager.train_view(5)[1]
    assert all(manager.train_view(i)[1]["image"].float().std((0, 1)).max() == 0 for i in range(5))


def test_a_colmap_model_of_panoramas(capture: Path) -> None:
    for file in images_of(capture):
        Image.new("RGB", SIZE).save(file)
    colmap_model(capture, capture / "sparse/0")
    (capture / "sparse/0/cameras.txt").write_text("1 EQUIRECTANGULAR 96 48 96 48\n")
    (capture / "transforms.json").unlink()
    manager = load_any(capture)
    assert len(manager.eval_dataset) == 6 * ((len(images_of(capture)) + 7) // 8)


def test_views_of_another_parser_are_split_too(capture: Path) -> None:
    panoramas(capture, len(images_of(capture)))
    pixels = {"w": SIZE[0], "h": SIZE[1], "fl_x": SIZE[0] / 2, "fl_y": SIZE[1], "cx": SIZE[0] / 2, "cy": SIZE[1] / 2}
    edit(capture, lambda meta: meta.update(pixels, camera_model="EQUIRECTANGULAR"))
    stock = NerfstudioDataParserConfig(data=capture).setup().get_dataparser_outputs("train")
    outputs = with_lenses(stock)
    assert len(outputs.image_filenames) == 6 * len(stock.image_filenames) == len(outputs.cameras)
    assert CaptureFacts.of(outputs.metadata).files[:6] == [stock.image_filenames[0]] * 6
    assert torch.allclose(outputs.cameras.camera_to_worlds[0], stock.cameras.camera_to_worlds[0])


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ({"cx": 10.0}, "is EQUIRECTANGULAR, but its cx and cy are 10 and 24, not the middle of its 96 x 48 pixels"),
        ({"w": 192, "h": 96, "cx": 96.0, "cy": 48.0}, "has 96 x 48 pixels, but the camera of .* is for 192 x 96"),
    ],
)
def test_panoramas_that_cannot_be_used(capture: Path, entries: dict[str, Any], message: str) -> None:
    panoramas(capture, 3)
    edit(capture, lambda meta: meta["frames"][1].update({"cy": 24.0} | entries))
    with expect(message):
        _ = load_any(capture).cached_train


def rig_of_two(project: Path, form: str) -> None:
    """Declare pairs of photographs (1 and 2, 3 and 4, ...) of a COLMAP project as taken together."""
    count = len(images_of(project))
    model = project / "sparse/0"
    if form == "txt":
        rows = [f"{i + 1} 1 1 0 0 0 0 0 0 2 CAMERA 1 {2 * i + 1} CAMERA 2 {2 * i + 2}\n" for i in range(count // 2)]
        (model / "frames.txt").write_text("# frames\n" + "".join(rows))
        return
    as_binary(model)
    data = struct.pack("<Q", count // 2)
    for i in range(count // 2):
        data += struct.pack("<II7dI", i + 1, 1, 1.0, *[0.0] * 6, 2)
        data += struct.pack("<iIQiIQ", 0, 1, 2 * i + 1, 0, 2, 2 * i + 2)
    (model / "frames.bin").write_bytes(data)


@pytest.mark.parametrize("form", ["txt", "bin"])
def test_what_a_rig_took_together_is_held_out_together(project: Path, form: str, capsys: Printed) -> None:
    rig_of_two(project, form)
    names = [path.name for path in images_of(project)]
    manager = load_any(project, eval_interval=4)
    assert held_out(manager) == names[0:2] + names[8:10]
    assert f"Held out for evaluation: 4 of {len(names)} photographs" in printed(capsys)
    manager = load_any(project, eval_names=(names[3],))
    assert held_out(manager) == names[2:4]
    assert len(manager.train_dataset) == len(names) - 2
    manager = load_any(project, eval_mode="all")
    assert len(manager.train_dataset) == len(manager.eval_dataset) == len(names)


def test_damaged_frames_are_named(project: Path) -> None:
    rig_of_two(project, "txt")
    path = project / "sparse/0/frames.txt"
    path.write_text(path.read_text().replace("CAMERA 2 2", "CAMERA 2"))
    with expect("frames.txt cannot be read: frame 1 states 2 images"):
        load_any(project)
    path.unlink()
    rig_of_two(project, "bin")
    path = path.with_suffix(".bin")
    path.write_bytes(path.read_bytes()[:-4])
    with expect("frames.bin cannot be read: .*It is cut off or damaged"):
        load_any(project)
