"""Masks beside the photographs of any capture are used, with a message how to ignore them; unused ones are reported."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tests.captures import add_masks, edit, edit_frames, expect, images_of, load_any, printed, save_masks
from tests.formats import Form, colmap, instant_ngp, nerfstudio, polycam
from tests.typed import Patch, Printed

LEFT = np.uint8(np.arange(48) < 24)[None].repeat(36, 0) * 255


def blender(capture: Path) -> Path:
    """Photographs in `train`, with masks in `masks/train`."""
    edit(capture, lambda meta: (meta.pop("ply_file_path"), meta.update(camera_angle_x=1.0)))
    edit_frames(capture, lambda f: f.update(file_path=f["file_path"].replace("images", "train")))
    (capture / "images").rename(capture / "train")
    (capture / "transforms.json").rename(capture / "transforms_train.json")
    if (capture / "masks").is_dir():
        (capture / "masks").rename(capture / "train masks")
        (capture / "masks").mkdir()
        (capture / "train masks").rename(capture / "masks/train")
    return capture


def scanned(capture: Path) -> Path:
    folder = polycam(capture)
    if (capture / "masks").is_dir():
        shutil.copytree(capture / "masks", folder / "keyframes/masks")
        for i, path in enumerate(sorted((folder / "keyframes/masks").iterdir())):
            path.rename(path.with_name(f"{i}.png"))
    return folder


@pytest.mark.parametrize("form", [nerfstudio, instant_ngp, blender, colmap, scanned])
def test_a_folder_of_masks_beside_the_photographs(capture: Path, form: Form, capsys: Printed) -> None:
    save_masks(capture, LEFT)
    place = form(capture)
    place = capture if form is colmap else place
    mask = load_any(place).cached_train[0]["mask"]
    assert mask[:, :24].all() and not mask[:, 24:].any()
    assert "`bitymi-data --use-masks False` leaves masks out" in (text := printed(capsys)) and "masks" in text
    assert "Not taken for photographs" not in text or "masks (" not in text
    assert "mask" not in load_any(place, use_masks=False).cached_train[0]
    assert "masks (masks: 12; `bitymi-data --masks-path` uses them)" in printed(capsys)


@pytest.mark.parametrize("form", [nerfstudio, instant_ngp])
def test_masks_of_instant_ngp(capture: Path, form: Any, capsys: Printed) -> None:
    """They are white on moving objects; a photograph without one is not masked."""
    form(capture)
    for path in images_of(capture)[2:4]:
        Image.fromarray(LEFT).save(path.with_name(f"dynamic_mask_{path.stem}.png"))
    train = load_any(capture).cached_train
    of = {int(batch["image_idx"]): batch["mask"] for batch in train}
    assert of[0].all() and not of[1][:, :24].any() and of[1][:, 24:].all()
    text = printed(capsys)
    used = "masks dynamic_mask_frame_00003.png and 1 more beside 12 photographs are used, of which black counts"
    assert f"{used}; `bitymi-data" in text
    assert "Not taken" not in text
    train = load_any(capture, use_masks=False).cached_train
    assert "mask" not in train[0] and "(a mask of instant-ngp)" in printed(capsys)


def test_a_folder_with_some_of_the_masks_or_of_something_else(capture: Path, capsys: Printed) -> None:
    save_masks(capture, LEFT)
    (capture / "masks/frame_00003.png").unlink()
    with expect("has no mask of frame_00003.png. .*--use-masks False"):
        load_any(capture)
    for path in sorted((capture / "masks").iterdir())[1:]:
        path.unlink()
    next((capture / "masks").iterdir()).rename(capture / "masks/mask.png")  # ns-process-data's name for a common mask
    assert "mask" not in load_any(capture).cached_train[0]
    assert "Not taken for photographs" in (text := printed(capsys)) and "masks (masks: 1; " in text


def test_masks_are_checked_before_points_are_triangulated(capture: Path, monkeypatch: Patch) -> None:
    add_masks(capture, 255)
    edit(capture, lambda meta: meta.pop("ply_file_path"))
    monkeypatch.setattr("bitymi_ns.capture.read._Reader._points", None)  # not reached
    mask = capture / "masks/frame_00004.png"
    for spoil, message in (
        (
            lambda: Image.new("L", (36, 48)).save(mask),
            "04.png is turned .* it has 36 x 48 pixels.*--use-masks False",
        ),
        (lambda: mask.write_text("x"), "the mask .*frame_00004.png cannot be read"),
        (mask.unlink, r"1 of 12 masks .* are missing: .*frame_00004.png. Put them there, .*--use-masks False"),
    ):
        spoil()
        with expect(message):
            load_any(capture)
    colmap(capture)
    with expect("has no mask of frame_00004.png"):
        load_any(capture)


@pytest.mark.parametrize("form", [nerfstudio, instant_ngp, blender, colmap])
def test_pictures_that_nothing_names_are_named(capture: Path, form: Form, capsys: Printed) -> None:
    place = form(capture)
    place = capture if form is colmap else place
    folder = next(path for path in (capture / "images", capture / "train") if path.is_dir())
    for name in ("extra.png", "deeper/other.png"):
        (folder / name).parent.mkdir(exist_ok=True)
        Image.new("RGB", (8, 8)).save(folder / name)
    (capture / "scene").mkdir()
    (capture / "scene/bundle.json").write_text(json.dumps({"format": "bitymi-bundle"}))
    for name in ("depth/1.png", "notes/board.png", "notes/deep/board.png", "scene/preview.jpg"):
        (capture / name).parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (8, 8)).save(capture / name)
    load_any(place)
    text = printed(capsys)
    for part in ("depth (depth maps: 1)", "scene (pictures of a bundle: 1)", "/notes that nothing names (board.png)"):
        assert part in text, part
    assert ("are left out: extra.png" if form is colmap else "that nothing names (extra.png)") in text
    assert "deeper that nothing names (other.png)" in text
    reduced = capture / "images_2"
    if form is nerfstudio:
        reduced.mkdir()
        for path in images_of(capture):
            Image.open(path).resize((24, 18)).save(reduced / path.name)
        load_any(place, downscale_factor=2)
        assert "images_2" not in printed(capsys)
        load_any(place)
        assert "images_2 (reduced copies: 13; `bitymi-data --downscale-factor` uses them)" in printed(capsys)


@pytest.mark.parametrize("place", ["masks\\", "/home/me/room/masks/", "D:\\room\\Masks\\"])
def test_masks_by_their_names_on_another_machine(capture: Path, place: str) -> None:
    save_masks(capture, lambda i: 255 if i else 0)
    edit_frames(capture, lambda frame: frame.update(mask_path=f"{place}{Path(frame['file_path']).stem}.PNG"))
    manager = load_any(capture)
    assert manager.train_dataset.get_data(0)["mask"].all()
    assert len(manager.eval_dataset) == 1  # the mask of the first photograph, which is held out, is black


def test_masks_of_photographs_without_a_pose_are_nothing_to_speak_of(project: Path, capsys: Printed) -> None:
    images = project / "sparse/0/images.txt"
    images.write_text(images.read_text().partition("\n\n")[2])
    for folder, ending in (("images", "_mask.png"), ("masks", ".png")):
        for path in images_of(project)[:12]:
            (project / folder).mkdir(exist_ok=True)
            Image.fromarray(LEFT).save(project / folder / f"{path.stem}{ending}")
        load_any(project)
        assert "are used, of which black" in (text := printed(capsys)) and "Not taken for photographs" not in text
        for path in project.glob("images/*_mask.png"):
            path.unlink()
