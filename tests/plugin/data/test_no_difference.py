"""Read captures after changes that make no difference, or that a line names: tables of formats and changes."""

import json
import re
import shutil
import unicodedata
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from tests.captures import colmap_model, edit, edit_frames, images_of, load_any, printed, write_cloud
from tests.changes import SPOILT, Change, beside, cloud, content, entries, entry, given, matrices, pose, room_of, text
from tests.formats import JSON, PHOTOGRAPHS, Form, blender, colmap, instant_ngp, nerfstudio, scannet
from tests.typed import Patch, Printed

CAMERA_ENTRIES = ("camera_to_worlds", "fx", "fy", "cx", "cy", "width", "height")


def encoded(encoding: str, start: str = "") -> Change:
    """Write a file in another encoding."""
    return lambda path: path.write_text(start + path.read_text("utf8"), encoding)


def scaled(factor: float) -> Change:
    return matrices(lambda pose: pose * [[factor] * 3 + [1.0]])


def names(change: Callable[[str], str]) -> Change:
    """Rename photographs, with a letter that is not ASCII, and change their names in the capture's file or model."""

    def apply(place: Path) -> None:
        file = place / "images.txt" if place.is_dir() else place
        for path in images_of(room_of(place)):
            path.rename(path.with_name(path.name.replace("frame_", "f\u00fcr_")))
        quoted: Callable[[str], str] = str if place.is_dir() else lambda name: json.dumps(name)[1:-1]
        old = r"((?:images/)?)frame_(\d+.png)"
        new = re.sub(old, lambda found: quoted(change(f"{found[1]}f\u00fcr_{found[2]}")), file.read_text())
        file.write_text(new, "utf8")

    return apply


def two_endings(path: Path) -> None:
    for file in images_of(path.parent):
        file.rename(file.with_name(f"{file.stem}.jpg.png"))
    edit_frames(path, lambda one: one.update(file_path=f"./{one['file_path'].replace('.png', '.jpg')}"))


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


def processed(path: Path) -> None:
    """Name photographs as `ns-process-data --eval-data` does."""

    def apply(one: dict[str, Any]) -> None:
        file = path.parent / one["file_path"]
        split = "eval" if file.stem.endswith("4") else "train"
        one["file_path"] = f"images/{file.rename(file.with_name(file.name.replace('_', f'_{split}_'))).name}"

    edit_frames(path, apply)


def elsewhere(path: Path) -> None:
    """Move a photograph out of the capture."""
    file = images_of(path.parent)[3]
    moved = file.rename(path.parents[1] / "elsewhere.png")
    edit(path, lambda meta: meta["frames"][3].update(file_path=str(moved)))


def another_model(model: Path) -> None:
    shutil.copytree(model, room_of(model) / "distorted/sparse/0")
    shutil.copytree(room_of(model) / "images", room_of(model) / "input")


def cloud_of(factor: float) -> Change:
    """Write a cloud in another unit, with outliers."""
    points = np.random.default_rng(0).normal(size=(500, 3)) * factor
    points[0], points[1] = np.nan, 1e9
    return beside("sparse_pc.ply", lambda path: write_cloud(path, points, None))


NAMES = {
    "case": lambda name: name.upper(),
    "ending": lambda name: name.replace(".png", ".JPG"),
    "no ending": lambda name: name.replace(".png", ""),
    "backslashes": lambda name: ".\\" + name.replace("/", "\\"),
    "absolute": lambda name: f"/home/somebody/project/{name}",
    "drive": lambda name: "C:\\Users\\somebody\\" + name.replace("/", "\\"),
    "unicode": lambda name: unicodedata.normalize("NFD", name),
}
OTHER_NAMES = "12 of 12 photographs have other names"
SAME: list[tuple[Form, str, Change, str]] = [
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
    (nerfstudio, "", matrices(lambda pose: pose / 8), "is divided by its last number"),
    (instant_ngp, "", entries(latlong=False, is_fisheye=False), ""),
    (instant_ngp, "", scaled(0.4), "scaled by 0.4"),
    (blender, "", scaled(2.5), "scaled by 2.5"),
    (blender, "", two_endings, ""),
    (nerfstudio, "", scaled(2.5), "scaled by 2.5 in the poses of images/frame_00001.png, "),
    (nerfstudio, "", pose(lambda part: 2.5 * part), "in the poses of images/frame_00004.png. It is divided out"),
    *((colmap, f"../../{name}", SPOILT[kind], "") for kind in SPOILT
      for name in ("a.json", "metadata.json", "agisoft.xml")),
    *((colmap, "../../train_list.txt", SPOILT[kind], "") for kind in ("pipe", "folder", "dangling")),
    (nerfstudio, "", cloud("points\\Cloud.ply"), ""),
    (nerfstudio, "", cloud("/home/me/room/points/cloud.ply"), ""),
]  # fmt: skip
BEFORE: dict[Form, list[torch.Tensor]] = {}  # what the room gives in each format


@pytest.mark.parametrize(("form", "file", "change", "said"), SAME)
def test_what_makes_no_difference(
    capture: Path, form: Form, file: str, change: Change, said: str, capsys: Printed
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


UNIT = "The point cloud seems to be in another unit than the poses: half of the points lie"
SAID: list[tuple[Form, str, Change, str]] = [
    *((form, "", entry(lambda meta: (meta.update(fisheye_crop_radius=12.0), meta["frames"][2].update(rotation=0.1))),
       "that are not used: fisheye_crop_radius.") for form in JSON),
    *((form, "", elsewhere, "names pictures outside of its folder, which are read there: ") for form in JSON),
    (nerfstudio, "", entries(fl_x=4.2), "is 4.2 pixels (fl_x): 48 pixels of the picture span 160 deg"),
    (nerfstudio, "", entry(lambda meta: meta.update(frames=meta["frames"][:5])), "Only 4 training views"),
    (nerfstudio, "", pose(lambda part: part * [-1, 1, 1]), "frame_00004.png is mirrored against the other frames"),
    (nerfstudio, "", entry(lambda meta: meta["frames"][3]["transform_matrix"][0].__setitem__(3, 500.0)),
     "as the others. If that is a mistake, correct the pose"),
    (nerfstudio, "", cloud_of(1000.0), f"{UNIT} far beyond the cameras"),
    (nerfstudio, "", cloud_of(0.001), f"{UNIT} in a spot of the pictures"),
    (nerfstudio, "", processed, "1 of 12 photographs, by ns-process-data's names (frame_eval_00004.png)"),
    (nerfstudio, "", given(processed, eval_interval=4), "3 of 12 photographs, every 4th by name"),
    (nerfstudio, "", lambda path: colmap_model(path.parent, path.parent / "sparse/0"),
     "(nerfstudio, 12 photographs). Not read: sparse/0 (`bitymi-data --format colmap`)."),
    (nerfstudio, "", given(lambda path: colmap_model(path.parent, path.parent / "sparse/0"), format="colmap"),
     "Not read: transforms.json (`bitymi-data --format nerfstudio`)"),
    (colmap, "", another_model, "/input that belong to the model distorted/sparse/0 (frame_00001.png, "),
    (colmap, "../../images", lambda images: [Image.new("RGB", (48, 36)).save(images / f"extra {i}.png") for i in "ba"],
     "2 of 14 photographs have no pose in the model and are left out: extra a.png, extra b.png."),
    (colmap, "points3D.txt", content("1 0 0 0.5 200 10 10\n2 nan 0 0.5 200 10 10\n"),
     "points3D.txt: 1 of 2 points, the first is point 2, are not finite"),
    *((colmap, "points3D.txt", content(f"1 0 0 0.5{colors}\n2 0.1 0 0.4{colors}\n"),
       f"get the colors of the photographs that see them: {why}")
      for colors, why in (("", "its points have none"), (" 0 0 0", "its own are all black"),
                          (" 70000 0 -1", "its colors lie between -1 and 70000"))),
    (scannet, "pose/4.txt", content("nan " * 16), "1 photographs of"),
]  # fmt: skip


@pytest.mark.parametrize(("form", "file", "change", "said"), SAID)
def test_what_is_said(capture: Path, form: Form, file: str, change: Change, said: str, capsys: Printed) -> None:
    place = form(capture)
    data = capture if place.is_relative_to(capture) else place
    assert len(load_any(data).train_dataset) == 10 and said not in printed(capsys)
    options = change(place / file if file else place)
    load_any(data, **(options if isinstance(options, dict) else {}))
    assert printed(capsys).count(said) == 1


@pytest.mark.parametrize("data", [".", "../room"])
@pytest.mark.parametrize("form", PHOTOGRAPHS)
def test_a_capture_is_read_from_within_as_from_elsewhere(
    capture: Path, form: Form, data: str, monkeypatch: Patch, capsys: Printed
) -> None:
    form(capture)
    (capture / "notes").mkdir()
    Image.new("RGB", (8, 8)).save(capture / "notes/board.png")
    monkeypatch.chdir(capture)
    assert len(load_any(Path(data)).train_dataset) == 10
    assert f"pictures of {Path(data) / 'notes'} that nothing names (board.png)" in printed(capsys)
