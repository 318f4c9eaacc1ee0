"""A defect of a capture ends in one line that names it: a table of formats and defects; and a table of what makes no
difference."""

import json
import math
import re
import shutil
import unicodedata
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from tests.captures import as_binary, edit, edit_frames, expect, images_of, load_any, printed
from tests.formats import (
    JSON,
    PHOTOGRAPHS,
    blender,
    colmap,
    instant_ngp,
    nerfstudio,
    polycam,
    record3d,
    scanner_app,
    scannet,
    stray_scanner,
)  # fmt: skip

HUGE = 10**400
Change = Callable[[Path], Any]
"""Damages a file of a capture, or its folder."""


def entries(**values: Any) -> Change:
    """Set entries of a JSON file."""
    return lambda path: edit(path, lambda meta: meta.update(values))


def entry(change: Callable[[dict[str, Any]], Any]) -> Change:
    """Change a JSON file."""
    return lambda path: edit(path, change)


def frame(i: int, **values: Any) -> Change:
    """Set entries of a frame."""
    return lambda path: edit(path, lambda meta: meta["frames"][i].update(values))


def pose(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    """Change the 3 x 3 part of the fourth pose."""

    def apply(meta: dict[str, Any]) -> None:
        matrix = meta["frames"][3]["transform_matrix"]
        for row, new in zip(matrix, change(np.array(matrix)[:3, :3]).tolist(), strict=False):
            row[:3] = new

    return entry(apply)


def content(data: bytes | str) -> Change:
    """Replace a file."""
    return lambda path: path.write_bytes(data if isinstance(data, bytes) else data.encode())


def text(old: str, new: str) -> Change:
    """Replace text wherever it stands."""

    def apply(path: Path) -> None:
        whole = path.read_text("utf8")
        assert old in whole
        path.write_text(whole.replace(old, new), "utf8")

    return apply


def line(number: int, change: Callable[[list[str]], list[str]]) -> Change:
    """Change the words of a line, counted from 0."""

    def apply(path: Path) -> None:
        lines = path.read_text("utf8").split("\n")
        lines[number] = " ".join(change(lines[number].split()))
        path.write_text("\n".join(lines), "utf8")

    return apply


def binary(name: str, change: Callable[[bytes], bytes]) -> Change:
    """Change a file of a model in its binary form."""

    def apply(model: Path) -> None:
        as_binary(model)
        (model / name).write_bytes(change((model / name).read_bytes()))

    return apply


def without(name: str) -> Change:
    """Remove a file or a folder."""
    return lambda folder: shutil.rmtree(folder / name) if (folder / name).is_dir() else (folder / name).unlink()


def encoded(encoding: str, start: str = "") -> Change:
    """Write a file in another encoding."""
    return lambda path: path.write_text(start + path.read_text("utf8"), encoding)


def matrices(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    """Change all poses."""

    def apply(one: dict[str, Any]) -> None:
        one["transform_matrix"] = change(np.array(one["transform_matrix"])).tolist()

    return lambda path: edit_frames(path, apply)


def scaled(factor: float) -> Change:
    return matrices(lambda pose: pose * [[factor] * 3 + [1.0]])


def names(change: Callable[[str], str]) -> Change:
    """Rename photographs, with a letter that is not ASCII, and change their names in the capture's file or model."""

    def apply(place: Path) -> None:
        file, folder = (place / "images.txt", place.parents[1]) if place.is_dir() else (place, place.parent)
        for path in images_of(folder):
            path.rename(path.with_name(path.name.replace("frame_", "f\u00fcr_")))
        quoted: Callable[[str], str] = str if place.is_dir() else lambda name: json.dumps(name)[1:-1]
        old = r"((?:images/)?)frame_(\d+.png)"
        new = re.sub(old, lambda found: quoted(change(f"{found[1]}f\u00fcr_{found[2]}")), file.read_text())
        file.write_text(new, "utf8")

    return apply


def one_place(path: Path) -> None:
    path.write_text(re.sub(r"^((\S+ ){5})\S+ \S+ \S+", r"\g<1>0 0 0", path.read_text(), flags=re.MULTILINE))


def two_endings(path: Path) -> None:
    for file in images_of(path.parent):
        file.rename(file.with_name(f"{file.stem}.jpg.png"))
    edit_frames(path, lambda one: one.update(file_path=f"./{one['file_path'].replace('.png', '.jpg')}"))


def two_files(path: Path) -> None:
    (path.parent / "images/frame_00003.webp").write_bytes((path.parent / "images/frame_00003.png").read_bytes())
    edit(path, lambda meta: meta["frames"][2].update(file_path="images/frame_00003"))


def nulls(path: Path) -> None:
    absent = ("applied_transform", "applied_scale", "orientation_override", "distortion_params")
    edit(path, lambda meta: (meta.update(dict.fromkeys(absent)), meta["frames"][0].update(mask_path=None)))
    edit_frames(path, lambda one: one.update(mask_path=one.get("mask_path", ""), depth_file_path=None))


def camera_matrices(path: Path) -> None:
    """NeuS2's matrices, or a focal length alone; what is left out is the picture's, or of square pixels."""

    def change(meta: dict[str, Any]) -> None:
        fx, cy, *_ = (meta.pop(key) for key in ("fl_x", "cy", "fl_y", "cx", "w", "h"))
        for i, one in enumerate(meta["frames"]):
            one.update({"intrinsic_matrix": [[fx, 0, 24], [0, fx, cy], [0, 0, 1]]} if i % 2 else {"fl_y": fx})

    edit(path, change)


def cloud(name: str) -> Change:
    """Move the point cloud to `points/cloud.ply`, and name it so."""

    def apply(path: Path) -> None:
        (path.parent / "points").mkdir()
        (path.parent / "sparse_pc.ply").rename(path.parent / "points/cloud.ply")
        edit(path, lambda meta: meta.update(ply_file_path=name))

    return apply


def angle(value: Any) -> Change:
    """State the focal length by an angle alone."""
    return entry(lambda meta: ([meta.pop(key) for key in ("fl_x", "fl_y")], meta.update(camera_angle_x=value)))


def no_val_frames(path: Path) -> None:
    (path.parent / "transforms_val.json").write_text(json.dumps({**json.loads(path.read_text()), "frames": []}))


def box_of_ngp(path: Path, value: Any) -> None:
    edit(path, lambda meta: (meta.pop("applied_transform", None), meta.update(aabb_scale=value)))


TRANSFORMS: list[tuple[Change, str]] = [
    (entries(camera_model="BANANA"), "camera_model 'BANANA' of .*_00001.png is unknown.*write PINHOLE"),
    (entries(applied_transform=[[1, 0], [0, 1]]), "applied_transform is not a matrix of 3 x 4 finite numbers"),
    (entries(applied_transform=[[HUGE] * 4] * 3), "applied_transform is not a matrix"),
    (entries(applied_transform=[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 0]]),
     "transforms.json: applied_transform is not .* that can be undone. .*remove it: then exports are"),
    (entries(applied_scale=0), "applied_scale is 0.0, which is no positive number"),
    (entries(orientation_override=["up"]), "orientation_override is .'up'., none of pca, up"),
    (entries(w="48px"), "w for all frames is '48px', which is no number"),
    (entries(w=48.5), "w for all frames is 48.5, which is no number of pixels"),
    (entries(w=1e30), r"w for all frames is 1e\+30, which is no number of pixels"),
    (entries(w=0), "w for all frames is 0, which is no number of pixels"),
    (frame(2, h="tall"), "h of images/frame_00003.png is 'tall', which is no number"),
    (entries(fl_x=True), "fl_x for all frames is True, which is no number"),
    (entries(fl_x=1e9), r"focal length of .*frame_00002.png.* 1e\+09 pixels \(fl_x\).*not in millimetres"),
    (entries(fl_x=-30.0), "camera of images/frame_00001.png .* cannot be used: its size and focal"),
    (entry(lambda meta: [meta.pop(key) for key in ("fl_x", "fl_y")]),
     "gives no focal length of images/frame_00001.png: neither fl_x nor camera_angle_x"),
    (frame(2, intrinsic_matrix=[[40.0]]), "transforms.json cannot be read: list index out of range"),
    (entries(fl_y=0.1), r"focal length of .*frame_00002.png.* 0.1 pixels \(fl_y\).*span 179 degrees"),
    (entries(fl_y=float("inf")), "cannot be used: its size and focal lengths have to be positive and all"),
    (entries(cx=5e5), "frame_00002.png cannot be used: its principal point is so far .* 80 degrees off"),
    (entries(cx=float("nan")), "cannot be used: .* all parameters finite"),
    (entries(k1=[0.1]), r"k1 of images/frame_00001.png is \[0.1\], which is no number"),
    (entries(k4=0.1), "camera of images/frame_00001.png .*cannot be used: its k4 is 0.1.*image_undistorter"),
    (entries(distortion_params=[0.1, 0.0]), "has 2 distortion_params; perspective cameras need 6 .k1"),
    (entries(camera_model="EQUIRECTANGULAR"), "EQUIRECTANGULAR, but .*: pictures of all .* are twice as wide"),
    (entries(camera_model="ORTHOPHOTO"), "neither a perspective, a fisheye nor an equirectangular camera"),
    (frame(3, camera_model=["PINHOLE"]), "camera_model .'PINHOLE'. of images/frame_00004.png is unknown"),
    (frame(3, distortion_params=[[1, 2], [3]]),
     "camera of images/frame_00004.png in .* cannot be read: setting an array"),
    (entries(test_filenames="a.png"), "test_filenames is 'a.png', not a list of names"),
    (entries(train_filenames=[]), "no image is left for training .* all 12 are held out"),
    (entries(frames=[]), "lists no frames"),
    (entry(lambda meta: meta.update(frames=dict(enumerate(meta["frames"])))),
     "frames is an object with names, not a list"),
    (entry(lambda meta: meta["frames"].insert(1, {"file_path": "a.png"})),
     "frame 1 .* has no transform_matrix. Add that"),
    (entry(lambda meta: meta["frames"].__setitem__(1, None)), "frame 1 .* has no file_path and no transform_matrix"),
    (matrices(np.transpose), "last row of the .* of .*_00001.png is .* not 0 0 0 1.*has to be transposed"),
    (frame(3, transform_matrix="here"), "frame_00004.png is not a matrix of 4 x 4"),
    (frame(3, transform_matrix=[[HUGE] * 4] * 4), "transform_matrix of images/frame_00004.png is not a matrix"),
    (frame(3, transform_matrix=[[1e200, 0, 0, 0], [0, 1e-200, 0, 0], [0, 0, 1e200, 0]]),
     "pose of images/frame_00004.png is no rotation, it is sheared"),
    (entry(lambda meta: meta["frames"][3]["transform_matrix"][0].__setitem__(3, math.nan)),
     "frame_00004.png is not a matrix"),
    *((pose(change), f"transforms.json: the 3 x 3 part of the pose of images/frame_00004.png is no rotation, it {why}")
      for change, why in ((lambda part: part + 0.3 * part[:, [1, 0, 2]] * [1, 0, 0], "is sheared or stretched"),
                          (lambda part: part * [1, 1, 1.1], "is sheared or stretched"),
                          (lambda part: 0 * part, "is zero"))),
    (entries(ply_file_path="gone.ply"), "cloud .*gone.ply cannot be read: it does not exist.*remove ply_file_path"),
    (cloud("C:\\room\\CLOUD.PLY"), "the point cloud .* cannot be read: it does not exist"),
    (entries(ply_file_path=7), "ply_file_path is 7, not the name of a file"),
    (entries(ply_file_path="a" * 300), "the point cloud .*/aaa.* cannot be read: File name too long"),
    (frame(2, file_path=7), "the file_path of frame 2 is 7, not the name of a file"),
    (frame(2, file_path="a/.."), "file_path of frame 2 is 'a/..', not the name of a file"),
    (frame(2, file_path="a" * 300), r"1 of 12 photographs .* missing:\s+.*/aaa"),
    (frame(3, file_path="images/FRAME_00003.png"),
     r"(?s)1 of 12 photographs of .* are missing:\s+\S*images/FRAME_00003.png"),
    (frame(5, file_path="./images/frame_00004.png"),
     r"frames 3 and 5 \(counted from 0\) are both of images/frame_00004.png, but with different poses"),
    (frame(2, mask_path="\\\\"), r"mask_path of frame 2 is '.*', not the name of a file"),
    (entry(lambda meta: [f.update(mask_path=f"/home/me/masks/{f['file_path']}") for f in meta["frames"]]),
     "12 of 12 masks .* are missing: /home/me/masks/images/frame_"),
]  # fmt: skip
NOT_JSON = r"transforms.json cannot be read: Expecting .*line \d+ .*Correct it there \(JSON has neither comments"
IMAGES = "images.txt cannot be read: "
MODEL: list[tuple[str, Change, str]] = [
    ("cameras.txt", text(" 40 40 24 18", " 40"), "cameras.txt: camera 1 has 1 parameters, but a PINHOLE has 4"),
    ("cameras.txt", text("PINHOLE", "PINHALE"), "cameras.txt cannot be read: COLMAP has no camera model PINHALE"),
    ("cameras.txt", text("1 PIN", "7 PIN"), r"image 1 \(frame_00001.png\) was taken by camera 1, .* only 7"),
    ("cameras.txt", text("PINHOLE 48 36 40 40 24 18", "EQUIRECTANGULAR 48 36 48 36"), "EQUIR.*, but .*twice as wide"),
    ("cameras.txt", text("40 40 24", "nan 40 24"), "camera 1 .* has to be from 1 to 1,048,576 pixels and all"),
    ("cameras.txt", text("48 36", f"{2**62} 36"), "camera 1 .* its size has to be from 1 to 1,048,576 pixels"),
    ("cameras.txt", text("48 36", f"{HUGE} 36"), "camera 1 .* its size has to be from 1 to"),
    ("cameras.txt", text("1 PINHOLE 48 36 40 40 24 18", "# a\n1 PINHOLE 48 36 40 40 24 inf"),
     r"cameras.txt: camera 1 \(PINHOLE .* inf\) cannot be used"),
    ("images.txt", text("_00002.png\n\n", "_00002.png\n1 2 3 4\n"), IMAGES + ".*Each image has two"),
    ("images.txt", text("frame_00002", "frame_00001"), "images 1 and 2 are both of frame_00001.png"),
    ("images.txt", text("1 frame_00001.png", f"{HUGE} frame_00001.png"), "frame_00001.png. was taken by camera"),
    *(("images.txt", line(6, lambda words, pose=pose: [words[0], pose, *words[8:]]),
       r"the pose of image 4 \(frame_00004.png\) is not finite, or its rotation is zero")
      for pose in ("nan 0 0 0 0 0 0", "0 0 0 0 1 2 3", "1 0 0 0 0 inf 0")),
    ("images.txt", line(0, lambda words: [words[0], *(repr(float(w) * 1e-300) for w in words[1:5]), *words[5:]]),
     "images.txt: the pose of image 1 .* is not finite, or its rotation is zero"),
    *(("images.txt", line(0, lambda words, cut=cut: [*words[:cut], *words[8:]]),
       IMAGES + f"image 1 has {cut - 1} numbers for its pose instead of 7") for cut in (3, 5, 6, 7)),
    ("images.txt", text("_00001.png", f"{'a' * 252}.png"), r"1 of 12 photographs of .* are missing:\s+.*/frameaaaa"),
    ("images.txt", lambda path: path.write_text(path.read_text().partition("\n")[0]), "has one image only"),
    ("images.txt", one_place, "all cameras are at one place"),
    ("../../images", lambda path: [file.unlink() for file in path.iterdir()],
     "frame_00001.png, .* and 9 more, which are in none of the folders of .*--images-path"),
    ("points3D.txt", text("200", "red"), "points3D.txt cannot be read: .*red"),
    ("points3D.txt", content("1 0 0 0.5 200 10 10\n2 0.1 0 0.5\n"),
     "points3D.txt cannot be read: .*three coordinates and three colors"),
    ("frames.txt", content("1 1 1 0 0 0\n"), "frames.txt cannot be read: the line of frame 1 is cut off"),
    *(("", binary(name, change), f"{name} cannot be read: .*It is cut off or damaged")
      for name in ("cameras.bin", "images.bin", "points3D.bin")
      for change in (lambda data: data[:-5], lambda data: data + b"more")),
]  # fmt: skip
CAMERA_ENTRIES = ("camera_to_worlds", "fx", "fy", "cx", "cy", "width", "height")
CAMERA = "keyframes/corrected_cameras/3.json"
LARGE = "3.json cannot be read: a number in it is too large"
SCAN: list[tuple[Any, str, Change, str]] = [
    (polycam, CAMERA, entry(lambda meta: meta.pop("t_01")), "3.json cannot be read: the entry 't_01' is missing"),
    (polycam, CAMERA, entries(t_01=float("nan")), "the pose or camera of 3.png is not finite"),
    (polycam, CAMERA, entries(width=0, height=36), "its picture has no pixels"),
    (polycam, CAMERA, entries(width=2**62, height=36), "or its picture has no pixels"),
    (polycam, CAMERA, entries(width=float("inf"), height=36), LARGE),
    (polycam, CAMERA, entries(t_01=HUGE), LARGE),
    (polycam, CAMERA, entries(t_01=[[]] * 3), "3.json cannot be read: float"),
    (polycam, CAMERA, content("[" * 100_000), "3.json cannot be read: it is nested too deeply"),
    (polycam, "keyframes", without("corrected_images/5.png"), r"1 of 12 photographs of .* are missing:\s+.*images/5"),
    (scannet, "", without("intrinsic"), "has poses, but no file with the camera .* `bitymi-data --format photographs`"),
    *((record3d, "metadata", entry(lambda meta, pose=pose: meta["poses"].__setitem__(3, pose)), message)
      for pose, message in (([0, 0, 0, 1, 0.1], "pose 3 .* it has 5 numbers, not 7"),
                            ([HUGE] * 7, "pose 3 .*: a number in it is too large"),
                            ([0] * 7, "metadata: pose 3 .counted from 0. cannot be read"))),
    (record3d, "metadata", entries(perFrameIntrinsicCoeffs=[[1.0, 2.0]] * 20), "pose 0 .* it has 2 numbers, not 4"),
    (record3d, "metadata", entries(K=[1.0]), "metadata cannot be read: list index out of range"),
    (record3d, "rgb/2.png", lambda path: Image.new("RGB", (36, 48)).save(path),
     "2.png has 36 x 48 pixels, but its camera is for 96 x 72, which is another shape"),
    (partial(stray_scanner, rows=30), "", lambda folder: None, "has 12 frames, but 30 poses: .*--data .*rgb.mp4"),
    (stray_scanner, "odometry.csv", text("qw", "w"),
     "odometry.csv: pose 0 .* cannot be read: the entry 'qw' is missing"),
    (stray_scanner, "odometry.csv", text("0.1, 000001", "0.1, one"),
     "odometry.csv: pose 1 .* cannot be read: invalid literal"),
    (stray_scanner, "camera_matrix.csv", content("1, 2\n"), "camera_matrix.csv cannot be read"),
    (scanner_app, "frame_00010.json", content(json.dumps({"intrinsics": [1] * 9})),
     "frame_00010.json cannot be read: the entry 'cameraPoseARFrame' is missing"),
    (scanner_app, "frame_00010.json", entries(cameraPoseARFrame=[1.0] * 12), "it has 12 numbers, not 16"),
]  # fmt: skip
DEFECTS: list[tuple[Callable[[Path], Path], str, Change, str]] = [
    *((nerfstudio, "", change, message) for change, message in TRANSFORMS),
    (nerfstudio, "", content('{"frames": ' + "[" * 500 + "]" * 500 + "}"), "cannot be read: it is nested too deeply"),
    (blender, "", angle(39.6), r"train.json: camera_angle_x is 39.6.*not degrees \(39.6 deg.* 0.69115\)"),
    (blender, "", angle(True), "camera_angle_x for all frames is True, which is no number"),
    (blender, "", angle(3.14159), "focal length of .*_00002.png.*span 180 degrees.*camera_angle_x is in radia"),
    (blender, "", entries(frames=None), "transforms_train.json lists no frames"),
    (blender, "", entries(frames=[]), "transforms_train.json lists no frames"),
    (blender, "", no_val_frames, "transforms_val.json lists no frames.*move a few frames there"),
    (blender, "", pose(lambda part: part + 0.3 * part[:, [1, 0, 2]] * [1, 0, 0]),
     "transforms_train.json: the 3 x 3 part of the pose of images/frame_00004.png is no rotation"),
    (nerfstudio, "", lambda path: path.write_text(f"// by hand\n{path.read_text()}"), NOT_JSON),
    (nerfstudio, "", lambda path: path.write_text(f"{path.read_text().rstrip()[:-1]},}}"), NOT_JSON),
    (instant_ngp, "", entries(equirectangular=True),
     'equirectangular is set, .*rows show equal areas.* write "camera_model": "EQUIRECTANGULAR"'),
    (instant_ngp, "", entries(latlong=True, is_fisheye=False), "EQUIRECTANGULAR, but .*: pictures of all .* are twice"),
    (instant_ngp, "", two_files, "frame 2 is of images/frame_00003, but there are .*3.png, images/.*webp"),
    (instant_ngp, "", frame(2, file_path="images/frame_3"), r"(?s)1 of 12 .* missing:\s+\S*images/frame_3\s+Copy"),
    *((instant_ngp, "", partial(box_of_ngp, value=value), "transforms.json: aabb_scale")
      for value in (0, -1, float("inf"), HUGE, "wide", [])),
    *((colmap, file, change, message) for file, change, message in MODEL),
    *SCAN,
]  # fmt: skip


@pytest.mark.parametrize(("form", "file", "change", "message"), DEFECTS)
def test_a_defect_is_named(
    capture: Path, form: Callable[[Path], Path], file: str, change: Change, message: str
) -> None:
    place = form(capture)
    change(place / file if file else place)
    options = {"format": {nerfstudio: "nerfstudio", instant_ngp: "instant-ngp"}.get(form, "auto")}
    with expect(message):
        load_any(capture if place.is_relative_to(capture) else place, **options)


NAMES = {
    "case": lambda name: name.upper(),
    "ending": lambda name: name.replace(".png", ".JPG"),
    "no ending": lambda name: name.replace(".png", ""),
    "backslashes": lambda name: ".\\" + name.replace("/", "\\"),
    "absolute": lambda name: f"/home/somebody/project/{name}",
    "drive": lambda name: "C:\\Users\\somebody\\" + name.replace("/", "\\"),
    "unicode": lambda name: unicodedata.normalize("NFD", name),
}
OTHER_NAMES = "12 of 12 photographs have other names than it says"
SAME: list[tuple[Callable[[Path], Path], str, Change, str]] = [
    *((form, "", names(change), "" if what in ("backslashes", "no ending") else OTHER_NAMES)
      for form in PHOTOGRAPHS for what, change in NAMES.items()),
    *((form, "", encoded(encoding), "") for form in JSON for encoding in ("utf-8-sig", "utf-16")),
    *((colmap, file, encoded(encoding, "# a comment\n"), "") for file in ("cameras.txt", "images.txt", "points3D.txt")
      for encoding in ("utf-8-sig", "utf-16")),
    (colmap, "images.txt", text("\n\n", "\n1.5 2.5 -1 3 4 5 6.5 7 8 9 10 11\n"), ""),
    (nerfstudio, "", entry(lambda meta: meta.update(w="48.0", h=36.0, fl_x=str(meta["fl_x"]))), ""),
    (nerfstudio, "", nulls, ""),
    (nerfstudio, "", camera_matrices, ""),
    (nerfstudio, "", matrices(lambda pose: pose[:3]), ""),
    (nerfstudio, "", matrices(lambda pose: pose / 8), "is divided by its last number, which is not 1"),
    (instant_ngp, "", entries(latlong=False, is_fisheye=False), ""),
    (instant_ngp, "", scaled(0.4), "scaled by 0.4"),
    (blender, "", scaled(2.5), "scaled by 2.5"),
    (blender, "", two_endings, ""),
    (nerfstudio, "", scaled(2.5), "scaled by 2.5 in the poses of images/frame_00001.png, "),
    (nerfstudio, "", pose(lambda part: 2.5 * part), "in the poses of images/frame_00004.png. The factor is divided"),
    (nerfstudio, "", cloud("points\\Cloud.ply"), ""),
    (nerfstudio, "", cloud("/home/me/room/points/cloud.ply"), ""),
]  # fmt: skip
BEFORE: dict[Callable[[Path], Path], list[torch.Tensor]] = {}  # what the room gives in each format


@pytest.mark.parametrize(("form", "file", "change", "said"), SAME)
def test_what_makes_no_difference(
    capture: Path,
    form: Callable[[Path], Path],
    file: str,
    change: Change,
    said: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def views() -> list[torch.Tensor]:
        manager = load_any(capture)
        outputs, held = manager.train_dataparser_outputs, manager.eval_dataset
        both = [getattr(each.cameras, name).double() for each in (outputs, held) for name in CAMERA_ENTRIES]
        assert manager.cached_train[0]["image"].shape == (36, 48, 3) and "mask" not in manager.train_dataset.get_data(0)
        return [*both, outputs.metadata.get("points3D_xyz", torch.zeros(0, 3))]

    place = form(capture)
    before = BEFORE[form] = BEFORE.get(form) or views()
    capsys.readouterr()
    change(place / file if file else place)
    for one, other in zip(before, views(), strict=True):
        assert torch.allclose(one, other.to(one), atol=1e-6)
    shown = printed(capsys)
    assert said in shown and (said == OTHER_NAMES or "other names" not in shown)
