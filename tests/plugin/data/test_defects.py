"""A defect of a capture ends in one line that names it: a table of formats and defects."""

import json
import math
import re
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tests.captures import as_binary, edit, edit_frames, expect, images_of, load_any, reduce_photographs
from tests.changes import SPOILT, Change, beside, cloud, content, entries, entry, given, matrices, pose, room_of, text
from tests.formats import (
    PHOTOGRAPHS,
    Form,
    blender,
    colmap,
    instant_ngp,
    nerfstudio,
    polycam,
    record3d,
    scanner_app,
    scannet,
    stray_scanner,
)

HUGE = 10**400


def frame(i: int, **values: Any) -> Change:
    """Set entries of a frame."""
    return lambda path: edit(path, lambda meta: meta["frames"][i].update(values))


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


def instead(kind: str) -> Change:
    """Put something else in a file's place."""
    return lambda path: (path.unlink(), SPOILT[kind](path))


def angle(value: Any) -> Change:
    """State the focal length by an angle alone."""
    return entry(lambda meta: ([meta.pop(key) for key in ("fl_x", "fl_y")], meta.update(camera_angle_x=value)))


def one_place(path: Path) -> None:
    path.write_text(re.sub(r"^((\S+ ){5})\S+ \S+ \S+", r"\g<1>0 0 0", path.read_text(), flags=re.MULTILINE))


def two_files(path: Path) -> None:
    (path.parent / "images/frame_00003.webp").write_bytes((path.parent / "images/frame_00003.png").read_bytes())
    edit(path, lambda meta: meta["frames"][2].update(file_path="images/frame_00003"))


def no_val_frames(path: Path) -> None:
    (path.parent / "transforms_val.json").write_text(json.dumps({**json.loads(path.read_text()), "frames": []}))


def box_of_ngp(path: Path, value: Any) -> None:
    edit(path, lambda meta: (meta.pop("applied_transform", None), meta.update(aabb_scale=value)))


def masked_by(kind: str) -> Change:
    """Name a mask that is something else."""
    mask = beside("m.png", SPOILT[kind])
    return lambda path: (mask(path), edit_frames(path, lambda one: one.update(mask_path="m.png")))


def undecodable(ending: str) -> Change:
    """Spoil all but the header of a photograph in another format."""

    def apply(path: Path) -> None:
        whole = Image.open(path).convert("RGB")
        path.unlink()
        path = path.with_suffix(f".{ending}")
        whole.save(path)
        data = path.read_bytes()
        path.write_bytes(data[:40] + b"\xff" * (len(data) - 40))

    return beside("images/frame_00004.png", apply)


TRANSFORMS: list[tuple[Change, str]] = [
    (entries(camera_model="BANANA"), "camera_model 'BANANA' of .*_00001.png cannot be used.*write PINHOLE"),
    (entries(applied_transform=[[1, 0], [0, 1]]), "applied_transform is not a matrix of 3 x 4 finite numbers"),
    (entries(applied_transform=[[HUGE] * 4] * 3), "applied_transform is not a matrix"),
    (entries(applied_transform=[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 0]]),
     "transforms.json: applied_transform is not .* that can be undone. .*remove it to export"),
    (entries(applied_scale=0), "applied_scale is 0, which is no positive number"),
    (entries(orientation_override=["up"]), "orientation_override is .'up'., none of pca, up"),
    (entries(w="48px"), "w for all frames is '48px', which is no number"),
    (entries(w=48.5), "w for all frames is 48.5, which is no number of pixels"),
    (entries(w=1e30), r"w for all frames is 1e\+30, which is no number of pixels"),
    (entries(w=0), "w for all frames is 0, which is no number of pixels"),
    (frame(2, h="tall"), "h of images/frame_00003.png is 'tall', which is no number"),
    (entries(fl_x=True), "fl_x for all frames is True, which is no number"),
    (entries(fl_x=1e9), r"focal length of .*frame_00002.png.* 1e\+09 pixels \(fl_x\).*not in millimetres"),
    (entries(fl_x=-30.0), "camera of images/frame_00001.png .* cannot be used: size and focal lengths"),
    (entry(lambda meta: [meta.pop(key) for key in ("fl_x", "fl_y")]),
     "gives no focal length of images/frame_00001.png: neither fl_x nor camera_angle_x"),
    (frame(2, intrinsic_matrix=[[40.0]]), "transforms.json cannot be read: list index out of range"),
    (entries(fl_y=0.1), r"focal length of .*frame_00002.png.* 0.1 pixels \(fl_y\).*span 179 degrees"),
    (entries(fl_y=float("inf")), "_00001.png .* cannot be used: .* positive, all numbers finite"),
    (entries(cx=5e5), "frame_00002.png cannot be used: its principal point is so far .* 80 degrees off"),
    (entries(cx=float("nan")), "_00001.png .* cannot be used: .* all numbers finite"),
    (entries(k1=[0.1]), r"k1 of images/frame_00001.png is \[0.1\], which is no number"),
    (entries(k4=0.1), "camera of images/frame_00001.png .*cannot be used: its k4 is 0.1.*undistort first"),
    (entries(distortion_params=[0.1, 0.0]), "has 2 distortion_params; perspective cameras need 6 .k1"),
    (entries(camera_model="EQUIRECTANGULAR"), "_00001.png .* is EQUIR.*, which is twice as wide as high, but"),
    (entries(camera_model="ORTHOPHOTO"), "camera_model 'ORTHOPHOTO' of .*_00001.png cannot be used"),
    (frame(3, camera_model=["PINHOLE"]), "camera_model .'PINHOLE'. of images/frame_00004.png cannot be used"),
    (frame(3, distortion_params=[[1, 2], [3]]),
     "camera of images/frame_00004.png in .* cannot be read: setting an array"),
    (entries(test_filenames="a.png"), "test_filenames is 'a.png', not a list of names"),
    (entries(train_filenames=[]), "all 12 photographs of .* are held out"),
    (entries(frames=[]), "lists no frames"),
    (entry(lambda meta: meta.update(frames=dict(enumerate(meta["frames"])))),
     "frames is an object, not a list"),
    (entry(lambda meta: meta["frames"].insert(1, {"file_path": "a.png"})),
     "frame 1 .* has no transform_matrix. Add that"),
    (entry(lambda meta: meta["frames"].__setitem__(1, None)), "frame 1 .* has no file_path and no transform_matrix"),
    (matrices(np.transpose), "last row of the .* of .*_00001.png is .* not 0 0 0 1.*transpose it"),
    (frame(3, transform_matrix="here"), "frame_00004.png is not 4 x 4 finite numbers"),
    (frame(3, transform_matrix=[[HUGE] * 4] * 4), "transform_matrix of images/frame_00004.png is not 4 x 4"),
    (frame(3, transform_matrix=[[1e200, 0, 0, 0], [0, 1e-200, 0, 0], [0, 0, 1e200, 0]]),
     "pose of images/frame_00004.png is sheared"),
    (entry(lambda meta: meta["frames"][3]["transform_matrix"][0].__setitem__(3, math.nan)),
     "frame_00004.png is not 4 x 4"),
    *((pose(change), f"transforms.json: the 3 x 3 part of the pose of images/frame_00004.png {why}")
      for change, why in ((lambda part: part + 0.3 * part[:, [1, 0, 2]] * [1, 0, 0], "is sheared or stretched"),
                          (lambda part: part * [1, 1, 1.1], "is sheared or stretched"),
                          (lambda part: 0 * part, "is zero"))),
    (entry(lambda meta: meta["frames"][3]["transform_matrix"][0].__setitem__(3, 1e6)),
     r"the camera of .*frame_00004.png is [\d,]* times as far .*Correct the pose or remove the frame"),
    (entry(lambda meta: meta.update(frames=meta["frames"][:2])), "only one training view"),
    (entry(lambda meta: meta.update(frames=meta["frames"][:1])), "has one image only"),
    (beside("images/frame_00004.png", lambda path: Image.open(path).rotate(90, expand=True).save(path)),
     "frame_00004.png is turned by a quarter: it has 36 x 48 .* camera of .* is for 48 x 36.*EXIF tag"),
    (beside("images/frame_00004.png", lambda path: Image.new("RGB", (40, 30)).save(path)),
     "04.png has 40 x 30 pixels, but the camera of images/frame_00004.png in .*transforms.json is for 48 x 36"),
    (entries(ply_file_path="gone.ply"), "cloud .*gone.ply cannot be read: it does not exist.*start from random points"),
    (cloud("C:\\room\\CLOUD.PLY"), "the point cloud .* cannot be read: it does not exist"),
    (entries(ply_file_path=7), "ply_file_path is 7, not the name of a file"),
    (entries(ply_file_path="a" * 300), "the point cloud .*/aaa.* cannot be read: File name too long"),
    (frame(2, file_path=7), "the file_path of frame 2 is 7, not the name of a file"),
    (frame(2, file_path="a/.."), "file_path of frame 2 is 'a/..', not the name of a file"),
    (frame(2, file_path="a" * 300), r"1 of 12 photographs .* missing:\s+.*/aaa"),
    (frame(3, file_path="images/FRAME_00003.png"),
     r"(?s)1 of 12 photographs of .* are missing:\s+\S*images/FRAME_00003.png"),
    (frame(3, file_path="/gone.png"), r"1 of 12 photographs of .* are missing:\s+/gone.png"),
    (frame(5, file_path="./images/frame_00004.png"),
     r"frames 3 and 5 \(counted from 0\) are both of images/frame_00004.png, with different poses"),
    (frame(2, mask_path="\\\\"), r"mask_path of frame 2 is '.*', not the name of a file"),
    (entry(lambda meta: [f.update(mask_path=f"/home/me/masks/{f['file_path']}") for f in meta["frames"]]),
     "12 of 12 masks .* are missing: /home/me/masks/images/frame_"),
    (lambda path: (reduce_photographs(path.parent, 2, (24, 18)), shutil.rmtree(path.parent / "images")),
     "use their copies in .*images_2: `bitymi-data --downscale-factor 2`"),
]  # fmt: skip
NOT_JSON = r"transforms.json cannot be read: Expecting .*line \d+ .*Correct it there \(JSON has neither comments"
IMAGES = "images.txt cannot be read: "
MODEL: list[tuple[str, Change, str]] = [
    ("cameras.txt", text(" 40 40 24 18", " 40"), "cameras.txt: camera 1 has 1 parameters, but a PINHOLE has 4"),
    ("cameras.txt", text("PINHOLE", "PINHALE"), "cameras.txt cannot be read: COLMAP has no camera model PINHALE"),
    ("cameras.txt", text("1 PIN", "7 PIN"), r"image 1 \(frame_00001.png\) is of camera 1, but .* only 7"),
    ("cameras.txt", text("PINHOLE 48 36 40 40 24 18", "EQUIRECTANGULAR 48 36 48 36"), "EQUIR.* is twice as wide"),
    ("cameras.txt", text("40 40 24", "nan 40 24"), "cameras.txt: camera 1, .* numbers finite"),
    ("cameras.txt", text("48 36", f"{2**62} 36"), "camera 1, .* sides are 1 to 1,048,576 pixels"),
    ("cameras.txt", text("48 36", f"{HUGE} 36"), "camera 1, .* sides are 1 to"),
    ("cameras.txt", text("1 PINHOLE 48 36 40 40 24 18", "# a\n1 PINHOLE 48 36 40 40 24 inf"),
     r"cameras.txt: camera 1, PINHOLE .* inf\), cannot be used"),
    ("images.txt", text("_00002.png\n\n", "_00002.png\n1 2 3 4\n"), IMAGES + ".*Each image has two"),
    ("images.txt", text("frame_00002", "frame_00001"), "images 1 and 2 are both of frame_00001.png"),
    ("images.txt", text("1 frame_00001.png", f"{HUGE} frame_00001.png"), "frame_00001.png. is of camera"),
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
    ("../..", lambda room: (reduce_photographs(room, 2, (24, 18)), shutil.rmtree(room / "images")),
     "only copies of 24 x 18 pixels .* are there, in .*images_2: `bitymi-data --downscale-factor 2`"),
    ("points3D.txt", text("200", "red"), "points3D.txt cannot be read: .*red"),
    ("points3D.txt", content("1 0 0 0.5 200 10 10\n2 0.1 0 0.5\n"),
     "points3D.txt cannot be read: .*three coordinates and three colors"),
    ("frames.txt", content("1 1 1 0 0 0\n"), "frames.txt cannot be read: the line of frame 1 is cut off"),
    *(("", binary(name, change), f"{name} cannot be read: .*It is cut off or damaged")
      for name in ("cameras.bin", "images.bin", "points3D.bin")
      for change in (lambda data: data[:-5], lambda data: data + b"more")),
]  # fmt: skip
CAMERA = "keyframes/corrected_cameras/3.json"
LARGE = "3.json cannot be read: a number in it is too large"
SCAN: list[tuple[Any, str, Change, str]] = [
    (polycam, CAMERA, entry(lambda meta: meta.pop("t_01")), "3.json cannot be read: the entry 't_01' is missing"),
    (polycam, CAMERA, entries(t_01=float("nan")), "the pose, camera or size of 3.png is not finite"),
    (polycam, CAMERA, entries(width=0, height=36), "size of 3.png is not finite, or 0"),
    (polycam, CAMERA, entries(width=2**62, height=36), "size of 3.png is not finite, or 0"),
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
     "2.png has 36 x 48 pixels, but its camera is for 96 x 72"),
    (partial(stray_scanner, rows=30), "", lambda folder: None, "has 12 frames, but 30 poses. .*--data .*rgb.mp4"),
    (stray_scanner, "odometry.csv", text("qw", "w"),
     "odometry.csv: pose 0 .* cannot be read: the entry 'qw' is missing"),
    (stray_scanner, "odometry.csv", text("0.1, 000001", "0.1, one"),
     "odometry.csv: pose 1 .* cannot be read: invalid literal"),
    (stray_scanner, "camera_matrix.csv", content("1, 2\n"), "camera_matrix.csv cannot be read"),
    (scanner_app, "frame_00010.json", content(json.dumps({"intrinsics": [1] * 9})),
     "frame_00010.json cannot be read: the entry 'cameraPoseARFrame' is missing"),
    (scanner_app, "frame_00010.json", entries(cameraPoseARFrame=[1.0] * 12), "it has 12 numbers, not 16"),
]  # fmt: skip
OPTIONS: list[tuple[Any, str, Change, str]] = [
    *((nerfstudio, "", given(**{name: value}), f"--{name.replace('_', '-')} is {value}, but has to be {what}")
      for name, value, what in (("scale_factor", 0.0, "above 0"), ("scale_factor", -1.0, "above 0"),
                                ("downscale_factor", 0, "1 or more"), ("eval_interval", 0, "1 or more"))),
    (nerfstudio, "", given(eval_mode="fraction", train_split_fraction=2.0),
     "--train-split-fraction is 2.0, .* at most 1"),
    (nerfstudio, "", given(images_path=Path("x")), "--images-path is not for"),
    (nerfstudio, "", given(alpha_color=None), "--alpha-color is not for"),
    (nerfstudio, "", given(eval_names=("frame_00003.png", "frame_3.png")),
     "--eval-names: 1 of 2 names are of no photograph of the capture: frame_3.png"),
    (nerfstudio, "", given(eval_names=tuple(f"frame_{i:05d}.png" for i in range(1, 13))),
     "all 12 photographs of .* are held out"),
    (colmap, "", given(masks_path=Path("mine")), "folder of masks .*/mine does not exist. .*--masks-path"),
    (colmap, "", given(images_path=Path("elsewhere")), "the folder of photographs .*elsewhere does not exist"),
    (colmap, "../..", given(lambda room: reduce_photographs(room, 4, (24, 18)), downscale_factor=4),
     "images_4/frame_00001.png has 24 x 18 pixels, but 1/4 of its camera's is 12 x 9"),
    (colmap, "../..", given(lambda room: (reduce_photographs(room, 4, (12, 9)),
                                          (room / "images_4/frame_00003.png").unlink()), downscale_factor=4),
     r"1 of 12 photographs of .* missing:\s+.*images_4/frame_00003.png"),
]  # fmt: skip
SPOILT_FILES: list[tuple[Any, str, Change, str]] = [
    *((form, file, instead(kind), rf"\A[^\n]*({word}|nothing to train on)[^\n]*\Z") for kind in SPOILT
      for form, file, word in (
          (nerfstudio, "", "transforms.json"), (colmap, "images.txt", "images"), (polycam, CAMERA, "3.json"),
          (scannet, "pose/3.txt", "3.txt"), (scannet, "intrinsic/intrinsic_color.txt", "intrinsic_color|but no file"))),
    *((nerfstudio, "", beside("sparse_pc.ply", instead(kind)), r"\A[^\n]*sparse_pc.ply[^\n]*\Z") for kind in SPOILT),
    *((nerfstudio, "", masked_by(kind), "m.png cannot be read|m.png is missing")
      for kind in ("pipe", "folder", "binary")),
    *((nerfstudio, "", undecodable(ending), f"frame_00004.{ending}") for ending in ("png", "jpg", "webp", "tif")),
    *((colmap, "../../train_list.txt", SPOILT[kind], "own lists|train_list.txt") for kind in ("binary", "deep")),
]  # fmt: skip
DEFECTS: list[tuple[Form, str, Change, str]] = [
    *((form, "", lambda place: [file.rename(file.with_name(file.name.replace("frame_", "fr\u0430me_")))  # Cyrillic
                                for file in images_of(room_of(place))],
       r"(?s)but there is \S*fr\u0430me_\d+.png, '\S*fr\\u0430me_\d+.png', instead of '\S*frame_\d+.png'")
      for form in PHOTOGRAPHS),
    *((form, "", lambda place: images_of(room_of(place))[3].unlink(),
       r"(?s)1 of 12 photographs .*frame_00004.png\s+Copy") for form in PHOTOGRAPHS),
    *((nerfstudio, "", change, message) for change, message in TRANSFORMS),
    (nerfstudio, "", content('{"frames": ' + "[" * 500 + "]" * 500 + "}"), "cannot be read: it is nested too deeply"),
    (blender, "", angle(39.6), r"train.json: camera_angle_x is 39.6.*not degrees \(39.6 deg.* 0.69115\)"),
    (blender, "", angle(True), "camera_angle_x for all frames is True, which is no number"),
    (blender, "", angle(3.14159), "focal length of .*_00002.png.*span 180 degrees.*camera_angle_x is in radia"),
    (blender, "", entries(frames=None), "transforms_train.json lists no frames"),
    (blender, "", entries(frames=[]), "transforms_train.json lists no frames"),
    (blender, "", no_val_frames, "transforms_val.json lists no frames.*Move a few frames there"),
    (blender, "", pose(lambda part: part + 0.3 * part[:, [1, 0, 2]] * [1, 0, 0]),
     "transforms_train.json: the 3 x 3 part of the pose of images/frame_00004.png is sheared"),
    (nerfstudio, "", lambda path: path.write_text(f"// by hand\n{path.read_text()}"), NOT_JSON),
    (nerfstudio, "", lambda path: path.write_text(f"{path.read_text().rstrip()[:-1]},}}"), NOT_JSON),
    (instant_ngp, "", entries(equirectangular=True),
     'equirectangular is set, .*rows of equal areas.* write "camera_model": "EQUIRECTANGULAR"'),
    (instant_ngp, "", entries(latlong=True, is_fisheye=False), "is EQUIR.*, which is twice as wide as high, but"),
    (instant_ngp, "", two_files, "frame 2 is of images/frame_00003, but there are .*3.png, images/.*webp"),
    (instant_ngp, "", frame(2, file_path="images/frame_3"), r"(?s)1 of 12 .* missing:\s+\S*images/frame_3\s+Copy"),
    *((instant_ngp, "", partial(box_of_ngp, value=value), "transforms.json: aabb_scale")
      for value in (0, -1, float("inf"), HUGE, "wide", [])),
    *((colmap, file, change, message) for file, change, message in MODEL),
    *SCAN,
    *OPTIONS,
    *SPOILT_FILES,
]  # fmt: skip


@pytest.mark.usefixtures("no_hang")
@pytest.mark.parametrize(("form", "file", "change", "message"), DEFECTS)
def test_a_defect_is_named(capture: Path, form: Form, file: str, change: Change, message: str) -> None:
    place = form(capture)
    stated = change(place / file if file else place)
    options = {"format": {nerfstudio: "nerfstudio", instant_ngp: "instant-ngp"}.get(form, "auto")}
    options |= stated if isinstance(stated, dict) else {}
    with expect(message) as stop:
        manager = load_any(capture if place.is_relative_to(capture) else place, **options)
        list(manager.train_views), list(manager.eval_views)
    assert "Errno" not in str(stop.value) and len(str(stop.value)) < 2000
