"""Initial points: of the capture, triangulated, or random."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from bitymi_ns.capture import known_poses, points
from bitymi_ns.capture.image_files import read_image
from bitymi_ns.capture.points import read_cloud
from bitymi_ns.capture.types import ColmapCamera, Photograph
from bitymi_ns.plugin.data.datamanager import BitymiDataManagerConfig
from bitymi_ns.plugin.data.dataparser import BitymiDataParserConfig
from bitymi_ns.sample.capture import camera_path, render
from bitymi_ns.sample.room import Room
from tests.captures import edit, edit_frames, load_any, printed, write_cloud
from tests.formats import PHOTOGRAPHS, blender, colmap, nerfstudio
from tests.plugin.data.test_true_captures import move
from tests.typed import Patch, Printed

SIZE = (200, 150)
TRIANGULATE = known_poses.triangulate  # before fixtures patch it


@pytest.fixture(scope="module")
def arc(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six photographs along an arc, with poses and without points."""
    folder = tmp_path_factory.mktemp("arc")
    (folder / "images").mkdir()
    room, frames = Room(0), []
    for i, view in enumerate(camera_path(60, *SIZE, seed=0)[:6]):
        Image.fromarray(render(room, view, supersample=2)).save(folder / f"images/{i}.png")
        pose = np.vstack([view.camera_to_world[:3], [0, 0, 0, 1]]).tolist()
        frames.append({"file_path": f"images/{i}.png", "transform_matrix": pose})
    camera = {"w": SIZE[0], "h": SIZE[1], "fl_x": view.focal, "fl_y": view.focal, "cx": SIZE[0] / 2, "cy": SIZE[1] / 2}
    (folder / "transforms.json").write_text(json.dumps({**camera, "camera_model": "OPENCV", "frames": frames}))
    return folder


@pytest.fixture
def triangulating(monkeypatch: Patch) -> None:
    monkeypatch.setattr("bitymi_ns.capture.known_poses.triangulate", TRIANGULATE)


@pytest.mark.slow
@pytest.mark.parametrize("mirrored", [False, True])
def test_points_are_triangulated_once(
    arc: Path, tmp_path: Path, triangulating: None, mirrored: bool, capsys: Printed
) -> None:
    capture = Path(shutil.copytree(arc, tmp_path / "arc"))
    if mirrored:
        turn = np.diag([1, -1, 1, 1])
        edit_frames(capture, lambda frame: frame.update(transform_matrix=(turn @ frame["transform_matrix"]).tolist()))
    outputs = load_any(capture, eval_interval=6).train_dataparser_outputs
    points = outputs.metadata["points3D_xyz"].double()
    transform, scale = outputs.dataparser_transform, outputs.dataparser_scale
    there = ((points / scale - transform[:, 3]) @ transform[:, :3]).numpy() * [1, -1 if mirrored else 1, 1]
    assert len(there) > 30 and ((there > [-3.1, -2.6, -0.1]) & (there < [3.1, 2.6, 2.7])).all(1).mean() > 0.8
    assert outputs.metadata["points3D_rgb"].float().std() > 10
    text = printed(capsys)
    assert "has no points: they are triangulated, once" in text and "splatfacto" not in text
    assert list((capture / ".bitymi").glob("points-*/points"))


@pytest.mark.slow
def test_masked_pixels_give_no_points(arc: Path, tmp_path: Path, triangulating: None) -> None:
    capture = Path(shutil.copytree(arc, tmp_path / "arc"))
    mask = np.zeros((SIZE[1], SIZE[0]), np.uint8)
    mask[: SIZE[1] // 2] = 255
    Image.fromarray(mask).save(capture / "mask.png")
    edit_frames(capture, lambda frame: frame.update(mask_path="mask.png"))
    outputs = load_any(capture, eval_interval=6).train_dataparser_outputs
    camera = outputs.cameras[0]
    pose = camera.camera_to_worlds.double()
    local = (outputs.metadata["points3D_xyz"].double() - pose[:, 3]) @ pose[:, :3]
    rows = float(camera.cy) - float(camera.fy) * local[:, 1] / -local[:, 2]
    assert len(local) > 10 and float((rows < 0.55 * SIZE[1]).double().mean()) > 0.9


def test_what_cannot_be_triangulated(arc: Path, tmp_path: Path, triangulating: None, capsys: Printed) -> None:
    capture = Path(shutil.copytree(arc, tmp_path / "arc"))
    for i in range(6):
        Image.new("RGB", SIZE, (40 * i, 0, 0)).save(capture / f"images/{i}.png")
    assert "points3D_xyz" not in load_any(capture).train_dataparser_outputs.metadata
    assert "only 0 points can be triangulated from the given poses" in (text := printed(capsys))
    assert "the photographs share hardly any detail, 0 matches in all" in text and "belong" not in text
    assert "Training starts from random points." in text


@pytest.fixture
def asked(monkeypatch: Patch) -> list[list[Photograph]]:
    """Record the arguments of a stubbed triangulation, which returns two points."""
    calls: list[list[Photograph]] = []

    def triangulate(home: Path, views: list[Photograph], *told: Any) -> Path:
        calls.append(views)
        model = home / "triangulated"
        model.mkdir(exist_ok=True)
        (model / "cameras.txt").write_text("1 PINHOLE 48 36 40 40 24 18\n")
        (model / "images.txt").write_text("1 1 0 0 0 0 0 0 1 a.png\n\n")
        (model / "points3D.txt").write_text("1 0 0 0.5 200 10 10 0.5\n2 0.1 0 0.5 200 10 10 0.5\n")
        return model

    monkeypatch.setattr("bitymi_ns.capture.known_poses.triangulate", triangulate)
    return calls


@pytest.mark.parametrize("form", PHOTOGRAPHS)
def test_every_format_without_points(capture: Path, form: Any, asked: list[Any], capsys: Printed) -> None:
    place = form(capture)
    if form is colmap:
        (place / "points3D.txt").unlink()
    elif form is not blender:
        edit(place, lambda meta: meta.update(ply_file_path=None) if form is nerfstudio else meta)
    assert len(load_any(capture).train_dataparser_outputs.metadata["points3D_xyz"]) == 2
    (views,) = asked
    assert "2 points have been triangulated" in (text := printed(capsys))
    assert "few for 12 photographs, which share little detail: `bitymi-data --points random`" in text
    assert len(views) == 12 and views[3].camera.model == "PINHOLE" and views[3].camera.size == (48, 36)
    assert "points3D_xyz" not in load_any(capture, points="random").train_dataparser_outputs.metadata
    config = BitymiDataManagerConfig(data=capture, dataparser=BitymiDataParserConfig())
    for mode in ("test", "inference"):  # the scene exists already
        assert "points3D_xyz" not in config.setup(device="cpu", test_mode=mode).train_dataparser_outputs.metadata
    assert len(asked) == 1


@pytest.mark.parametrize("form", PHOTOGRAPHS)
def test_triangulated_points_instead_of_those_of_the_capture(capture: Path, form: Any, asked: list[Any]) -> None:
    place = form(capture)
    move(place, np.zeros(3))
    load_any(capture)
    before = len(asked)
    load_any(capture, points="triangulate")
    assert len(asked) == before + 1


@pytest.mark.parametrize("form", [nerfstudio, blender])
def test_a_cloud_that_nothing_names(capture: Path, form: Any, asked: list[Any], capsys: Printed) -> None:
    """The triangulated points lie on a plane."""
    place = form(capture)
    edit(place, lambda meta: meta.pop("ply_file_path", None))
    (capture / "sparse_pc.ply").unlink()
    middle = np.mean([frame["transform_matrix"] for frame in json.loads(place.read_text())["frames"]], 0)[:3, 3]
    grid = np.linspace(-1, 1, 21)  # triangulated points are made relative to the cameras' middle
    right, other = (np.stack(np.meshgrid(grid, grid, [z]), -1).reshape(-1, 3) + middle for z in (0.5, 0.6))
    (capture / "a.ply").write_text("ply\n")
    write_cloud(capture / "b.ply", other)
    assert len(load_any(capture).train_dataparser_outputs.metadata["points3D_xyz"]) == 2
    text = printed(capsys)
    assert f"Not used: the point cloud {capture}/a.ply cannot be read: not a PLY file." in text
    assert f"{capture}/b.ply, which nothing names, is not used: 0% of the triangulated points lie" in text
    write_cloud(capture / "c.ply", right)
    assert len(load_any(capture).train_dataparser_outputs.metadata["points3D_xyz"]) == 441
    assert f"Training starts from the points of {capture}/c.ply, which nothing names: 100% of" in printed(capsys)
    given = load_any(capture, ply_path=Path("b.ply")).train_dataparser_outputs.metadata["points3D_xyz"]
    assert len(given) == 441 and "nothing names" not in printed(capsys)
    assert len(load_any(capture, points="triangulate").train_dataparser_outputs.metadata["points3D_xyz"]) == 2


def test_photographs_that_color_points_are_read_reduced(tmp_path: Path, monkeypatch: Patch) -> None:
    Image.new("RGB", (1600, 1200), (10, 200, 30)).save(tmp_path / "a.jpg")
    sizes: list[Any] = []

    def read(path: Path, **how: Any) -> Image.Image:
        sizes.append(read_image(path, **how).size)
        return read_image(path, **how)

    monkeypatch.setattr(points, "read_image", read)
    camera = ColmapCamera("PINHOLE", 1600, 1200, (800.0, 800.0, 800.0, 600.0))
    ahead = points.Points(np.array([[0.0, 0.0, -2.0], [0.1, 0.9, -2.0], [0.0, 0.0, 2.0]]), np.zeros((0, 3), np.uint8))
    found = points.color_points(ahead, [Photograph(tmp_path / "a.jpg", camera, np.eye(4), "a")]).rgb
    assert sizes == [(1000, 750)] and np.abs(found[:2].astype(int) - (10, 200, 30)).max() < 4
    assert (found[2] == points.GREY).all()


def test_points_without_colors_get_those_of_the_photographs(capture: Path, capsys: Printed) -> None:
    points = read_cloud(capture / "sparse_pc.ply", "")[0].xyz
    with_colors = load_any(capture).train_dataparser_outputs.metadata["points3D_rgb"].float()
    write_cloud(capture / "sparse_pc.ply", points, None)
    found = load_any(capture).train_dataparser_outputs.metadata["points3D_rgb"].float()
    assert (found - with_colors).abs().mean() < 0.5 * (128.0 - with_colors).abs().mean()
    assert "get the colors of the photographs that see them: its points have none." in printed(capsys)
    config = BitymiDataManagerConfig(data=capture, dataparser=BitymiDataParserConfig())
    assert len(config.setup(device="cpu", test_mode="test").train_dataparser_outputs.metadata["points3D_rgb"]) == 0
