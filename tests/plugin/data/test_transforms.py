"""Entries of transforms.json beside the poses, valid and invalid."""

from pathlib import Path
from typing import Any

import pytest
import torch
from nerfstudio.data.dataparsers.instant_ngp_dataparser import InstantNGPDataParserConfig
from PIL import Image

from bitymi_ns.capture.recognise import recognise
from bitymi_ns.plugin.console import InputError, say, warn
from tests.captures import (
    edit,
    edit_frames,
    expect,
    held_out,
    images_of,
    load,
    load_any,
    load_with,
    printed,
    save_masks,
)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_a_byte_order_mark(capture: Path, encoding: str) -> None:
    path = capture / "transforms.json"
    path.write_text(path.read_text("utf8"), encoding)
    assert len(load(capture).train_dataset) == 10
    ngp = InstantNGPDataParserConfig(eval_mode="interval")
    assert len(load_with(capture, ngp).train_dataset) == 10


@pytest.mark.parametrize("text", ["[" * 100_000, '{"frames": ' + "[" * 500 + "]" * 500 + "}"])
def test_a_file_that_is_nested_too_deeply(capture: Path, text: str) -> None:
    (capture / "transforms.json").write_text(text)
    with expect("transforms.json cannot be read: it is nested too deeply"):
        load(capture)
    assert recognise(capture).format == "nerfstudio"


def test_names_do_not_control_the_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    say("a\x1b[2Jb [red]")
    warn("\x9b")
    assert "a\\x1b[2Jb [red]" in (text := printed(capsys)) and "\\x9b" in text and "\x9b" not in text
    assert str(InputError("\x1b]0;x\x07")) == "bitymi: \\x1b]0;x\\x07"


def test_a_name_as_long_as_the_system_allows(capture: Path) -> None:
    path = images_of(capture)[0]
    named = path.rename(path.with_name("a" * 251 + ".png"))
    edit(capture, lambda meta: meta["frames"][0].update(file_path=f"images/{named.name}"))
    save_masks(capture, 255)
    assert "mask" in load(capture).cached_train[0]


def test_a_frame_with_a_camera_of_its_own(capture: Path) -> None:
    path = images_of(capture)[5]
    Image.open(path).resize((96, 72)).save(path)
    own = {"w": 96, "h": 72, "fl_x": 80.0, "fl_y": 81.0, "cx": 48.0, "cy": 36.0, "k1": 0.01}
    edit(capture, lambda meta: meta["frames"][5].update(own))
    manager = load(capture)
    train = manager.train_dataset
    index = train.image_filenames.index(path)
    assert train.metadata["lenses"][index].camera.size == (96, 72) and int(train.cameras.width[index - 1]) == 48
    assert float(train.cameras.fy[index]) == 81.0 and float(train.cameras.fy[index - 1]) != 81.0
    assert [lens.distorts for lens in train.metadata["lenses"][index - 1 : index + 1]] == [False, True]
    assert len(manager.cached_train) == 10


def test_a_camera_matrix_and_the_size_of_the_picture(capture: Path) -> None:
    """NeuS2's matrices of 4 x 4; whatever a file leaves out is that of the picture, its middle, or of square pixels."""
    before = load(capture).train_dataset.cameras

    def change(meta: dict[str, Any]) -> None:
        fx, cy, *_ = (meta.pop(key) for key in ("fl_x", "cy", "fl_y", "cx", "w", "h"))
        for i, frame in enumerate(meta["frames"]):
            frame.update({"intrinsic_matrix": [[fx, 0, 24], [0, fx, cy], [0, 0, 1]]} if i % 2 else {"fl_y": fx})

    edit(capture, change)
    after = load(capture).train_dataset.cameras
    for name in ("fx", "fy", "cx", "cy", "width", "height"):
        assert torch.equal(getattr(before, name), getattr(after, name))


def test_numbers_in_quotes(capture: Path) -> None:
    edit(capture, lambda meta: meta.update(w="48.0", h=36.0, fl_x=str(meta["fl_x"])))
    assert len(load(capture).cached_train) == 10


def test_doubtful_focal_lengths_are_said(capture: Path, capsys: pytest.CaptureFixture[str]) -> None:
    load(capture)
    assert "focal length" not in printed(capsys)
    edit(capture, lambda meta: meta.update(fl_x=4.2))
    load(capture)
    message = printed(capsys)
    assert message.count("The focal length of") == 1
    assert "is 4.2 pixels (fl_x): 48 pixels of the picture span 160 deg" in message


@pytest.mark.parametrize("given", ["val_filenames", "test_filenames"])
def test_lists_of_two_splits_are_enough(capture: Path, given: str) -> None:
    names = [f"images/{path.name}" for path in images_of(capture)]
    edit(capture, lambda meta: meta.update({"train_filenames": names[2:], given: names[:2]}))
    manager = load(capture)
    assert held_out(manager) == ["frame_00001.png", "frame_00002.png"]
    assert len(manager.train_dataset) == 10


def test_null_is_what_a_capture_does_not_have(capture: Path) -> None:
    def change(meta: dict[str, Any]) -> None:
        meta.update(applied_transform=None, applied_scale=None, orientation_override=None, distortion_params=None)
        for i, frame in enumerate(meta["frames"]):
            frame.update(mask_path="" if i else None, depth_file_path=None)

    edit(capture, change)
    for read in (load, load_any):
        manager = read(capture)
        assert len(manager.train_dataset) == 10 and "mask" not in manager.train_dataset.get_data(0)
    edit(capture, lambda meta: meta.update(ply_file_path=None))
    assert "points3D_xyz" not in load_any(capture).train_dataset.metadata


@pytest.mark.parametrize("name", ["points\\Cloud.ply", "/home/me/room/points/cloud.ply", "C:\\room\\CLOUD.PLY"])
def test_a_point_cloud_by_its_name_on_another_machine(capture: Path, name: str) -> None:
    (capture / "points").mkdir()
    (capture / "sparse_pc.ply").rename(capture / "points/cloud.ply")
    edit(capture, lambda meta: meta.update(ply_file_path=name))
    if "points" in name:
        assert len(load_any(capture).train_dataset.metadata["points3D_xyz"]) == 200
    else:  # it is in no such folder
        with expect("the point cloud .* cannot be read: it does not exist"):
            load_any(capture)


@pytest.mark.parametrize("place", ["masks\\", "/home/me/room/masks/", "D:\\room\\Masks\\"])
def test_masks_by_their_names_on_another_machine(capture: Path, place: str) -> None:
    save_masks(capture, lambda i: 255 if i else 0)
    edit_frames(capture, lambda frame: frame.update(mask_path=f"{place}{Path(frame['file_path']).stem}.PNG"))
    manager = load_any(capture)
    assert manager.train_dataset.get_data(0)["mask"].all()
    assert len(manager.eval_dataset) == 1  # the mask of the first photograph, which is held out, is black
