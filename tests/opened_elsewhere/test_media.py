"""Films, pictures, packed bundles and camera paths, read by other programs."""

import json
import shutil
import subprocess
import zipfile
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("nerfstudio")

from nerfstudio.cameras.camera_paths import get_path_from_json

from bitymi_ns.bundle import read_bundle
from bitymi_ns.bundle.single import write_single
from bitymi_ns.plugin.run.films import film
from tests.view import conftest as made
from tests.view.browser import drive, served


def test_ffprobe_reads_a_film(tmp_path: Path) -> None:
    if shutil.which("ffprobe") is None:
        pytest.skip("no ffprobe: apt install ffmpeg")
    with film(tmp_path / "a.mp4", 24000 / 1001) as add:
        for shade in range(0, 240, 10):
            add(np.full((91, 120, 3), shade, np.uint8))
    command = ["ffprobe", "-v", "error", "-count_frames", "-show_streams", "-of", "json", str(tmp_path / "a.mp4")]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    (stream,) = json.loads(done.stdout)["streams"]
    assert not done.stderr and stream["codec_name"] == "h264" and stream["pix_fmt"] == "yuv420p"
    assert (stream["width"], stream["height"], stream["r_frame_rate"]) == (120, 90, "24000/1001")
    assert stream["nb_read_frames"] == "24" and stream["color_space"] == "bt709" and stream["color_range"] == "tv"


def test_pillow_and_zipfile_read_a_bundle(tmp_path: Path) -> None:
    folder = made.write(tmp_path / "b", poster=True, seen=True)
    pictures = [path for path in folder.iterdir() if path.suffix in (".jpg", ".png", ".webp")]
    assert {path.name for path in pictures} >= {"poster.webp", "photograph-0001.jpg"}
    for path in pictures:
        with Image.open(path) as picture:
            picture.load()
            assert min(picture.size) > 50 and picture.format in ("JPEG", "PNG", "WEBP")
    write_single(folder, tmp_path / "b.bitymi")
    with zipfile.ZipFile(tmp_path / "b.bitymi") as packed:
        assert packed.testzip() is None and {"bundle.json", "poster.webp"} <= {*packed.namelist()}
        for name in packed.namelist():
            assert packed.read(name) == (folder / name).read_bytes()
        packed.extractall(tmp_path / "again")
    assert len(read_bundle(tmp_path / "again").scene) == len(read_bundle(folder).scene)


def test_nerfstudio_reads_a_camera_path(page_bundle: Path, tmp_path: Path) -> None:
    from bitymi_ns.view import site_of

    file = tmp_path / "camera_path.json"
    steps = [["settle"], ["press", "#add-keyframe"], ["wheel", (60, 40), 200], ["settle"], ["press", "#add-keyframe"]]
    with served(site_of(page_bundle)) as address:
        found = drive([["goto", address], *steps, ["save", "#save-path", file]], viewport=(160, 120), drawn=False)
    assert not found.problems
    path = json.loads(file.read_text())
    cameras = get_path_from_json(path)
    assert len(cameras) == len(path["camera_path"]) == round(path["fps"] * path["seconds"])
    assert {cameras.width.unique().item(), cameras.height.unique().item()} == {160, 120}
    stated = np.array([frame["camera_to_world"] for frame in path["camera_path"]]).reshape(-1, 4, 4)
    assert np.allclose(cameras.camera_to_worlds.numpy(), stated[:, :3], atol=1e-6)
    focal = 0.5 * 120 / np.tan(np.radians([frame["fov"] for frame in path["camera_path"]]) / 2)
    assert np.allclose(cameras.fy.flatten().numpy(), focal, rtol=1e-5)
