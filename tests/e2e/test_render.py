"""A bundle's camera path, rendered on the bundle and on its run; a dataset as pictures."""

import gzip
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from nerfstudio.cameras.camera_paths import get_path_from_json
from nerfstudio.scripts import render
from PIL import Image

from bitymi_ns.bundle import read_bundle
from bitymi_ns.plugin.data.cameras import to_cameras
from bitymi_ns.plugin.run.config import BitymiTrainerConfig as Run
from bitymi_ns.scene.baked import as_bytes


@pytest.fixture
def camera_path(bundle: Path, tmp_path: Path) -> Path:
    """The bundle's cameras as nerfstudio's camera path: row-major camera to world, x right, y up, z backward."""
    frames = []
    for row in read_bundle(bundle).cameras:
        pose = torch.linalg.inv(row.camera.viewmat.double()) @ torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0])).double()
        fov = 2 * np.degrees(np.arctan(row.camera.height / 2 / float(row.camera.K[1, 1])))
        frames.append({"camera_to_world": pose.flatten().tolist(), "fov": fov, "aspect": 4 / 3})
    path = {"render_width": 48, "render_height": 36, "seconds": 1.0, "fps": len(frames), "camera_path": frames}
    (tmp_path / "path.json").write_text(json.dumps(path))
    return tmp_path / "path.json"


def test_bundle_and_run_share_a_camera_path(bundle: Path, trained: Run, camera_path: Path, tmp_path: Path) -> None:
    pictures = {}
    for name, folder in (("bundle", bundle), ("run", trained.get_base_dir())):
        options = {"output_path": tmp_path / name, "output_format": "images", "image_format": "png"}
        render.RenderCameraPath(load_config=folder / "config.yml", camera_path_filename=camera_path, **options).main()
        files = sorted((tmp_path / name).iterdir())
        pictures[name] = np.stack([np.array(Image.open(file)) for file in files]).astype(int)
    scene = read_bundle(bundle)
    # the path as read, in float32, which alone changes values near an edge by more than 2
    cameras = to_cameras(get_path_from_json(json.loads(camera_path.read_text())), "cpu")
    for camera, row in zip(cameras, scene.cameras, strict=True):
        torch.testing.assert_close(camera.viewmat, row.camera.viewmat, rtol=1e-5, atol=1e-5)
        torch.testing.assert_close(camera.K, row.camera.K, rtol=1e-5, atol=1e-5)
    drawn = np.stack([as_bytes(scene.render(camera).rgb).numpy() for camera in cameras]).astype(int)
    # a path has no principal point; the room's cameras have it in the middle
    assert np.abs(pictures["bundle"] - drawn).max() <= 2
    error = ((pictures["run"] - pictures["bundle"]) ** 2).mean()
    assert 10 * np.log10(255**2 / error) > 30
    assert np.abs(drawn[0] - drawn[5]).mean() > 2  # cameras differ


def test_pictures_of_a_dataset(bundle: Path, tmp_path: Path) -> None:
    names = ["rgb", "rgba", "raw-depth"]
    options = dict(rendered_output_names=names, image_format="png")
    render.DatasetRender(load_config=bundle / "config.yml", output_path=tmp_path / "maps", **options).main()
    files = sorted(path.relative_to(tmp_path / "maps" / "test") for path in (tmp_path / "maps").rglob("*.*"))
    assert len(files) == 6 and not [path for path in files if path.name.startswith(".")]
    rgb, rgba = (np.array(Image.open(tmp_path / "maps" / "test" / n / "frame_00001.png")) for n in names[:2])
    assert rgb.shape == (36, 48, 3) and rgba.shape == (36, 48, 4)
    (packed, _) = sorted((tmp_path / "maps" / "test" / "raw-depth").iterdir())
    with gzip.open(packed) as file:
        depth = np.load(file)
    assert depth.shape == (36, 48, 1) and depth.min() > 0
