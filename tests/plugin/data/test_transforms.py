"""Entries of transforms.json beside the poses, valid and invalid."""

import math
from pathlib import Path
from typing import Any

import pytest
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


def test_a_frame_with_a_camera_of_its_own(capture: Path, capsys: pytest.CaptureFixture[str]) -> None:
    edit(capture, lambda meta: meta["frames"][5].update(w=meta["w"], fl_x=meta["fl_x"]))
    load(capture)
    assert "single ones" not in printed(capsys)
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
    message = printed(capsys)
    assert "for all frames and for single ones: those of the frame are used" in message and "w, h, fl_x" in message
    assert len(manager.cached_train) == 10


def set_value(key: str, value: Any) -> Any:
    return lambda meta: meta.update({key: value})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (set_value("camera_model", "BANANA"), "camera_model 'BANANA' of .*_00001.png is unknown.*write PINHOLE"),
        (set_value("applied_transform", [[1, 0], [0, 1]]), "applied_transform is not a matrix of 3 x 4 finite numbers"),
        (set_value("applied_scale", 0), "applied_scale is 0.0, which is no positive number"),
        (set_value("w", "48px"), "w for all frames is '48px', which is no number"),
        (set_value("w", 48.5), "w for all frames is 48.5, which is no number of pixels"),
        (set_value("w", 1e30), r"w for all frames is 1e\+30, which is no number of pixels"),
        (set_value("fl_x", True), "fl_x for all frames is True, which is no number"),
        (set_value("fl_x", 1e9), r"focal length of .*frame_00002.png.* 1e\+09 pixels \(fl_x\).*not in millimetres"),
        (set_value("fl_y", 0.1), r"focal length of .*frame_00002.png.* 0.1 pixels \(fl_y\).*span 179 degrees"),
        (set_value("test_filenames", "a.png"), "test_filenames is 'a.png', not a list of names"),
        (set_value("train_filenames", []), "has train_filenames, but a split needs .*val_filenames.*remove the lists"),
        (set_value("test_filenames", []), "has test_filenames, but a split needs train_filenames and val_filenames"),
        (set_value("cx", None), "gives no cx for images/frame_00001.png"),
        (set_value("k1", [0.1]), r"k1 of images/frame_00001.png is \[0.1\], which is no number"),
        (set_value("cx", 5e5), "frame_00002.png cannot be used: its principal point is so far .* 80 degrees off"),
        (set_value("k4", 0.1), "camera of images/frame_00001.png .*cannot be used: its k4 is 0.1.*image_undistorter"),
        (set_value("distortion_params", [0.1, 0.0]), "has 2 distortion_params; perspective cameras need six"),
        (set_value("camera_model", "EQUIRECTANGULAR"), "EQUIRECTANGULAR, but .*: pictures of all .* are twice as wide"),
        (set_value("camera_model", "ORTHOPHOTO"), "neither a perspective, a fisheye nor an equirectangular camera"),
        (set_value("fl_x", -30.0), "camera of images/frame_00001.png .* cannot be used: its size and focal"),
        (set_value("fl_y", float("inf")), "cannot be used: its size and focal lengths have to be positive and all"),
        (set_value("cx", float("nan")), "cannot be used: .* all parameters finite"),
        (set_value("w", 0), "w for all frames is 0, which is no number of pixels"),
        (lambda meta: meta["frames"].clear(), "lists no frames"),
        (lambda meta: meta.pop("fl_x"), "gives no fl_x for images/frame_00001.png, .* and 9 more: .*Add it once"),
        (set_value("ply_file_path", "gone.ply"), "point cloud .*gone.ply does not exist.*remove ply_file_path"),
        (lambda meta: meta["frames"][3].update(transform_matrix="here"), "frame_00004.png is not a matrix of 4 x 4"),
        (lambda meta: meta["frames"][3]["transform_matrix"][0].__setitem__(3, math.nan), "_00004.png is not a matrix"),
        (set_value("ply_file_path", 7), "ply_file_path is 7, not the name of a file"),
        (lambda meta: meta["frames"][2].update(file_path=7), "the file_path of frame 2 is 7, not the name of a file"),
        (
            lambda meta: meta["frames"][2].update(file_path="a/.."),
            "file_path of frame 2 is 'a/..', not the name of a file",
        ),
        (
            lambda meta: meta["frames"][2].update(mask_path="\\\\"),
            r"mask_path of frame 2 is '.*', not the name of a file",
        ),
        (lambda meta: meta["frames"][2].update(file_path="a" * 300), r"1 of 12 photographs .* missing:\s+.*/aaa"),
        (set_value("ply_file_path", "a" * 300), "the point cloud .*/aaa.* does not exist"),
        (lambda meta: meta["frames"][2].update(h="tall"), "h of images/frame_00003.png is 'tall', which is no number"),
        (
            lambda meta: [f.update(w=meta["w"]) for f in meta["frames"][1:]] and meta.pop("w"),
            "gives no w for images/frame_00001.png: .*at the top of the file, or to each frame",
        ),
        (
            lambda meta: meta["frames"][5].update(file_path="./" + meta["frames"][3]["file_path"]),
            r"frames 3 and 5 \(counted from 0\) are both of images/frame_00004.png, but with different poses",
        ),
        (
            set_value("applied_transform", [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 0]]),
            "transforms.json: applied_transform maps the capture to a plane, .*remove it: then exports are",
        ),
        (
            lambda meta: [f.update(mask_path=f"/home/me/masks/{f['file_path']}") for f in meta["frames"]],
            "12 of 12 masks .* are missing: /home/me/masks/images/frame_",
        ),
        (lambda meta: meta["frames"].insert(1, {"file_path": "a.png"}), "frame 1 .* has no transform_matrix. Add that"),
        (lambda meta: meta["frames"].__setitem__(1, None), "frame 1 .* has no file_path and no transform_matrix"),
        (
            lambda meta: meta.update(frames=dict(enumerate(meta["frames"]))),
            "frames is an object with names, not a list",
        ),
    ],
)
def test_entries_that_cannot_be_used_are_named(capture: Path, change: Any, message: str) -> None:
    edit(capture, change)
    with expect(message):
        load(capture)


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


@pytest.mark.parametrize("change", [lambda text: f"// by hand\n{text}", lambda text: f"{text.rstrip()[:-1]},}}"])
def test_what_is_no_json_is_to_be_corrected(capture: Path, change: Any) -> None:
    path = capture / "transforms.json"
    path.write_text(change(path.read_text("utf8")), "utf8")
    with expect(r"transforms.json cannot be read: Expecting .*line \d+ .*Correct it there \(JSON has neither comments"):
        load_any(capture)


@pytest.mark.parametrize("name", ["points\\Cloud.ply", "/home/me/room/points/cloud.ply", "C:\\room\\CLOUD.PLY"])
def test_a_point_cloud_by_its_name_on_another_machine(capture: Path, name: str) -> None:
    (capture / "points").mkdir()
    (capture / "sparse_pc.ply").rename(capture / "points/cloud.ply")
    edit(capture, lambda meta: meta.update(ply_file_path=name))
    if "points" in name:
        assert len(load_any(capture).train_dataset.metadata["points3D_xyz"]) == 200
    else:  # it is in no such folder
        with expect("the point cloud .* does not exist"):
            load_any(capture)


@pytest.mark.parametrize("place", ["masks\\", "/home/me/room/masks/", "D:\\room\\Masks\\"])
def test_masks_by_their_names_on_another_machine(capture: Path, place: str) -> None:
    save_masks(capture, lambda i: 255 if i else 0)
    edit_frames(capture, lambda frame: frame.update(mask_path=f"{place}{Path(frame['file_path']).stem}.PNG"))
    manager = load_any(capture)
    assert manager.train_dataset.get_data(0)["mask"].all()
    assert len(manager.eval_dataset) == 1  # the mask of the first photograph, which is held out, is black
