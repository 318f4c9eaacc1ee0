"""What stands in transforms.json beside poses, well meant or not."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import pytest
import torch
from nerfstudio.data.dataparsers import nerfstudio_dataparser
from nerfstudio.data.dataparsers.instant_ngp_dataparser import InstantNGPDataParserConfig
from PIL import Image

from bitymi_ns.capture.recognise import recognise
from bitymi_ns.plugin.console import InputError, say, warn
from bitymi_ns.plugin.data import point_cloud
from bitymi_ns.plugin.data.cameras import check_cameras
from tests.plugin.data.captures import expect, images_of, load, load_any, load_with, said
from tests.plugin.data.test_cameras import cameras


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
    assert "a\\x1b[2Jb [red]" in (text := said(capsys)) and "\\x9b" in text and "\x9b" not in text
    assert str(InputError("\x1b]0;x\x07")) == "bitymi: \\x1b]0;x\\x07"


def test_photographs_outside_of_the_folder_are_named(
    capture: Path, edit: Any, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    picture = images_of(capture)[3]
    picture.rename(tmp_path / "elsewhere.png")
    edit(capture, lambda meta: meta["frames"][3].update(file_path=str(tmp_path / "elsewhere.png")))
    load(capture)
    assert f"pictures outside of its folder, which are read there: {tmp_path}/elsewhere.png." in said(capsys)


def test_nerfstudios_reader_is_left_as_it_was(capture: Path) -> None:
    before = nerfstudio_dataparser.load_from_json
    load(capture)
    (capture / "transforms.json").write_text("{")
    with expect("cannot be read"):
        load(capture)
    assert nerfstudio_dataparser.load_from_json is before


def test_a_frame_with_a_camera_of_its_own(capture: Path, edit: Any, capsys: pytest.CaptureFixture[str]) -> None:
    path = images_of(capture)[5]
    Image.open(path).resize((96, 72)).save(path)
    own = {"w": 96, "h": 72, "fl_x": 80.0, "fl_y": 81.0, "cx": 48.0, "cy": 36.0, "k1": 0.01}
    edit(capture, lambda meta: meta["frames"][5].update(own))
    manager = load(capture)
    train = manager.train_dataset
    index = train.image_filenames.index(path)
    assert [int(train.cameras.width[i]) for i in (index, index - 1)] == [96, 48]
    assert float(train.cameras.fy[index]) == 81.0 and float(train.cameras.fy[index - 1]) != 81.0
    assert [float(train.cameras.distortion_params[i, 0]) for i in (index, index - 1)] == [pytest.approx(0.01), 0.0]
    message = said(capsys)
    assert "for all frames and for single ones: those of the frame are used" in message and "w, h, fl_x" in message
    assert len(manager.cached_train) == 10


def test_equal_numbers_in_frames_are_nothing_to_speak_of(
    capture: Path, edit: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    edit(capture, lambda meta: meta["frames"][5].update(w=meta["w"], fl_x=meta["fl_x"]))
    load(capture)
    assert "single ones" not in said(capsys)


def set_value(key: str, value: Any) -> Any:
    return lambda meta: meta.update({key: value})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (set_value("camera_model", "BANANA"), "camera_model 'BANANA' is unknown.*OPENCV.*write PINHOLE"),
        (set_value("applied_transform", [[1, 0], [0, 1]]), "applied_transform is not a matrix of 3 x 4 finite numbers"),
        (set_value("applied_scale", 0), "applied_scale is 0.0, which is no positive number"),
        (set_value("w", "48px"), "w for all frames is '48px', which is no number"),
        (set_value("w", 48.5), "w for all frames is 48.5, which is no number of pixels"),
        (set_value("w", 1e30), r"w for all frames is 1e\+30, which is no number of pixels"),
        (set_value("fl_x", True), "fl_x for all frames is True, which is no number"),
        (set_value("fl_x", 1e9), r"focal length of .*frame_00002.png.* 1e\+09 pixels \(fl_x\).*not in millimetres"),
        (set_value("fl_y", 0.1), r"focal length of .*frame_00002.png.* 0.1 pixels \(fl_y\).*span 179 degrees"),
        (set_value("train_filenames", None), "train_filenames is None, not a list of names. Correct it or remove it"),
        (set_value("test_filenames", "a.png"), "test_filenames is 'a.png', not a list of names"),
        (set_value("train_filenames", []), "has train_filenames, but a split needs .*val_filenames.*remove the lists"),
        (set_value("test_filenames", []), "has test_filenames, but a split needs train_filenames and val_filenames"),
        (set_value("cx", None), "cx for all frames is None, which is no number"),
        (set_value("k1", [0.1]), r"k1 for all frames is \[0.1\], which is no number"),
        (set_value("cx", 5e5), "frame_00002.png cannot be used: its principal point is so far .* 80 degrees off"),
        (set_value("k4", 0.1), "frame_00002.png.* cannot be used: its k4 is 0.1.*image_undistorter"),
        (set_value("k1", -5.0), "lens distortion of .*frame_00002.png.* is absurd: with k1 = -5 .* leave 0 %"),
        (lambda meta: meta.update(k1=-5, k2=20), "absurd: with k1 = -5, k2 = 20 .* would leave 2.. %.*one coefficient"),
        (set_value("distortion_params", [0.1, 0.0]), "cameras have 2 distortion_params; perspective cameras need six"),
        (set_value("camera_model", "EQUIRECTANGULAR"), "neither a perspective nor a fisheye camera"),
        (set_value("camera_model", "OPENCV_FISHEYE"), "a fisheye camera without coefficients"),
        (set_value("ply_file_path", 7), "ply_file_path is 7, not the name of a file"),
        (lambda meta: meta["frames"][2].update(file_path=7), "the file_path of frame 2 is 7, not the name of a file"),
        (lambda meta: meta["frames"][2].update(h="tall"), "h of images/frame_00003.png is 'tall', which is no number"),
        (
            lambda meta: [meta.pop("fl_x"), meta.update(camera_angle_x=1.0)],
            "gives no fl_x .*camera_angle_x.*instant-ngp-data --data",
        ),
        (
            lambda meta: [f.update(w=meta["w"]) for f in meta["frames"][1:]] and meta.pop("w"),
            "gives no w for images/frame_00001.png: .*at the top of the file, or to each frame",
        ),
    ],
)
def test_entries_that_cannot_be_used_are_named(capture: Path, edit: Any, change: Any, message: str) -> None:
    edit(capture, change)
    with expect(message):
        load(capture)


def test_numbers_in_quotes(capture: Path, edit: Any) -> None:
    edit(capture, lambda meta: meta.update(w="48.0", h=36.0, fl_x=str(meta["fl_x"])))
    assert len(load(capture).cached_train) == 10


def test_names_of_files(capture: Path, edit: Any) -> None:
    def rename(change: Any) -> None:
        def apply(meta: dict[str, Any]) -> None:
            for frame in meta["frames"]:
                frame["file_path"] = change(capture / frame["file_path"])

        edit(capture, apply)

    def moved(path: Path) -> str:
        path.rename(path.with_name(f"фото № {path.name}"))
        return f"images/фото № {path.name}"

    rename(lambda path: f"images\\{path.name}")
    assert len(load(capture).train_dataset) == 10
    edit(capture, lambda meta: [f.update(file_path=f["file_path"].replace("\\", "/")) for f in meta["frames"]])
    rename(moved)
    assert len(load(capture).cached_train) == 10
    rename(lambda path: str(path.absolute()))
    assert len(load(capture).train_dataset) == 10


def test_a_missing_photograph_of_nearly_that_name(capture: Path) -> None:
    paths = images_of(capture)
    paths[3].rename(paths[3].with_suffix(".PNG"))
    paths[4].unlink()
    paths[4].symlink_to("nowhere.png")
    with expect(
        r"(?s)2 of 12 .*frame_00004.png \(but there is frame_00004.PNG\)\s+.*frame_00005.png \(a link to nothing\)"
    ):
        load(capture)


def test_photographs_that_pil_does_not_know(capture: Path, edit: Any) -> None:
    for path in images_of(capture):
        path.with_suffix(".heic").write_bytes(b"\0\0\0\x18ftypheic" + bytes(99))
    edit(capture, lambda meta: [f.update(file_path=f["file_path"][:-3] + "heic") for f in meta["frames"]])
    with expect("cannot identify image file.*heic.*Save the photographs as PNG or JPEG"):
        load(capture)


def test_photographs_without_poses(capture: Path) -> None:
    for name in ("transforms.json", "sparse_pc.ply"):
        (capture / name).unlink()
    with expect("photographs without poses. Find the poses with `ns-process-data images --data .*images --output-dir"):
        load(capture)
    (capture / "transforms_train.json").write_text("{}")
    with expect("transforms_train.json: give `blender-data --data"):
        load(capture)


def test_one_view_that_instant_ngps_reader_loses(capture: Path) -> None:
    with expect("fails on a split with a single photograph.*--eval-mode interval"):
        load_with(capture, InstantNGPDataParserConfig())


def test_fisheye_photographs_are_perspective_ones_once_undistorted(capture: Path, edit: Any) -> None:
    edit(capture, lambda meta: meta.update(camera_model="OPENCV_FISHEYE", k1=0.01))
    manager = load(capture)
    _ = manager.cached_train
    assert manager.train_view(0)[0].camera_type.unique().tolist() == [1]


def test_lens_distortion_that_leaves_little_is_doubted(capsys: pytest.CaptureFixture[str]) -> None:
    c2w, none = torch.eye(4)[:3].repeat(2, 1, 1), torch.zeros(2, 6)
    real = torch.tensor([-0.25, 0.08, 0.0, 0.0, 1e-3, -1e-3]).repeat(2, 1)  # of a wide lens
    for distortion in (none, real):
        check_cameras(cameras(camera_to_worlds=c2w, distortion_params=distortion), ["a.png", "b.png"])
    assert said(capsys) == ""
    strong = none.clone()
    strong[1, 0] = 20.0
    check_cameras(cameras(camera_to_worlds=c2w, distortion_params=strong), ["a.png", "b.png"])
    message = said(capsys)
    assert "Undistorting leaves only" in message and "% of b.png (k1 = 20)" in message


def test_large_clouds_are_announced_and_timed(
    capture: Path, edit: Any, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    load(capture)
    assert "Reading" not in said(capsys)
    monkeypatch.setattr(point_cloud, "MANY_POINTS", 200)
    load(capture)
    message = said(capsys)
    assert "Reading 200 points. This may take minutes." in message and "Reading 200 points took" in message


def test_points_are_counted_before_they_are_read(tmp_path: Path) -> None:
    (tmp_path / "points3D.bin").write_bytes(struct.pack("<Q", 5_000_000))
    (tmp_path / "points3D.txt").write_text("# 3D point list\n# Number of points: 123, mean track length: 3\n")
    (tmp_path / "a.ply").write_text("ply\nformat ascii 1.0\nelement vertex 7\nend_header\n")
    (tmp_path / "b.ply").write_text(json.dumps({}))
    counts = [point_cloud.point_count(tmp_path / n) for n in ("points3D.bin", "points3D.txt", "a.ply", "b.ply", "gone")]
    assert counts == [5_000_000, 123, 7, 0, 0]


def test_doubtful_focal_lengths_are_said(capture: Path, edit: Any, capsys: pytest.CaptureFixture[str]) -> None:
    load(capture)
    assert "focal length" not in said(capsys)
    edit(capture, lambda meta: meta.update(fl_x=4.2))
    load(capture)
    message = said(capsys)
    assert (
        message.count("The focal length of") == 1
        and "is 4.2 pixels (fl_x): 48 pixels of the picture span 160 deg" in message
    )


def test_one_photograph_with_two_poses(capture: Path, edit: Any) -> None:
    edit(capture, lambda meta: meta["frames"][5].update(file_path="./" + meta["frames"][3]["file_path"]))
    with expect(r"frames 3 and 5 \(counted from 0\) are both of images/frame_00004.png, but with different poses"):
        load(capture)


@pytest.mark.parametrize("given", ["val_filenames", "test_filenames"])
def test_lists_of_two_splits_are_enough(capture: Path, edit: Any, given: str) -> None:
    names = [f"images/{path.name}" for path in images_of(capture)]
    edit(capture, lambda meta: meta.update({"train_filenames": names[2:], given: names[:2]}))
    manager = load(capture)
    assert [path.name for path in manager.eval_dataset.image_filenames] == ["frame_00001.png", "frame_00002.png"]
    assert len(manager.train_dataset) == 10


def test_null_is_what_a_capture_does_not_have(capture: Path, edit: Any) -> None:
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


def test_a_transform_that_cannot_be_undone(capture: Path, edit: Any) -> None:
    flat = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 0]]
    edit(capture, lambda meta: meta.update(applied_transform=flat))
    with expect("transforms.json: applied_transform maps the capture to a plane, .*remove it: then exports are"):
        load_any(capture)


@pytest.mark.parametrize("change", [lambda text: f"// by hand\n{text}", lambda text: f"{text.rstrip()[:-1]},}}"])
def test_what_is_no_json_is_to_be_corrected(capture: Path, change: Any) -> None:
    path = capture / "transforms.json"
    path.write_text(change(path.read_text("utf8")), "utf8")
    with expect(r"transforms.json cannot be read: Expecting .*line \d+ .*Correct it there \(JSON has neither comments"):
        load_any(capture)


@pytest.mark.parametrize("name", ["points\\Cloud.ply", "/home/me/room/points/cloud.ply", "C:\\room\\CLOUD.PLY"])
def test_a_point_cloud_by_its_name_on_another_machine(capture: Path, edit: Any, name: str) -> None:
    (capture / "points").mkdir()
    (capture / "sparse_pc.ply").rename(capture / "points/cloud.ply")
    edit(capture, lambda meta: meta.update(ply_file_path=name))
    if "points" in name:
        assert len(load_any(capture).train_dataset.metadata["points3D_xyz"]) == 200
    else:  # it is in no such folder
        with expect("the point cloud .* does not exist"):
            load_any(capture)


@pytest.mark.parametrize("place", ["masks\\", "/home/me/room/masks/", "D:\\room\\Masks\\"])
def test_masks_by_their_names_on_another_machine(capture: Path, edit: Any, place: str) -> None:
    (capture / "masks").mkdir()
    for i, image in enumerate(images_of(capture)):
        Image.new("L", (48, 36), 255 if i else 0).save(capture / "masks" / f"{image.stem}.png")

    def change(meta: dict[str, Any]) -> None:
        for frame in meta["frames"]:
            frame["mask_path"] = f"{place}{Path(frame['file_path']).stem}.PNG"

    edit(capture, change)
    manager = load_any(capture)
    assert manager.train_dataset.get_data(0)["mask"].all()
    assert len(manager.eval_dataset) == 1  # the mask of the first photograph, which is held out, is black


def test_a_photograph_is_no_mask(capture: Path, edit: Any) -> None:
    def change(meta: dict[str, Any]) -> None:
        for frame in meta["frames"]:
            frame["mask_path"] = f"/home/me/masks/{frame['file_path']}"

    edit(capture, change)
    with expect("the mask /home/me/masks/images/frame_.* is missing"):
        load_any(capture)


def test_frames_that_are_none(capture: Path, edit: Any) -> None:
    edit(capture, lambda meta: meta["frames"].insert(1, {"file_path": "images/a.png"}))
    with expect("frame 1 .counted from 0. has no transform_matrix. Add that or remove the frame"):
        load_any(capture)
    edit(capture, lambda meta: meta["frames"].__setitem__(1, None))
    with expect("frame 1 .* has no file_path and no transform_matrix"):
        load_any(capture)
    edit(capture, lambda meta: meta.update(frames=dict(enumerate(meta["frames"]))))
    with expect("frames is an object with names, not a list"):
        load_any(capture)
