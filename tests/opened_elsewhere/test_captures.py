"""Captures by `bitymi sfm` and `bitymi sample`, read by pycolmap, plyfile, Pillow and nerfstudio's parser."""

import json
from pathlib import Path

import numpy as np
import plyfile
import pycolmap
import pytest
import torch
from PIL import Image

pytest.importorskip("nerfstudio")

from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig

from bitymi_ns.cli import main
from bitymi_ns.sample import generate


@pytest.fixture(scope="module")
def sample(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return generate(tmp_path_factory.mktemp("sample") / "room", views=6, width=80, height=60, points=300)


@pytest.fixture(scope="module")
def found(arc: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sfm") / "capture"
    assert main(["sfm", str(arc), "--output", str(folder), "--max-features", "400"]) == 0
    return folder


@pytest.fixture(params=["sample", "found"])
def capture(request: pytest.FixtureRequest) -> Path:
    return request.getfixturevalue(request.param)


def test_nerfstudio_reads_the_poses(capture: Path) -> None:
    meta = json.loads((capture / "transforms.json").read_text())
    options = dict(orientation_method="none", center_method="none", auto_scale_poses=False, eval_mode="all")
    read = NerfstudioDataParserConfig(data=capture, load_3D_points=True, **options).setup().get_dataparser_outputs()
    by_name = {Path(frame["file_path"]).name: frame["transform_matrix"] for frame in meta["frames"]}
    stated = torch.tensor([by_name[path.name] for path in read.image_filenames])
    # the dataparser rotates the world and states the transform
    turn = read.dataparser_transform @ torch.eye(4)
    expected = turn[:, :3] @ stated[:, :3, :3], stated[:, :3, 3] @ turn[:, :3].T + turn[:, 3]
    assert torch.allclose(read.cameras.camera_to_worlds[:, :, :3], expected[0], atol=1e-5)
    assert torch.allclose(read.cameras.camera_to_worlds[:, :, 3], expected[1], atol=1e-5)
    assert len(read.metadata["points3D_xyz"]) > 50
    for path, width in zip(read.image_filenames, read.cameras.width.flatten().tolist(), strict=True):
        with Image.open(path) as picture:
            picture.load()
            assert picture.width == width


def test_plyfile_reads_the_points(capture: Path) -> None:
    vertex = plyfile.PlyData.read(capture / "sparse_pc.ply")["vertex"]
    assert vertex.count > 50 and {"x", "y", "z", "red", "green", "blue"} <= {each.name for each in vertex.properties}
    assert np.isfinite(np.column_stack([vertex[name] for name in "xyz"])).all()


def test_pycolmap_reads_the_model_that_stands_in_transforms(found: Path) -> None:
    model = pycolmap.Reconstruction(found / "sparse" / "0")
    meta = json.loads((found / "transforms.json").read_text())
    assert model.num_reg_images() == len(meta["frames"]) and model.num_points3D() > 50
    images = {image.name: image for image in model.images.values()}
    for frame in meta["frames"]:
        pose = images[Path(frame["file_path"]).name].cam_from_world().inverse().matrix()
        assert np.allclose(np.array(frame["transform_matrix"])[:3] * (1, -1, -1, 1), pose, atol=1e-9)
