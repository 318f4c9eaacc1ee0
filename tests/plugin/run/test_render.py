"""`ns-render` on our scenes: films and frames by PyAV, atomically; refusals in one line."""

import json
import math
import os
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import av
import numpy as np
import pytest
import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.scene_box import OrientedBox
from nerfstudio.scripts import render
from PIL import Image

from bitymi_ns.capture.folder_contents import is_rendered_film, result_in
from bitymi_ns.capture.kinds import RENDERS
from bitymi_ns.plugin.console import InputError
from bitymi_ns.plugin.data.datamanager import BitymiDataManager
from bitymi_ns.plugin.hooks import patch_render
from bitymi_ns.plugin.run.films import write_image
from bitymi_ns.plugin.run.render import spiral
from bitymi_ns.plugin.run.surfel_model import SurfelModel, box_of
from bitymi_ns.scene.camera import Camera
from tests.typed import Patch, Printed

DISTANCE = 3.0


class Wall(SurfelModel):
    """A coloured wall at constant depth in front of every camera; its blue encodes the frame."""

    def __init__(self) -> None:
        torch.nn.Module.__init__(self)
        self.device_indicator_param = torch.nn.Parameter(torch.zeros(0))
        self.drawn: list[Camera] = []
        self.before: Callable[[int], None] = lambda number: None

    background = torch.zeros(3)

    def sizes(self) -> dict[str, float]:
        return {"surfels": 1.0}

    def render(self, camera: Camera, background: torch.Tensor, maps: bool) -> Any:
        self.before(len(self.drawn))
        self.drawn.append(camera)
        one = torch.ones(camera.height, camera.width, 1)
        rgb = torch.cat([0.8 * one, 0.4 * one, 0.05 * min(len(self.drawn), 20) * one], 2)
        extra = {"depth": DISTANCE * one, "normal": 0 * rgb, "beta": one, "overdraw": one}
        return SimpleNamespace(rgb=rgb, alpha=one, **(extra if maps else dict.fromkeys(extra)))


@pytest.fixture
def wall(monkeypatch: Patch) -> Wall:
    model = Wall()
    for name, value in vars(render).items():
        monkeypatch.setattr(render, name, value)  # undone at the end

    def eval_setup(*_: Any, **__: Any) -> tuple:
        patch_render()
        manager = BitymiDataManager.__new__(BitymiDataManager)
        torch.nn.Module.__init__(manager)
        manager.eval_dataset = HeldOut()
        return None, SimpleNamespace(model=model, datamanager=manager, device="cpu"), None, 0

    monkeypatch.setattr(render, "eval_setup", eval_setup)
    monkeypatch.setattr(render.install_checks, "check_ffmpeg_installed", lambda: pytest.fail("no ffmpeg is needed"))
    return model


class HeldOut:
    count = 3

    def __len__(self) -> int:
        return self.count

    @property
    def cameras(self) -> Cameras:
        return cameras(self.count)


def cameras(count: int) -> Cameras:
    """Make cameras in a row with off-centre principal points."""
    poses = torch.eye(4)[:3].repeat(count, 1, 1)
    poses[:, 0, 3] = torch.arange(count) * 0.1
    cy = 11.0 + torch.arange(count)[:, None]
    return Cameras(poses, fx=40.0, fy=40.0, cx=17.0, cy=cy, width=32, height=24)


def path_of(count: int = 12, **changes: Any) -> dict[str, Any]:
    pose = np.eye(4).flatten().tolist()
    frames = [{"camera_to_world": pose, "fov": 60.0, "aspect": 4 / 3} for _ in range(count)]
    found = {"camera_type": "perspective", "render_width": 32, "render_height": 24, "fps": 24, "crop": None}
    return {**found, "seconds": count / 24, "camera_path": frames, **changes}


@pytest.fixture
def camera_path(tmp_path: Path) -> Callable[..., None]:
    """Return a function that renders a camera path to tmp_path / "film.mp4", or with other options."""

    def command(found: Any = None, **options: Any) -> None:
        file = tmp_path / "path.json"
        file.write_text(json.dumps(path_of() if found is None else found))
        options = {"camera_path_filename": file, "output_path": tmp_path / "film.mp4", **options}
        render.RenderCameraPath(load_config=tmp_path / "config.yml", **options).main()

    return command


def test_a_box_holds_the_points_that_nerfstudios_does() -> None:
    random = torch.Generator().manual_seed(0)
    points = 2 * torch.randn(2000, 3, generator=random)
    theirs = OrientedBox.from_params((0.3, -0.2, 0.5), (0.4, -1.1, 2.0), (2.0, 3.0, 4.0))
    inside = theirs.within(points)
    assert 100 < int(inside.sum()) < 1900 and torch.equal(box_of(theirs).contains(points), inside)


def test_the_crop_of_a_camera_path_is_the_models(wall: Wall, camera_path: Any) -> None:
    crop = {"crop_center": [1, 2, 3], "crop_scale": [2, 4, 6.0], "crop_rot": [0, 0, math.pi / 2]}
    camera_path({**path_of(1), "crop": {**crop, "crop_bg_color": {"r": 38, "g": 42, "b": 55}}})
    assert wall.crop_box is not None and (wall.crop_box.center, wall.crop_box.half) == ((1, 2, 3), (1, 2, 3))
    assert wall.crop_box.contains(torch.tensor([[2.9, 2.9, 3], [1.9, 3.9, 3]])).tolist() == [True, False]
    camera_path(path_of(1))
    assert wall.crop_box is None
    for wrong in ({"crop_scale": [0, 1, 1]}, {"crop_center": [1, 2]}, {"crop_rot": ["a", 0, 0]}):
        with pytest.raises(InputError, match=f"path.json cannot be used: crop.{next(iter(wrong))}"):
            camera_path({**path_of(1), "crop": {**crop, **wrong}})


def decoded(path: Path) -> tuple[tuple[str, str, Fraction], list[np.ndarray]]:
    """Return codec, pixel format and frame rate, which PyAV 19 does not tell of a closed film, and the frames."""
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        stated = stream.codec_context.name, stream.codec_context.pix_fmt, stream.average_rate
        return stated, [f.to_ndarray(format="rgb24") for f in container.decode(video=0)]


def test_a_camera_path_becomes_a_film_that_browsers_play(wall: Wall, camera_path: Any, tmp_path: Path) -> None:
    camera_path()
    stated, frames = decoded(tmp_path / "film.mp4")
    assert stated == ("h264", "yuv420p", 24)
    assert len(frames) == 12 and frames[0].shape == (24, 32, 3)
    for i, frame in enumerate(frames):  # the colours are those that were drawn
        assert np.abs(frame.mean((0, 1)) - [204, 102, 255 * 0.05 * (i + 1)]).max() < 4
    focal = float(wall.drawn[0].K[1, 1])
    assert focal == pytest.approx(12 / math.tan(math.radians(30)), rel=1e-5)
    data = (tmp_path / "film.mp4").read_bytes()
    assert data.index(b"moov") < data.index(b"mdat")  # can play while downloading
    assert is_rendered_film(tmp_path / "film.mp4")  # is not mistaken for a capture
    assert sorted(path.name for path in tmp_path.iterdir()) == ["film.mp4", "path.json"]


def test_frames_of_a_path_keep_their_principal_points(wall: Wall, camera_path: Any) -> None:
    found = path_of(3)
    found["camera_path"][0]["principal_point"] = [0.25, 0.75]
    found["camera_path"][1]["principal_point"] = [1, 0]
    camera_path(found, downscale_factor=2.0)
    assert [(c.width, c.height) for c in wall.drawn] == [(16, 12)] * 3
    assert [camera.K[:2, 2].tolist() for camera in wall.drawn] == [[4, 9], [16, 0], [8, 6]]


def test_odd_sizes_and_one_frame(wall: Wall, camera_path: Any, tmp_path: Path, capsys: Printed) -> None:
    camera_path(path_of(1, render_width=33, render_height=25), output_path=tmp_path / "new" / "odd")
    _, frames = decoded(tmp_path / "new" / "odd.mp4")
    assert [frame.shape for frame in frames] == [(24, 32, 3)]
    told = capsys.readouterr().out
    assert "of 33 x 25 pixels the last row or column is left out" in told and "1 frames of 32 x 24, " in told


def test_an_interrupted_film_leaves_the_earlier_one(wall: Wall, camera_path: Any, tmp_path: Path) -> None:
    camera_path()
    before = (tmp_path / "film.mp4").read_bytes()

    def stop(number: int) -> None:
        if number == 17:
            raise KeyboardInterrupt

    wall.before = stop
    with pytest.raises(SystemExit) as ended:
        camera_path()
    assert ended.value.code == 130 and (tmp_path / "film.mp4").read_bytes() == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["film.mp4", "path.json"]


def test_frames_replace_earlier_frames_and_nothing_else(wall: Wall, camera_path: Any, tmp_path: Path) -> None:
    frames = {"output_format": "images", "image_format": "png", "output_path": tmp_path / "frames"}
    camera_path(rendered_output_names=["rgb", "depth"], **frames)
    camera_path(path_of(2), rendered_output_names=["rgba"], **frames)
    assert sorted(path.name for path in (tmp_path / "frames").iterdir()) == ["00000.png", "00001.png"]
    picture = np.array(Image.open(tmp_path / "frames" / "00000.png"))
    assert picture.shape == (24, 32, 4) and (picture[..., 3] == 255).all()
    assert result_in(tmp_path / "frames") is RENDERS
    (tmp_path / "maps").mkdir()
    write_image(tmp_path / "maps" / "a.jpg", picture[..., :3], fmt="jpeg")
    assert result_in(tmp_path / "maps") is RENDERS
    (tmp_path / "frames" / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="holds other files than frames and is not replaced"):
        camera_path(**frames)
    assert len(list((tmp_path / "frames").iterdir())) == 3


def test_depth_has_the_colours_of_its_planes(wall: Wall, camera_path: Any, tmp_path: Path) -> None:
    options = {"output_format": "images", "image_format": "png", "rendered_output_names": ["depth"]}
    for name, far in (("near", 100.0), ("far", 3.0)):
        camera_path(path_of(1), output_path=tmp_path / name, depth_near_plane=0.0, depth_far_plane=far, **options)
    near, far = (np.array(Image.open(tmp_path / name / "00000.png"))[12, 16].astype(int) for name in ("near", "far"))
    assert near[2] > near[0] and far[0] > far[2]  # turbo: blue to red


def test_paths_of_the_captures_cameras(wall: Wall, tmp_path: Path) -> None:
    options: Any = {"load_config": tmp_path / "config.yml", "output_path": tmp_path / "film.mp4"}
    render.RenderInterpolated(interpolation_steps=6, frame_rate=30, **options).main()
    stated, frames = decoded(tmp_path / "film.mp4")
    assert stated[2] == 30 and len(frames) == 12 and frames[0].shape == (24, 32, 3)
    assert [camera.K[:2, 2].tolist() for camera in (wall.drawn[0], wall.drawn[6])] == [[17, 11], [17, 12]]
    render.SpiralRender(seconds=0.5, frame_rate=20, **options).main()
    stated, frames = decoded(tmp_path / "film.mp4")
    assert stated[2] == 20 and len(frames) == 10 and frames[0].shape == (24, 32, 3)


def test_a_spiral_turns_to_what_the_camera_shows_and_does_not_roll(wall: Wall) -> None:
    angle = math.radians(40)
    turn = torch.tensor([[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]])
    start = cameras(1)
    start.camera_to_worlds[0, :, :3] = turn
    path = spiral(wall, start, 8, 0.2)
    target = turn @ torch.tensor([0.0, 0.0, -DISTANCE])
    for pose in path.camera_to_worlds:
        toward = torch.nn.functional.normalize(target - pose[:, 3], dim=0)
        assert float(toward @ -pose[:, 2]) > 0.995  # depth along the ray is slightly larger than the wall's
        assert abs(float(pose[1, 0])) < 1e-6  # level, like the first camera
        assert float((pose[:, 3] - start.camera_to_worlds[0, :, 3]).norm()) <= 0.2 * math.sqrt(2) + 1e-6


BAD_PATHS = {
    "render_width: Field required": lambda p: p.pop("render_width"),
    "has no frames: add a second keyframe": lambda p: p.update(camera_path=[]),
    "has no frames: add a second keyframe, and": lambda p: p.update(seconds=0, camera_path=p["camera_path"][:1]),
    "camera_path.0.camera_to_world: must be 16": lambda p: p["camera_path"][0].update(camera_to_world=[10**400] * 16),
    "camera_path.0.camera_to_world: must be 16 ": lambda p: p["camera_path"][0].update(camera_to_world=[{}] * 16),
    "render_width: Input should be less than or equal to 16384": lambda p: p.update(render_width=10**400),
    "seconds: Input should be": lambda p: p.update(seconds=10**400),
    "camera_path.0.fov: Input should be": lambda p: p["camera_path"][0].update(fov=10**400),
    "camera_type: Input should be a valid string": lambda p: p.update(camera_type=["fisheye"]),
    "camera_path.1.fov: Field required": lambda p: p["camera_path"][1].pop("fov"),
    "camera_path.0.principal_point.1: Input should be": lambda p: p["camera_path"][0].update(principal_point=[0, 3]),
    "camera_path.0.fov: Input should be less than 180": lambda p: p["camera_path"][0].update(fov=180),
    "camera_path.2.camera_to_world: must be 16 numbers": lambda p: p["camera_path"][2].update(camera_to_world=[1.0]),
    "camera_path.0.camera_to_world: must be a rotation": lambda p: p["camera_path"][0].update(
        camera_to_world=[2.0, 0, 0, 0, 0, 2, 0, 0, 0, 0, 2, 0, 0, 0, 0, 1]
    ),
    "seconds: Input should be greater than 0": lambda p: p.update(seconds=-1),
    "seconds: Input should be a finite number": lambda p: p.update(seconds=math.inf),
    "makes 12000 frames per second: correct its seconds": lambda p: p.update(seconds=0.001),
    "render_height: Input should be less than or equal to 16384": lambda p: p.update(render_height=100_000),
    "for equirectangular cameras: save it again": lambda p: p.update(camera_type="equirectangular"),
}


@pytest.mark.parametrize("message", BAD_PATHS)
def test_camera_paths_that_cannot_be_used(wall: Wall, camera_path: Any, tmp_path: Path, message: str) -> None:
    found = path_of()
    BAD_PATHS[message](found)
    with pytest.raises(InputError, match=message.replace("(", r"\(")) as refused:
        camera_path(json.loads(json.dumps(found)))
    assert "path.json" in str(refused.value) and "\n" not in str(refused.value)
    assert not wall.drawn and not (tmp_path / "film.mp4").exists()


def test_files_without_camera_path(wall: Wall, camera_path: Any, tmp_path: Path, monkeypatch: Patch) -> None:
    os.mkfifo(tmp_path / "pipe.json")
    (tmp_path / "link.json").symlink_to(tmp_path / "nothing.json")
    (tmp_path / "folder.json").mkdir()
    (tmp_path / "other.json").write_bytes(b"\x80{")
    (tmp_path / "deep.json").write_bytes(b"[" * 100_000)
    for name, message in (
        ("gone", "it does not exist.*--camera-path-filename"),
        ("pipe", "it is not a regular file"),
        ("link", "it is a link to nothing"),
        ("folder", "it is not a regular file"),
        ("other", "it is no text in UTF-8"),
        ("deep", "it is nested too deeply"),
    ):
        with pytest.raises(InputError, match=f"{name}.json cannot be read: {message}"):
            camera_path(camera_path_filename=tmp_path / f"{name}.json")
    with pytest.raises(InputError, match="path.json cannot be used: Input should be .*dictionary"):
        camera_path([1, 2])
    monkeypatch.setattr(HeldOut, "count", 1)
    with pytest.raises(InputError, match="two cameras, not 1: --pose-source train"):
        render.RenderInterpolated(load_config=tmp_path / "c.yml", output_path=tmp_path / "film.mp4").main()


def test_numbers_in_quotes_are_numbers(wall: Wall, camera_path: Any, tmp_path: Path) -> None:
    found = path_of(2, render_width="32", render_height=24.0, seconds="0.5")
    frame = found["camera_path"][0]
    frame.update(fov="60", camera_to_world=[str(x) for x in frame["camera_to_world"]], principal_point=["0.25", 0.75])
    (tmp_path / "words.json").write_bytes(json.dumps(found).encode("utf-16"))
    camera_path(camera_path_filename=tmp_path / "words.json")
    assert [(camera.width, camera.height) for camera in wall.drawn] == [(32, 24)] * 2
    assert [camera.K[:2, 2].tolist() for camera in wall.drawn] == [[8, 18], [16, 12]]
    assert decoded(tmp_path / "film.mp4")[0][2] == 4


def test_empty_frames_are_counted(wall: Wall, camera_path: Any, tmp_path: Path, capsys: Printed) -> None:
    camera_path()
    assert "nothing of the scene" not in capsys.readouterr().out
    drawn = wall.render
    wall.drawn.clear()

    def render_some(camera: Camera, background: torch.Tensor, maps: bool) -> Any:
        found = drawn(camera, background, maps)
        if len(wall.drawn) > 5:
            found.rgb, found.alpha = 0 * found.rgb, 0 * found.alpha
        return found

    wall.render = render_some  # type: ignore[method-assign]
    camera_path(output_format="images", rendered_output_names=["depth"])
    said = " ".join(capsys.readouterr().out.split())
    assert "of 12 frames show nothing" in said
    assert len(list((tmp_path / "film").iterdir())) == 12


def test_a_view_of_few_degrees_is_a_warning(wall: Wall, camera_path: Any, capsys: Printed) -> None:
    found = path_of(2)
    for frame in found["camera_path"]:
        frame["fov"] = 1.2
    camera_path(found)
    said = " ".join(capsys.readouterr().out.split())
    assert "at most 1.2 degrees. If radians were meant, fov has to be 68.8" in said
    camera_path()
    assert "radians" not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("command", "options", "message"),
    [
        ("RenderInterpolated", {"interpolation_steps": 0}, "--interpolation-steps must be at least 1, not 0"),
        ("RenderInterpolated", {"frame_rate": 0}, "--frame-rate must be from 0.01 to 1,000.0, not 0"),
        ("RenderInterpolated", {"downscale_factor": 0.0}, "--downscale-factor must be from"),
        ("RenderInterpolated", {"downscale_factor": 24.0}, "a film of 1 x 1 pixels cannot be written"),
        ("RenderInterpolated", {"render_nearest_camera": True}, "--render-nearest-camera .* need rays"),
        ("RenderInterpolated", {"output_path": Path("film.gif")}, "--output-path must end in .mp4, film.gif does not"),
        ("RenderInterpolated", {"output_path": Path()}, "--output-path '.' has no name of a film"),
        ("SpiralRender", {"output_path": Path(), "output_format": "images"}, "'.' has no name of a folder"),
        ("RenderInterpolated", {"depth_near_plane": 5.0, "depth_far_plane": 1.0}, "--depth-near-plane must be less"),
        ("DatasetRender", {"depth_near_plane": 5.0, "depth_far_plane": 1.0}, "--depth-near-plane must be less than"),
        ("SpiralRender", {"depth_near_plane": 1e6, "rendered_output_names": ["depth"]}, "and these are 1e.06"),
        ("DatasetRender", {"output_path": Path(__file__)}, "test_render.py is not a folder: choose another path"),
        ("RenderInterpolated", {"output_path": Path("/proc/film.mp4")}, "/proc/film.mp4 cannot be written"),
        ("RenderInterpolated", {"rendered_output_names": ["rgba"]}, "rgba has transparency"),
        ("RenderInterpolated", {"rendered_output_names": []}, "--rendered-output-names names nothing"),
        ("RenderInterpolated", {"rendered_output_names": ["rgb", "deep"]}, "there is no output deep: .* may be rgb,"),
        ("DatasetRender", {"rendered_output_names": ["raw-deep"]}, "there is no output raw-deep: .*; with raw-"),
        ("DatasetRender", {"downscale_factor": -1.0}, "--downscale-factor must be from"),
        ("DatasetRender", {"output_path": Path("/proc/maps")}, "/proc/maps/test cannot be written"),
        ("SpiralRender", {"seconds": 0.0}, "--seconds must be at least 0.001, not 0.0"),
        ("SpiralRender", {"seconds": 0.01}, "0.01 seconds have no frame at --frame-rate 24"),
        ("SpiralRender", {"radius": -1.0}, "--radius must be at least 0, not -1.0"),
        ("DatasetRender", {"rendered_output_names": ["rgba"]}, "rgba has transparency"),
    ],
)
def test_unusable_options(wall: Wall, tmp_path: Path, command: str, options: dict[str, Any], message: str) -> None:
    options = {"output_path": tmp_path / "film.mp4", **options}
    with pytest.raises(InputError, match=message):
        getattr(render, command)(load_config=tmp_path / "config.yml", **options).main()
    assert not list(tmp_path.iterdir())


def test_other_methods_are_rendered_as_before(wall: Wall, camera_path: Any, monkeypatch: Patch) -> None:
    stock: list[Any] = []
    monkeypatch.setattr(render, "_render_trajectory_video", lambda pipeline, cameras, **_: stock.append(pipeline.model))
    checks = SimpleNamespace(check_ffmpeg_installed=lambda: stock.append("checked"))
    monkeypatch.setattr(render, "install_checks", checks)
    loaded = render.eval_setup
    camera_path()  # as if one of ours had been loaded before
    assert stock == []
    other = SimpleNamespace(model="splatfacto", device="cpu")
    monkeypatch.setattr(render, "eval_setup", lambda *_, **__: (None, other, None, 0))
    camera_path()
    assert stock == ["checked", "splatfacto"]
    monkeypatch.setattr(render, "eval_setup", loaded)
    camera_path()
    assert len(stock) == 2
