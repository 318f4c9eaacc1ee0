"""The sample capture: exact geometry, correct pictures, readable by nerfstudio."""

import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from PIL import Image

from bitymi_ns.sample import generate
from bitymi_ns.sample.capture import camera_path, first_hits, look_at
from bitymi_ns.sample.room import FIRST as SPHERE
from bitymi_ns.sample.room import HIGH, LANDSCAPE, LOW, SOLIDS, Room

VIEWS, WIDTH, HEIGHT = 12, 160, 120


class Capture(NamedTuple):
    folder: Path
    meta: dict[str, Any]
    images: np.ndarray  # [VIEWS, HEIGHT, WIDTH, 3]
    points: np.ndarray  # [M, 3]
    colors: np.ndarray  # [M, 3] in [0, 1]


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    import open3d

    folder = tmp_path_factory.mktemp("sample") / "room"
    generate(folder, views=VIEWS, width=WIDTH, height=HEIGHT, points=3000)
    meta = json.loads((folder / "transforms.json").read_text())
    images = np.stack([np.asarray(Image.open(folder / frame["file_path"])) for frame in meta["frames"]])
    cloud = open3d.io.read_point_cloud(str(folder / "sparse_pc.ply"))
    return Capture(folder, meta, images, np.asarray(cloud.points), np.asarray(cloud.colors))


def test_files(capture: Capture) -> None:
    names = [frame["file_path"] for frame in capture.meta["frames"]]
    assert names[::11] == ["images/frame_00001.png", "images/frame_00012.png"]
    assert capture.images.shape == (VIEWS, HEIGHT, WIDTH, 3)
    assert (capture.meta["w"], capture.meta["h"]) == (WIDTH, HEIGHT)
    assert capture.points.shape == (3000, 3)
    assert sorted(path.name for path in capture.folder.parent.iterdir()) == ["room"], "nothing is left beside it"


def project(meta: dict, frame: int, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Project points to pixel x, y and depth, each [n], by textbook formulas from the file alone."""
    world_to_camera = np.linalg.inv(np.array(meta["frames"][frame]["transform_matrix"]))
    p = points @ world_to_camera[:3, :3].T + world_to_camera[:3, 3]
    depth = -p[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        return meta["cx"] + meta["fl_x"] * p[:, 0] / depth, meta["cy"] - meta["fl_y"] * p[:, 1] / depth, depth


def test_points_have_the_color_of_the_pixels_they_fall_on(capture: Capture) -> None:
    points, colors = capture.points, capture.colors
    room, path = Room(0), camera_path(VIEWS, WIDTH, HEIGHT, 0)
    agree, total = 0, 0
    for k in range(VIEWS):
        x, y, depth = project(capture.meta, k, points)
        index = np.flatnonzero((depth > 0) & (x >= 1) & (x < WIDTH - 1) & (y >= 1) & (y < HEIGHT - 1))
        x, y = x[index].astype(int), y[index].astype(int)
        seen, _, surfaces = first_hits(room, path[k], y * WIDTH + x)
        near = np.linalg.norm(seen - points[index], axis=1) < 0.03 * depth[index]
        plain = near & (surfaces != SPHERE)
        # 3 x 3 pixels, as a point may fall on the edge of a pattern
        pixels = [capture.images[k][y + dy, x + dx] / 255.0 for dy in (-1, 0, 1) for dx in (-1, 0, 1)]
        best = np.abs(pixels - colors[index]).max(axis=2).min(axis=0)
        agree += int((best[plain] < 0.1).sum())
        total += int(plain.sum())
    assert total > 3000, "points are seen by several views"
    assert agree >= 0.9 * total, f"{agree} of {total}"


def test_own_view_reproduces_the_points_exactly(capture: Capture) -> None:
    """Points were drawn view by view; the first ones lie on pixel centres of the first view."""
    for position in project(capture.meta, 0, capture.points[: 3000 // VIEWS])[:2]:
        assert np.abs(position - np.floor(position) - 0.5).max() < 2e-3


def test_cameras_stand_in_the_room_upright_and_clear(capture: Capture) -> None:
    for frame in capture.meta["frames"]:
        matrix = np.array(frame["transform_matrix"])
        assert np.allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-12)
        assert np.linalg.det(matrix[:3, :3]) > 0
        assert (matrix[:3, 3:] > LOW + 0.1).all() and (matrix[:3, 3:] < HIGH - 0.1).all()
        assert matrix[2, 1] > 0.5, "up in the picture is up in the room"
    turned = look_at(np.array([0.0, -2.0, 0.0]), np.zeros(3))[:3, :3]
    assert np.allclose(turned, [[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    room = Room(0)
    for view in camera_path(60, 64, 48, 0):
        _, t, surfaces = first_hits(room, view, np.arange(64 * 48))
        assert t.min() > 0.1
    assert {LANDSCAPE, SPHERE} <= set(surfaces.tolist())


def test_sphere_mirrors() -> None:
    """A point of the sphere has two colors from two sides; a point of the floor has one."""
    room = Room(0)

    def seen(eye: list[float], point: np.ndarray) -> np.ndarray:
        d = point - np.array(eye)
        return room.color(np.float32(eye)[:, None], np.float32(d / np.linalg.norm(d))[:, None])[0]

    a, b = [-1.5, -1.8, 1.2], [0.6, -1.9, 0.9]
    angles = np.linspace(-0.5, 1.3, 12)
    sphere = SOLIDS[0]
    on_sphere = sphere.center.T + sphere.radius * np.stack([0 * angles, -np.cos(angles), np.sin(angles)], axis=1)
    assert np.mean([np.abs(seen(a, p) - seen(b, p)).max() for p in on_sphere]) > 0.08
    on_floor = np.array([0.3, -1.5, 0.0])
    assert np.abs(seen(a, on_floor) - seen(b, on_floor)).max() < 0.01


@pytest.mark.slow
def test_same_seed_same_capture(tmp_path: Path) -> None:
    args = {"views": 3, "width": 64, "height": 48, "points": 50}
    folders = [generate(tmp_path / name, seed=seed, **args) for name, seed in (("a", 4), ("b", 4), ("c", 5))]
    files = [{p.relative_to(f): p.read_bytes() for p in f.rglob("*.*") if p.is_file()} for f in folders]
    assert len(files[0]) == 5
    assert files[0] == files[1]
    assert files[0] != files[2]


@pytest.mark.slow
def test_refuses_to_replace_what_is_there(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("precious")
    with pytest.raises(NotADirectoryError):
        generate(tmp_path / "mine.txt", views=1)
    for overwrite in (False, True):
        with pytest.raises(FileExistsError, match="is not a sample capture and is not replaced"):
            generate(tmp_path, views=1, width=16, height=12, overwrite=overwrite)
    assert (tmp_path / "mine.txt").read_text() == "precious"
    folder = generate(tmp_path / "room", views=1, width=16, height=12, points=0)
    with pytest.raises(FileExistsError, match="is there already: .*--overwrite"):
        generate(folder, views=2, width=16, height=12, points=5)
    generate(folder, views=2, width=16, height=12, points=5, overwrite=True)
    assert len(list((folder / "images").iterdir())) == 2
    (folder / "images/mine.png").touch()
    with pytest.raises(OSError, match="also holds images/mine.png, which would be lost"):
        generate(folder, views=1, width=16, height=12, overwrite=True)
    assert (folder / "images/mine.png").exists()


@pytest.mark.parametrize("bad", [{"views": 0}, {"width": 0}, {"height": -5}, {"points": -1}, {"seed": -1}])
def test_bad_sizes(tmp_path: Path, bad: dict) -> None:
    with pytest.raises(ValueError, match=f"{next(iter(bad))} must be at least"):
        generate(tmp_path / "room", **bad)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_interrupted_stops_soon_and_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []

    def interrupted(*args: object) -> None:
        calls.append(1)
        raise KeyboardInterrupt

    monkeypatch.setattr("bitymi_ns.sample.capture.render", interrupted)
    with pytest.raises(KeyboardInterrupt):
        generate(tmp_path / "room", views=1000, width=16, height=12)
    assert len(calls) < 1000
    assert not list(tmp_path.iterdir())
