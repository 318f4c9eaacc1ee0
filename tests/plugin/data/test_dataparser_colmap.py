"""The presets' dataparser on COLMAP models."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from PIL import Image

from bitymi_ns.train.views import View
from tests import captures
from tests.captures import as_binary, expect, images_of, load_any, printed, reduce_photographs, save_masks
from tests.plugin.data.test_dataparser import sides

LEFT = 255 * (np.arange(48) < 24)


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


@pytest.fixture
def mixed(tmp_path: Path) -> Path:
    return captures.mixed_project(tmp_path)


def test_cameras_of_several_kinds_and_sizes_in_one_capture(mixed: Path, capsys: pytest.CaptureFixture[str]) -> None:
    manager = load_any(mixed)
    text = printed(capsys)
    assert "(9 photographs, 1 OPENCV_FISHEYE and 1 PINHOLE and 1 SIMPLE_RADIAL cameras, 99 points)" in text
    assert "Camera 3 of " in text and "is OPENCV_FISHEYE: its photographs become pinhole pictures (" in text
    sizes = set()
    for views in (manager.train_views, manager.eval_views):
        for i in range(len(views)):
            view = views[i]
            assert isinstance(view, View) and view.image.shape[:2] == (view.camera.height, view.camera.width)
            sizes.add(tuple(view.image.shape[:2]))
    assert len(sizes) == 3 and (40, 30) in sizes
    assert manager.train_dataset.facts.train_pixels == sum(
        view.image.shape[0] * view.image.shape[1] for view in manager.train_views
    )


def test_renders_of_photographs_are_not_taken_for_them(project: Path) -> None:
    """They have the same names, in a folder that sorts first."""
    (project / "shots").mkdir()
    shutil.copytree(project / "images", project / "maps/test/rgb")
    (project / "maps/test/raw-depth").mkdir()
    (project / "images").rename(project / "shots/day")
    shown = load_any(project).train_dataset.image_filenames
    assert {path.parent for path in shown} == {project / "shots/day"}


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
    assert np.array_equal(image.numpy(), stored)  # not scaled again


@pytest.mark.parametrize(("ending", "reduction"), [(".png", 1), (".png.png", 2)])
def test_masks_beside_the_photographs(project: Path, ending: str, reduction: int) -> None:
    save_masks(project, LEFT, ending=ending)
    mask = load_any(project, downscale_factor=reduction).cached_train[0]["mask"]
    width = 48 // reduction
    assert mask.shape == (36 // reduction, width, 1) and mask[:, : width // 2].all() and not mask[:, width // 2 :].any()
    (project / f"masks/frame_00004{ending}").unlink()
    with expect("masks has no mask of frame_00004.png. "):
        load_any(project)


def test_whole_masks_serve_reduced_photographs(project: Path) -> None:
    reduce_photographs(project, 2, (24, 18))
    save_masks(project, LEFT)
    mask = load_any(project, downscale_factor=2).cached_train[0]["mask"]
    assert mask.shape == (18, 24, 1) and mask[:, :12].all() and not mask[:, 12:].any()
    (project / "masks").rename(project / "masks_2")
    assert load_any(project, downscale_factor=2).cached_train[0]["mask"].shape == (18, 24, 1)


@pytest.mark.parametrize(("place", "own"), [("dense/0/sparse", "dense/0/images"), ("distorted/sparse/0", "input")])
def test_pictures_that_belong_to_a_model(project: Path, place: str, own: str) -> None:
    """Others of the same names, of another lens, lie in `images`."""
    shutil.copytree(project / "sparse/0", project / place)
    shutil.copytree(project / "images", project / own)
    manager = load_any(project, colmap_path=Path(place))
    assert {path.parent for path in manager.train_dataset.image_filenames} == {project / own}
    assert {path.parent for path in load_any(project).train_dataset.image_filenames} == {project / "images"}


# what is wrong


def test_smaller_copies_alone(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    reduce_photographs(project, 2, (24, 18))
    shutil.rmtree(project / "images")
    assert load_any(project, downscale_factor=2).cached_train[0]["image"].shape[:2] == (18, 24)
    assert "Not taken for photographs" not in printed(capsys)


@pytest.mark.parametrize("name", ["input", "holiday 2024", "."])
def test_photographs_are_found_where_they_are(project: Path, name: str) -> None:
    for path in images_of(project):
        (project / name).mkdir(exist_ok=True)
        path.rename(project / name / path.name)
    assert load_any(project).train_dataset.image_filenames[0].parent == project / name


def test_the_model_itself_may_be_given(project: Path) -> None:
    for given in (project / "sparse/0", project / "sparse/0/cameras.txt"):
        assert load_any(given).train_dataset.image_filenames[0].parent == project / "images"
