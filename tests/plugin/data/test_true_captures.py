"""Captures that other programs misread or fail to read; each case in every format that can have it."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from nerfstudio.cameras.camera_utils import fisheye624_project
from PIL import Image
from scipy.spatial.transform import Rotation

from bitymi_ns.capture.colmap_model import read_model
from bitymi_ns.plugin.data.datamanager import BitymiDataManager, BitymiDataManagerConfig
from bitymi_ns.plugin.data.dataparser import BitymiDataParserConfig
from bitymi_ns.plugin.export.trained import world_of
from tests.captures import edit, expect, images_of, load_any, printed, save_masks, write_cloud
from tests.changes import matrices
from tests.formats import JSON, PHOTOGRAPHS, Form, blender, colmap, instant_ngp, nerfstudio
from tests.typed import Printed

UTM = np.array([500123.0, 4649876.0, 312.0])


def poses_of(manager: BitymiDataManager) -> np.ndarray:
    datasets = (manager.train_dataset, manager.eval_dataset)
    return np.concatenate([dataset.cameras.camera_to_worlds.numpy() for dataset in datasets])


# coordinates of a map


def move(place: Path, shift: np.ndarray) -> None:
    """Shift the capture, points included, away from the origin."""
    if place.is_dir():
        lines = (place / "images.txt").read_text().split("\n")
        for i, line in enumerate(lines[::2]):
            words = line.split()
            if words:
                turn = Rotation.from_quat(np.array(words[1:5], float)[[1, 2, 3, 0]])
                words[5:8] = map(str, np.array(words[5:8], float) - turn.apply(shift))
                lines[2 * i] = " ".join(words)
        (place / "images.txt").write_text("\n".join(lines))
        rows = [line.split() for line in (place / "points3D.txt").read_text().splitlines()]
        for row in rows:
            row[1:4] = map(str, np.array(row[1:4], float) + shift)
        (place / "points3D.txt").write_text("".join(" ".join(row) + "\n" for row in rows))
        return
    matrices(lambda pose: pose + np.outer([*shift, 0.0], [0.0, 0.0, 0.0, 1.0]))(place)
    write_cloud(place.parent / "sparse_pc.ply", np.array([[0, 0, 0.5], [0.1, 0, 0.5]]) + shift)


@pytest.mark.parametrize("centred", ["poses", "none"])
@pytest.mark.parametrize("form", PHOTOGRAPHS)
def test_coordinates_of_a_map(capture: Path, form: Form, centred: str, capsys: Printed) -> None:
    place = form(capture)
    move(place, np.zeros(3))
    fixed = form in (instant_ngp, blender)
    options: dict[str, Any] = {} if fixed else {"center_method": centred}
    if centred == "none" and not fixed:  # else the scale depends on where the origin is
        options["auto_scale_poses"] = False
    if form is blender:
        options["ply_path"] = Path("sparse_pc.ply")
    one = load_any(capture, **options)
    move(place, UTM)
    other = load_any(capture, **options)
    (a, p), (b, q) = ((poses_of(m), m.train_dataparser_outputs.metadata.get("points3D_xyz")) for m in (one, other))
    apart = [pose[:, :, 3] - pose[:, :, 3].mean(0) for pose in (a, b)]
    np.testing.assert_allclose(apart[0], apart[1], atol=1e-5)
    np.testing.assert_allclose(a[:, :, :3], b[:, :, :3], atol=1e-5)
    if p is not None and q is not None:
        np.testing.assert_allclose(p - a[:, :, 3].mean(0), q - b[:, :, 3].mean(0), atol=1e-5)
    # positions in the capture are kept to less than a hundredth of a unit, seven digits before the point
    for manager, offset in ((one, np.zeros(3)), (other, UTM)):
        world = world_of(manager).described()
        transform = np.asarray(world["transform"], float)
        found = world["scale"] * (transform[:, :3] @ (offset + [0, 0, 0.5]) + transform[:, 3])
        points = manager.train_dataparser_outputs.metadata.get("points3D_xyz")
        if points is not None:
            np.testing.assert_allclose(found, points[0], atol=1e-5)
        outputs = manager.train_dataparser_outputs
        back = outputs.transform_poses_to_original_space(outputs.cameras.camera_to_worlds)
        assert np.abs(back[:, :, 3].numpy().mean(0) - offset).max() < 10.0
    moved = "too far for float32: their middle becomes the origin" in printed(capsys)
    assert moved is (centred == "none" or fixed)


# entries of a camera


CAMERA = {"w": 40, "h": 30, "fl_x": 44.0, "fl_y": 46.0, "cx": 21.0, "cy": 14.0}


@pytest.mark.parametrize("at_top", [True, False])
@pytest.mark.parametrize("form", JSON)
def test_every_entry_of_a_camera_is_used(capture: Path, form: Form, at_top: bool) -> None:
    """Blender's own export has them beside camera_angle_x, which is of the longer side."""
    place = form(capture)

    def change(meta: dict[str, Any]) -> None:
        for key in (*CAMERA, "k1", "k2", "p1", "p2", "camera_model"):
            meta.pop(key, None)
        meta["camera_angle_x"] = 1.0
        for holder in [meta] if at_top else meta["frames"]:
            holder.update(CAMERA)

    edit(place, change)
    for path in images_of(capture):
        Image.open(path).resize((40, 30)).save(path)
    cameras = load_any(place).train_dataset.cameras
    found = [cameras.width, cameras.height, cameras.fx, cameras.fy, cameras.cx, cameras.cy]
    assert [float(column[3]) for column in found] == list(CAMERA.values())


FISHEYE = {"camera_model": "OPENCV_FISHEYE", "fl_x": 14.0, "fl_y": 14.0, "k1": 0.01, "k4": 0.001}


@pytest.mark.parametrize("which", ["all frames", "some frames", "top"])
@pytest.mark.parametrize("form", JSON)
def test_a_camera_model_wherever_it_stands(capture: Path, form: Form, which: str, capsys: Printed) -> None:
    place = form(capture)

    def change(meta: dict[str, Any]) -> None:
        meta.pop("camera_model", None)
        holders = {"all frames": meta["frames"], "some frames": meta["frames"][::2], "top": [meta]}
        for holder in holders[which]:
            holder.update(FISHEYE)

    edit(place, change)
    manager = load_any(place)
    lenses = [lens for data in (manager.train_dataset, manager.eval_dataset) for lens in data.facts.lenses]
    fisheyes = [lens for lens in lenses if lens.camera.model == "OPENCV_FISHEYE"]
    assert len(fisheyes) == (6 if which == "some frames" else 12)
    assert fisheyes[0].camera.params[4:] == (0.01, 0.0, 0.0, 0.001)
    assert "is OPENCV_FISHEYE: its photographs become pinhole pictures (" in printed(capsys)


def test_aria_s_camera(capture: Path) -> None:
    """FISHEYE624 is COLMAP's RAD_TAN_THIN_PRISM_FISHEYE: both map rays to the same pixels."""
    params = [0.02, -0.01, 0.004, 0.001, -0.0005, 0.0001, 0.002, -0.001, 0.0015, -0.0007, 0.0004, 0.0003]
    camera = {"camera_model": "FISHEYE624", "fl_x": 20.0, "fl_y": 20.0, "distortion_params": params}
    edit(capture, lambda meta: meta.update(camera))
    lens = load_any(capture).train_dataset.facts.lenses[0]
    assert lens.camera.model == "RAD_TAN_THIN_PRISM_FISHEYE"
    rays = torch.tensor([[0.1, 0.2, 1.0], [-0.5, 0.3, 1.0], [0.4, -0.6, 1.0]])
    theirs = fisheye624_project(rays[None], torch.tensor([[20.0, *lens.camera.params[2:4], *params]]))[0]
    ours = lens.camera.colmap.img_from_cam(rays.numpy())
    np.testing.assert_allclose(ours, theirs.numpy(), atol=1e-3)


def test_a_frame_with_a_camera_of_its_own(capture: Path) -> None:
    path = images_of(capture)[5]
    Image.open(path).resize((96, 72)).save(path)
    own = {"w": 96, "h": 72, "fl_x": 80.0, "fl_y": 81.0, "cx": 48.0, "cy": 36.0, "k1": 0.01}
    edit(capture, lambda meta: meta["frames"][5].update(own))
    manager = load_any(capture)
    train = manager.train_dataset
    index = train.image_filenames.index(path)
    assert train.facts.lenses[index].camera.size == (96, 72) and int(train.cameras.width[index - 1]) == 48
    assert float(train.cameras.fy[index]) == 81.0 and float(train.cameras.fy[index - 1]) != 81.0
    assert [lens.distorts for lens in train.facts.lenses[index - 1 : index + 1]] == [False, True]
    assert len(manager.cached_train) == 10


# names of photographs


def test_names_of_a_model_that_lead_elsewhere_are_those_of_photographs_in_the_capture(
    project: Path, tmp_path: Path, capsys: Printed
) -> None:
    images = project / "sparse/0/images.txt"
    text = images.read_text()
    images.write_text(text.replace("frame_00004.png", "../../frame_00004.png"))
    assert len(load_any(project, eval_mode="all").train_dataset) == 12
    assert "frame_00004.png for ../../frame_00004.png" in printed(capsys)
    elsewhere = tmp_path / "elsewhere/private.png"
    elsewhere.parent.mkdir()
    Image.new("RGB", (48, 36)).save(elsewhere)
    for name in (str(elsewhere), "../../elsewhere/private.png", "..\\..\\elsewhere\\private.png"):
        images.write_text(text.replace("frame_00004.png", name))
        with expect(r"(?s)1 of 12 photographs of .* are missing:.*private.png"):
            load_any(project)


@pytest.mark.parametrize("form", [nerfstudio, colmap])
def test_a_name_as_long_as_the_system_allows(capture: Path, form: Form) -> None:
    place = form(capture)
    file = place / "images.txt" if place.is_dir() else place
    path = images_of(capture)[0]
    named = path.rename(path.with_name("a" * 251 + ".png"))
    file.write_text(file.read_text().replace(path.name, named.name))
    save_masks(capture, 255)
    assert "mask" in load_any(capture).cached_train[0]


# files of a model, and sizes


@pytest.mark.parametrize("empty", [None, "", "# 3D point list\n\n"])
def test_points_of_a_model_in_a_ply_file_alone(project: Path, empty: str | None) -> None:
    (project / "sparse/0/points3D.txt").unlink()
    if empty is not None:
        (project / "sparse/0/points3D.txt").write_text(empty)
    assert read_model(project / "sparse/0").xyz.shape == (0, 3)
    path = project / "sparse/0/points3D.ply"
    write_cloud(path, [[0, 0, 0.5], [0.1, 0, 0.5]])
    metadata = load_any(project).train_dataparser_outputs.metadata
    assert metadata["points3D_rgb"].tolist() == [[200, 10, 10]] * 2
    path.write_text("\n".join(path.read_text().splitlines()[:-2]) + "\n")
    with expect("the point cloud .*points3D.ply cannot be read: it is cut off: it has 0 of 2 rows"):
        load_any(project)


@pytest.mark.parametrize("form", PHOTOGRAPHS)
def test_reduced_as_they_are_read(capture: Path, form: Form) -> None:
    """`--downscale-factor` without a folder of reduced copies is the same for every format."""
    manager = load_any(form(capture), downscale_factor=2)
    assert manager.cached_train[0]["image"].shape == (18, 24, 3)
    assert int(manager.train_dataset.cameras.width[0]) == 24


@pytest.mark.parametrize("form", PHOTOGRAPHS)
def test_what_needs_no_photographs_opens_none(capture: Path, form: Form) -> None:
    form(capture)
    for path in images_of(capture):
        path.unlink()
    config = BitymiDataManagerConfig(data=capture, dataparser=BitymiDataParserConfig())
    assert len(config.setup(device="cpu", test_mode="inference").train_dataset) == 10


# Blender's files


@pytest.mark.parametrize("lacking", ["all", "some"])
def test_held_out_views_of_blender_without_photographs(capture: Path, lacking: str, capsys: Printed) -> None:
    place = blender(capture)
    meta = json.loads(place.read_text())
    frames, test = meta["frames"][:8], meta["frames"][8:]
    place.write_text(json.dumps({**meta, "frames": frames}))
    for frame in test if lacking == "all" else test[1:]:
        frame["file_path"] = f"./test/r_{frame['file_path'][-5:-4]}"
    (capture / "transforms_test.json").write_text(json.dumps({**meta, "frames": test}))
    manager = load_any(capture)
    assert (len(manager.train_dataset), len(manager.eval_dataset)) == ((7, 1) if lacking == "all" else (8, 1))
    text = printed(capsys)
    what = "all" if lacking == "all" else "3"
    assert f"transforms_test.json lacks {what} of its 4 photographs, left out: {capture}/test/r_" in text


# another unit


@pytest.mark.parametrize("form", [instant_ngp, blender])
def test_millimetres_where_the_format_has_no_scale(capture: Path, form: Form, capsys: Printed) -> None:
    path = form(capture)
    load_any(capture)
    assert "of this format usually lie" not in printed(capsys)
    matrices(lambda pose: pose + np.outer(pose[:, 3] * [999, 999, 999, 0], [0, 0, 0, 1]))(path)
    manager = load_any(capture)
    assert "units from their middle, where those of this format usually lie" in (text := printed(capsys))
    assert "they are scaled by 0.0" in text
    box = float(manager.train_dataset.scene_box.aabb[1, 0])
    centers = manager.train_dataset.cameras.camera_to_worlds[:, :, 3]
    assert 1.0 < float((centers - centers.mean(0)).norm(dim=1).median()) / box < 4.0
    parser = manager.dataparser
    original = parser.outputs["train"].transform_poses_to_original_space(manager.train_dataset.cameras.camera_to_worlds)
    assert original[:, :, 3].abs().max() > 1000.0
    if form is blender:
        load_any(capture, scale_factor=0.5)
        assert "of this format usually lie" not in printed(capsys)
