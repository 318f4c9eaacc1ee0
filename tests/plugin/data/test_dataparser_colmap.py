"""The presets' parser: what it makes of COLMAP models."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.datamanagers.full_images_datamanager import _undistort_image
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from PIL import Image

from bitymi_ns.plugin.data.colmap_model import read_model
from bitymi_ns.train.views import View
from tests.plugin.data.captures import (
    as_binary,
    expect,
    images_of,
    load_any,
    mixed_project,
    printed,
    reduce_photographs,
    save_masks,
)
from tests.plugin.data.test_dataparser import sides
from tests.plugin.data.test_lens import camera_of

LEFT = 255 * (np.arange(48) < 24)


def change_model(project: Path, file: str, *changes: tuple[str, str]) -> None:
    path = project / "sparse/0" / file
    text = path.read_text("utf8")
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path.write_text(text, "utf8")


@pytest.mark.parametrize(
    ("place", "binary"), [("sparse/0", False), ("colmap/sparse/0", True), ("sparse", False), (".", True)]
)
def test_poses_and_points_are_those_of_nerfstudios_parser(
    project: Path, place: str, binary: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    if binary:
        as_binary(project / "sparse/0")
    theirs = sides(ColmapDataParserConfig(data=project, colmap_path=Path("sparse/0"), downscale_factor=1).setup())
    (project / "sparse/0").rename(project / "model")
    (project / "sparse").rmdir()
    (project / place).mkdir(parents=True, exist_ok=True)
    for path in (project / "model").iterdir():
        path.rename(project / place / path.name)
    (project / "model").rmdir()
    capsys.readouterr()
    one = load_any(project)
    folder = str(project / place)
    assert (
        f"Reading COLMAP model {folder} (12 photographs, 1 PINHOLE camera, 2 points), photographs {project}/images."
    ) in printed(capsys)
    for a, b in zip(sides(one), theirs, strict=True):
        assert a.image_filenames == b.image_filenames
        assert torch.allclose(a.cameras.camera_to_worlds, b.cameras.camera_to_worlds, rtol=0, atol=2e-6)
        for column in ("fx", "fy", "cx", "cy", "width", "height"):
            assert torch.equal(getattr(a.cameras, column), getattr(b.cameras, column)), column
    assert a.dataparser_scale == pytest.approx(b.dataparser_scale, rel=1e-5)
    assert torch.allclose(a.dataparser_transform, b.dataparser_transform.double(), rtol=0, atol=2e-6)
    assert torch.allclose(a.metadata["points3D_xyz"], b.metadata["points3D_xyz"], rtol=0, atol=2e-6)
    assert torch.equal(a.metadata["points3D_rgb"], b.metadata["points3D_rgb"])


def test_the_transform_leads_back_to_the_models_frame(project: Path) -> None:
    manager = load_any(project)
    outputs = manager.train_dataparser_outputs
    model = read_model(project / "sparse/0")
    back = outputs.transform_poses_to_original_space(outputs.cameras.camera_to_worlds)
    for path, pose in zip(outputs.image_filenames, back, strict=True):
        image = next(image for image in model.images if image.name == path.name)
        rotation, place = pose[:, :3].double().numpy(), pose[:, 3].double().numpy()
        w2c = pycolmap.Rigid3d(pycolmap.Rotation3d(image.qvec[[1, 2, 3, 0]]), image.tvec)
        assert np.allclose(rotation.T, w2c.rotation.matrix(), atol=1e-5)
        assert np.allclose(-rotation.T @ place, image.tvec, atol=1e-4)


@pytest.fixture
def mixed(tmp_path: Path) -> Path:
    return mixed_project(tmp_path)


def test_cameras_of_several_kinds_and_sizes_in_one_capture(mixed: Path, capsys: pytest.CaptureFixture[str]) -> None:
    manager = load_any(mixed)
    text = printed(capsys)
    assert "(9 photographs, 1 OPENCV_FISHEYE and 1 PINHOLE and 1 SIMPLE_RADIAL cameras, 99 points)" in text
    assert "Camera 3 of " in text and "is OPENCV_FISHEYE: its photographs are used as pinhole pictures of 10" in text
    sizes = set()
    for views in (manager.train_views, manager.eval_views):
        for i in range(len(views)):
            view = views[i]
            assert isinstance(view, View) and view.image.shape[:2] == (view.camera.height, view.camera.width)
            sizes.add(tuple(view.image.shape[:2]))
    assert len(sizes) == 3 and (40, 30) in sizes
    assert manager.train_dataset.metadata["train_pixels"] == sum(
        view.image.shape[0] * view.image.shape[1] for view in manager.train_views
    )


def test_names_with_spaces_and_letters_of_all_kinds_are_whole_in_both_forms(mixed: Path) -> None:
    text = read_model(mixed / "sparse/0")
    as_binary_by_colmap(mixed / "sparse/0", text)
    binary = read_model(mixed / "sparse/0")
    assert [image.name for image in binary.images] == [image.name for image in text.images]
    assert binary.images[0].name == "cam1/IMG 0 \u00fc.jpg"
    assert binary.cameras == text.cameras
    for a, b in zip(binary.images, text.images, strict=True):
        assert np.allclose(a.qvec, b.qvec) and np.allclose(a.tvec, b.tvec)
    assert np.array_equal(np.sort(binary.xyz, 0), np.sort(text.xyz, 0)) and np.array_equal(binary.rgb, text.rgb)


def as_binary_by_colmap(folder: Path, model: Any) -> None:
    """Write a model as COLMAP's own library does."""
    whole = pycolmap.Reconstruction()
    for number, camera in model.cameras.items():
        given = pycolmap.Camera(model=camera.model, width=camera.width, height=camera.height, params=camera.params)
        given.camera_id = number
        whole.add_camera_with_trivial_rig(given)
    for number, image in enumerate(model.images, 1):
        one = pycolmap.Image(name=image.name, camera_id=image.camera_id, image_id=number)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(image.qvec[[1, 2, 3, 0]]), image.tvec)
        whole.add_image_with_trivial_frame(one, pose)
    for xyz, rgb in zip(model.xyz, model.rgb, strict=True):
        whole.add_point3D(xyz, pycolmap.Track(), rgb)
    for path in folder.iterdir():
        path.unlink()
    whole.write_binary(str(folder))


@pytest.mark.parametrize("model", ["FULL_OPENCV", "OPENCV_FISHEYE"])
def test_camera_models_of_colmap(project: Path, model: str) -> None:
    params = " ".join(map(str, camera_of(model, 40.0, (48, 36)).params))
    change_model(project, "cameras.txt", ("PINHOLE 48 36 40 40 24 18", f"{model} 48 36 {params}"))
    view = load_any(project).train_views[0]
    assert view.image.shape[:2] == (view.camera.height, view.camera.width) and view.image.float().std() > 1


def test_undistorted_as_nerfstudio_does_it(project: Path) -> None:
    """The same scene point has the same colour in both pictures; they differ in how much they crop alone."""
    change_model(
        project, "cameras.txt", ("PINHOLE 48 36 40 40 24 18", "OPENCV 48 36 40 41 23 19 0.08 -0.01 0.002 -0.001")
    )
    ours = load_any(project).train_views[3]
    path = load_any(project).train_dataset.image_filenames[3]
    K = np.array([[40.0, 0.0, 23.0], [0.0, 41.0, 19.0], [0.0, 0.0, 1.0]])
    camera = Cameras(torch.eye(4)[None, :3], 40.0, 41.0, 23.0, 19.0, 48, 36)[0]
    batch = {"image": torch.from_numpy(np.array(Image.open(path).convert("RGB")))}
    distortion = np.array([0.08, -0.01, 0.0, 0.0, 0.002, -0.001])
    K, image, _ = _undistort_image(camera, distortion, batch, batch["image"].numpy(), K)
    a, b = ours.camera, replace(ours.camera, K=torch.from_numpy(K))
    x, y = np.meshgrid(np.arange(8, 40, 2) + 0.5, np.arange(8, 28, 2) + 0.5)
    rays = np.stack([(x - float(a.K[0, 2])) / float(a.K[0, 0]), (y - float(a.K[1, 2])) / float(a.K[1, 1])], -1)
    there = rays * [float(b.K[0, 0]), float(b.K[1, 1])] + [float(b.K[0, 2]), float(b.K[1, 2])] - 0.5
    one = ours.image.numpy()[y.astype(int), x.astype(int)].astype(float)
    other = cv2.remap(image, there.astype(np.float32), None, cv2.INTER_LINEAR).astype(float)
    assert np.median(np.abs(one - other)) < 2.0 and np.abs(one - other).mean() < 5.0


# reduced photographs and masks


@pytest.mark.parametrize("size", [(10, 7), (9, 8), (10, 8)])
def test_reduced_photographs_are_used_as_they_are(project: Path, size: tuple[int, int]) -> None:
    reduce_photographs(project, 5, size)  # 48 x 36: sizes are rounded in more than one way
    manager = load_any(project, downscale_factor=5)
    assert manager.train_dataset.image_filenames[0].parent == project / "images_5"
    cameras, image = manager.train_dataset.cameras, manager.cached_train[0]["image"]
    assert image.shape[:2] == size[::-1]
    assert float(cameras.fx[0]) == pytest.approx(40 * size[0] / 48) and float(cameras.cy[0]) == size[1] / 2
    stored = np.asarray(Image.open(manager.train_dataset.image_filenames[0]).convert("RGB"))
    assert np.array_equal(image.numpy(), stored)  # and not scaled again


def test_reduced_photographs_of_another_size(project: Path) -> None:
    reduce_photographs(project, 4, (24, 18))
    with expect("images_4/frame_00001.png has 24 x 18 pixels, but its camera is for 48 x 36, of which 1/4 is 12 x 9"):
        load_any(project, downscale_factor=4)
    (project / "images_4/frame_00003.png").unlink()
    with expect(r"1 of 12 photographs of .* are missing:\s+.*images_4/frame_00003.png"):
        load_any(project, downscale_factor=4)


def test_photographs_are_reduced_where_no_folder_has_smaller_ones(
    project: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    manager = load_any(project, downscale_factor=2)
    assert f"photographs {project}/images, reduced 2 times as they are read" in printed(capsys)
    assert manager.cached_train[0]["image"].shape == (18, 24, 3)
    assert float(manager.train_dataset.cameras.fx[0]) == 20.0


@pytest.mark.parametrize(("ending", "reduction"), [(".png", 1), (".png.png", 2)])
def test_masks_beside_the_photographs(project: Path, ending: str, reduction: int) -> None:
    save_masks(project, LEFT, ending=ending)
    mask = load_any(project, downscale_factor=reduction).cached_train[0]["mask"]
    width = 48 // reduction
    assert mask.shape == (36 // reduction, width, 1) and mask[:, : width // 2].all() and not mask[:, width // 2 :].any()
    (project / f"masks/frame_00004{ending}").unlink()
    with expect("masks has no mask of frame_00004.png, but of others"):
        load_any(project)


def test_whole_masks_serve_reduced_photographs(project: Path) -> None:
    reduce_photographs(project, 2, (24, 18))
    save_masks(project, LEFT)
    mask = load_any(project, downscale_factor=2).cached_train[0]["mask"]
    assert mask.shape == (18, 24, 1) and mask[:, :12].all() and not mask[:, 12:].any()
    (project / "masks").rename(project / "masks_2")
    assert load_any(project, downscale_factor=2).cached_train[0]["mask"].shape == (18, 24, 1)
    with expect("the folder of masks .*/mine does not exist. Give it, seen from .*, with --masks-path"):
        load_any(project, masks_path=Path("mine"))


# what is wrong


def test_photographs_that_the_model_lacks_are_named(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("extra b.png", "extra a.png"):
        Image.new("RGB", (48, 36)).save(project / "images" / name)
    assert len(load_any(project).train_dataset) == 10
    assert "2 of 14 photographs have no pose in the model and are left out: extra a.png, extra b.png." in printed(
        capsys
    )


def test_photographs_of_the_model_that_are_not_there(project: Path) -> None:
    images_of(project)[3].unlink()
    with expect(r"1 of 12 photographs of .* are missing:\s+.*frame_00004.png"):
        load_any(project)
    for path in images_of(project):
        path.unlink()
    with expect("frame_00001.png, .* and 9 more, which are in none of the folders of .*--images-path"):
        load_any(project)


@pytest.mark.parametrize("name", ["input", "holiday 2024", "."])
def test_photographs_are_found_where_they_are(project: Path, name: str) -> None:
    for path in images_of(project):
        (project / name).mkdir(exist_ok=True)
        path.rename(project / name / path.name)
    assert load_any(project).train_dataset.image_filenames[0].parent == project / name
    with expect("the folder of photographs .*elsewhere does not exist"):
        load_any(project, images_path=Path("elsewhere"))


def test_the_model_itself_may_be_given(project: Path) -> None:
    for given in (project / "sparse/0", project / "sparse/0/cameras.txt"):
        assert load_any(given).train_dataset.image_filenames[0].parent == project / "images"


@pytest.mark.parametrize(
    ("file", "change", "message"),
    [
        ("cameras.txt", (" 40 40 24 18", " 40"), "cameras.txt: camera 1 has 1 parameters, but a PINHOLE has 4"),
        ("cameras.txt", ("PINHOLE", "PINHALE"), "cameras.txt has a line .*COLMAP has no camera model PINHALE"),
        ("cameras.txt", ("1 PIN", "7 PIN"), r"image 1 \(frame_00001.png\) was taken by camera 1, .* only 7"),
        ("cameras.txt", ("PINHOLE 48 36 40 40 24 18", "EQUIRECTANGULAR 48 36 48 36"), "EQUIR.*, but .*twice as wide"),
        ("cameras.txt", ("40 40 24", "nan 40 24"), "camera 1 .* has to be positive and all numbers finite"),
        (
            "cameras.txt",
            ("1 PINHOLE 48 36 40 40 24 18", "# a\n1 PINHOLE 48 36 40 40 24 inf"),
            r"line 2: camera 1 \(PINHOLE .* inf\) cannot be used",
        ),
        ("images.txt", ("_00002.png\n\n", "_00002.png\n1 2 3 4\n"), "images.txt has a line .*Each image has two lines"),
        ("images.txt", ("frame_00002", "frame_00001"), "images 1 and 2 are both of frame_00001.png"),
        ("points3D.txt", ("200", "red"), "points3D.txt has a line that cannot be read .*red"),
    ],
)
def test_models_that_cannot_be_used(project: Path, file: str, change: tuple[str, str], message: str) -> None:
    change_model(project, file, change)
    with expect(message):
        load_any(project)


@pytest.mark.parametrize("pose", ["nan 0 0 0 0 0 0", "0 0 0 0 1 2 3", "1 0 0 0 0 inf 0"])
def test_poses_that_are_none(project: Path, pose: str) -> None:
    path = project / "sparse/0/images.txt"
    lines = path.read_text().split("\n")
    lines[6] = f"4 {pose} 1 frame_00004.png"
    path.write_text("\n".join(lines))
    with expect(r"the pose of image 4 \(frame_00004.png\) is not finite, or its rotation is zero"):
        load_any(project)


@pytest.mark.parametrize("change", [lambda data: data[:-5], lambda data: data + b"more"])
@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
def test_binary_files_that_are_not_whole(project: Path, name: str, change: Any) -> None:
    as_binary(project / "sparse/0")
    path = project / "sparse/0" / name
    path.write_bytes(change(path.read_bytes()))
    with expect(f"{name} is cut off or damaged"):
        load_any(project)


def test_one_image_and_one_place(project: Path) -> None:
    path = project / "sparse/0/images.txt"
    lines = path.read_text().split("\n")
    same = [" ".join([*line.split()[:5], "0 0 0", *line.split()[8:]]) if line else "" for line in lines]
    path.write_text("\n".join(same))
    with expect("all cameras are at one place"):
        load_any(project)
    path.write_text("\n".join(lines[:2]) + "\n")
    with expect("has one image only"):
        load_any(project)
