"""Pose estimation on small photographs, and the messages when it fails."""

import json
import os
import shutil
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import ExifTags, Image

from bitymi_ns.capture.exif import Exif
from bitymi_ns.capture.known_poses import triangulate
from bitymi_ns.capture.poses import _finished, _photographs_in, by_camera, camera_group, find_poses, make_job, ordered
from bitymi_ns.capture.sfm_photos import Photo
from bitymi_ns.capture.types import OPENCV_AXES, CaptureError, ColmapCamera, Photograph, SfmOptions, SfmSettings
from bitymi_ns.cli import main
from bitymi_ns.sample.capture import RoomView, render
from bitymi_ns.sample.room import Room
from tests.capture.test_exif import apple_note

Copy = Callable[[str], Path]
B = ExifTags.Base


@pytest.fixture(scope="module")
def capture(arc: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with spaces and non-ASCII names, a damaged photograph, a duplicate and a foreign one."""
    folder = tmp_path_factory.mktemp("with spaces") / "Fotos für später"
    folder.mkdir()
    for path in arc.glob("*.png"):
        shutil.copy(path, folder / f"Bild {path.name}")
    (folder / "kaputt.jpg").write_bytes(b"\xff\xd8\xff\xe0 no photograph")
    shutil.copy(arc / "photo_3.png", folder / "wieder.png")
    noise(np.random.default_rng(1), (72, 54)).resize((288, 216), Image.BICUBIC).save(folder / "woanders.png")
    find_poses(folder)
    return folder


@pytest.mark.slow
def test_equal_photographs_have_equal_poses(copied: Copy) -> None:
    models = []
    for name in ("one", "two"):
        poses = find_poses(copied(name), SfmOptions(max_features=400))
        models.append({path.name: path.read_bytes() for path in poses.model.glob("*.bin")})
    assert models[0] == models[1]


@pytest.mark.slow
def test_poses_are_found_once_however_the_path_is_written(
    copied: Copy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copied("cap").rename(tmp_path / "images")
    capture = tmp_path / "capture"
    capture.mkdir()
    (tmp_path / "images").rename(capture / "images")
    monkeypatch.chdir(tmp_path)
    report = find_poses(Path("capture"), SfmOptions(max_features=400)).report
    monkeypatch.setattr("bitymi_ns.capture.poses._find", None)
    (tmp_path / "link").symlink_to(capture)
    for path in (capture, capture / "images", Path("capture/../capture/."), tmp_path / "link", Path("link/images")):
        again = find_poses(path, SfmOptions(max_features=400))
        assert again.report.samefile(report) and (again.images / "photo_1.png").is_file()
    (tmp_path / "link").unlink()
    capture.rename(tmp_path / "moved")
    moved = find_poses(tmp_path / "moved", SfmOptions(max_features=400))
    assert moved.images == tmp_path / "moved/images" and moved.report.is_relative_to(tmp_path / "moved")


def test_a_capture_whose_photographs_lie_below_is_theirs(copied: Copy, tmp_path: Path) -> None:
    """`ns-train` names the folder of the photographs."""
    (tmp_path / "cap").mkdir()
    copied("flat").rename(tmp_path / "cap/shots")
    assert _photographs_in(tmp_path / "cap")[1:] == _photographs_in(tmp_path / "cap/shots")[1:]
    mixed = copied("mixed")
    (mixed / "more").mkdir()
    (mixed / "photo_1.png").rename(mixed / "more/photo_1.png")
    assert _photographs_in(mixed)[1] == mixed and "more/photo_1.png" in _photographs_in(mixed)[2]


@pytest.mark.parametrize(
    "text",
    ["", "[]", "{}", "null", "[" * 100_000, '{"made": false}', '{"images": 3}', "\udcff", '{"seconds": "x"}'],
    ids=lambda text: text[:16],
)
def test_a_result_that_is_damaged_counts_as_none(text: str, tmp_path: Path) -> None:
    (tmp_path / "result/sparse/0").mkdir(parents=True)
    (tmp_path / "result/sparse/0/cameras.bin").touch()
    (tmp_path / "result/poses.json").write_text(text, "utf8", "surrogateescape")
    assert _finished(tmp_path, tmp_path) is None


def test_a_kept_result_is_doubted_as_when_it_was_found(tmp_path: Path) -> None:
    (tmp_path / "result/sparse/0").mkdir(parents=True)
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        (tmp_path / "result/sparse/0" / name).touch()
    values = dict(made=False, left_out={}, registered=3, given=3, reprojection_error=0.3, track_length=3.0, seconds={})
    for more, doubtful in (({}, False), ({"contradicted": 0.05}, False), ({"contradicted": 0.2}, True)):
        (tmp_path / "result/poses.json").write_text(json.dumps({**values, **more}))
        found = _finished(tmp_path, tmp_path)
        assert found is not None and bool(found.doubt) == doubtful


def test_names_that_are_not_utf8_are_refused_before_the_work(copied: Copy, tmp_path: Path) -> None:
    folder = copied("cap")
    (folder / "photo_1.png").rename(os.fsdecode(os.fsencode(folder) + b"/f\xfcr.png"))
    with pytest.raises(CaptureError, match="is not UTF-8: rename it"):
        find_poses(folder, progress=never)
    folder = copied("other").rename(os.fsdecode(os.fsencode(tmp_path) + b"/\xe4"))
    with pytest.raises(CaptureError, match="is not UTF-8: rename it"):
        find_poses(folder, progress=never)
    with pytest.raises(CaptureError, match="is not UTF-8: rename it"):
        camera = ColmapCamera("PINHOLE", 9, 9, (9, 9, 5, 5))
        known = [Photograph(folder / f"photo_{i}.png", camera, np.eye(4), "") for i in (1, 2)]
        triangulate(folder, known, never)


def never(step: str, done: int, total: int) -> None:
    raise AssertionError("work was begun")


def known_centers(views: list[RoomView]) -> np.ndarray:
    return np.array([view.camera_to_world[:3, 3] for view in views])


def test_the_poses_are_those_the_photographs_were_taken_from(capture: Path, views: list[RoomView]) -> None:
    poses = find_poses(capture)
    assert poses.given == 11 and poses.registered == 8
    assert poses.reprojection_error < 1.0 and poses.track_length > 2
    model = pycolmap.Reconstruction(poses.model)
    names = [f"Bild photo_{i + 1}.png" for i in range(8)]
    assert sorted(image.name for image in model.images.values()) == names
    assert all((poses.images / name).is_file() for name in names)
    found = np.array([model.find_image_with_name(name).projection_center() for name in names])
    theirs = known_centers(views)
    similarity = pycolmap.estimate_sim3d(found, theirs)
    extent = np.linalg.norm(theirs - theirs.mean(axis=0), axis=1).max()
    assert np.linalg.norm(similarity * found - theirs, axis=1).max() < 0.05 * extent
    up = similarity.rotation.matrix() @ [0, 0, 1]
    assert up[2] > 0.98, "z is up, as the cameras were held"


def test_the_report_says_what_was_found_and_what_was_left_out(capture: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bitymi_ns.capture.poses._find", lambda *arguments: pytest.fail("found anew"))
    poses = find_poses(capture)
    assert not list(capture.glob(".bitymi/*/database.db"))
    values = json.loads((poses.report / "report.json").read_text("utf8"))
    assert values["registered"] == 8 and values["given"] == 11 and values["seconds"]["finding features"] > 0
    assert values["left_out"] == poses.left_out
    assert Image.open(poses.report / "cameras.png").size == (1200, 600)
    assert json.loads((poses.report / "frame.json").read_text("utf8"))["metres_per_unit"] is None
    left_out = poses.left_out
    assert len(left_out) == 3 and left_out.keys() & {"wieder.png", "Bild photo_3.png"}
    assert "damaged, too large or not an image" in left_out["kaputt.jpg"]
    assert "no other photograph shows the same" in left_out["woanders.png"]
    assert any(why.startswith("the same as") for why in left_out.values())


def test_a_capture_of_nerfstudio_is_written(
    capture: Path, tmp_path: Path, views: list[RoomView], capsys: pytest.CaptureFixture
) -> None:
    assert main(["sfm", str(capture), "--output", str(tmp_path / "out")]) == 0
    printed = capsys.readouterr().out
    assert "8 of 11 photographs have a pose" in printed and "left out: kaputt.jpg" in printed
    written = json.loads((tmp_path / "out" / "transforms.json").read_text("utf8"))
    assert len(written["frames"]) == 8 and written["camera_model"] == "OPENCV" and written["w"] == 288
    assert abs(written["fl_x"] / views[0].focal - 1) < 0.05
    model = pycolmap.Reconstruction(tmp_path / "out" / "sparse" / "0")
    for frame in written["frames"]:
        assert (tmp_path / "out" / frame["file_path"]).is_file()
        center = model.find_image_with_name(Path(frame["file_path"]).name).projection_center()
        np.testing.assert_allclose(np.array(frame["transform_matrix"])[:3, 3], center, atol=1e-9)
    assert (tmp_path / "out" / written["ply_file_path"]).read_bytes().startswith(b"ply")
    assert main(["sfm", str(capture), "--output", str(tmp_path / "out")]) == 1
    assert "exists already" in capsys.readouterr().err


def test_points_are_triangulated_for_known_poses(arc: Path, views: list[RoomView], copied: Copy) -> None:
    folder = copied("known")
    known = []
    for i, view in enumerate(views):
        camera = ColmapCamera("PINHOLE", 288, 216, (view.focal, view.focal, 144.0, 108.0))
        known.append(Photograph(folder / f"photo_{i + 1}.png", camera, view.camera_to_world, ""))
    model = pycolmap.Reconstruction(triangulate(folder, known))
    points = np.array([point.xyz for point in model.points3D.values()])
    assert len(points) > 50
    inside = (points > [-3.1, -2.6, -0.1]) & (points < [3.1, 2.6, 2.7])
    assert inside.all(axis=1).mean() > 0.8  # the rest is the landscape outside the window
    for view in known:
        found = model.find_image_with_name(view.file.name).cam_from_world().matrix()
        np.testing.assert_allclose(found, np.linalg.inv(view.pose @ OPENCV_AXES)[:3], atol=1e-9)


def noise(rng: np.random.Generator, size: tuple[int, int] = (50, 40)) -> Image.Image:
    return Image.fromarray(rng.integers(0, 256, (*size[::-1], 3)).astype(np.uint8))


@pytest.mark.slow
def test_photographs_that_give_no_poses(arc: Path, tmp_path: Path) -> None:
    """Too few, unreadable, identical, unrelated or blank photographs."""
    rng = np.random.default_rng(0)
    one, two = (Image.open(arc / f"photo_{i}.png") for i in (1, 2))
    for i, (pictures, message) in enumerate(
        [
            ([], "holds no photographs: camera poses need at least 3"),
            ([one], "holds 1 photographs: camera poses need at least 3"),
            ([one, two], "holds 2 photographs: camera poses need at least 3"),
            ([None, None, None, one], r"only 1 can be used \(0.png: it cannot be read"),
            ([one] * 4, "only 1 differ"),
            ([noise(rng).resize((300, 240), Image.BICUBIC) for _ in range(4)], "do not overlap: no two of them show"),
            ([Image.new("L", (300, 240), 60 * k) for k in range(4)], "4 of 4 photographs show hardly any detail"),
        ]
    ):
        folder = tmp_path / f"{i}"
        folder.mkdir()
        for k, picture in enumerate(pictures):
            (folder / f"{k}.png").write_bytes(b"nothing") if picture is None else picture.save(folder / f"{k}.png")
        with pytest.raises(CaptureError, match=message):
            find_poses(folder)
    with pytest.raises(CaptureError, match="does not exist: name a folder of photographs, or a video"):
        find_poses(tmp_path / "none")


@pytest.mark.slow
def test_photographs_from_one_spot(tmp_path: Path, views: list[RoomView]) -> None:
    room = Room(0)
    for i, angle in enumerate(np.radians([-20, -12, -4, 4, 12, 20])):
        turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
        pose = views[0].camera_to_world.copy()
        pose[:3, :3] = turn @ pose[:3, :3]
        view = RoomView(pose, views[0].focal, views[0].width, views[0].height)
        Image.fromarray(render(room, view, supersample=2)).save(tmp_path / f"{i}.png")
    with pytest.raises(CaptureError, match="were taken from one spot"):
        find_poses(tmp_path)


def test_masks_keep_features_off(arc: Path, copied: Copy) -> None:
    folder = copied("masked")
    (folder / "masks").mkdir()
    for i in range(8):
        mask = np.zeros((108, 144), np.uint8)  # at half the size
        mask[:, :4] = 255
        Image.fromarray(mask).save(folder / "masks" / f"photo_{i + 1}.png")
    with pytest.raises(CaptureError, match="8 of 8 photographs show hardly any detail"):
        find_poses(folder)


def test_masks_that_fit_no_photograph_are_refused(copied: Copy) -> None:
    folder = copied("masked")
    (folder / "masks").mkdir()
    Image.new("L", (288, 216)).save(folder / "masks" / "other.png")
    with pytest.raises(CaptureError, match="no mask in .* belongs to a photograph"):
        find_poses(folder)
    Image.new("L", (216, 288)).save(folder / "masks" / "photo_1.png")
    with pytest.raises(CaptureError, match="photo_1.png is turned by a quarter: it has 216 x 288 pixels"):
        find_poses(folder)


def photo(name: str, size: tuple[int, int] = (400, 300), **exif: object) -> Photo:
    return Photo(name, Path(name), *size, Exif(**exif), True, np.zeros((1, 1), np.float32), 1.0)  # type: ignore[arg-type]


def test_photographs_share_a_camera_and_a_focal_length_that_all_of_them_state() -> None:
    both = [photo("a", focal_length=350.0), photo("b", focal_length=352.0)]
    assert camera_group(both, [], SfmOptions()).camera.params[0] == 351 and camera_group(both, [], SfmOptions()).prior
    one = [photo("a", focal_length=350.0), photo("b")]
    assert camera_group(one, [], SfmOptions()).camera.params[0] == 480 and not camera_group(one, [], SfmOptions()).prior
    assert camera_group(one, [], SfmOptions(focal_length=300.0)).camera.params[0] == 300
    cameras = {"a": "x", "b": "x", "c": "y", "d": "x"}
    photos = [photo(name, (300, 400) if name == "d" else (400, 300), camera=c) for name, c in cameras.items()]
    assert [[p.name for p in group] for group in by_camera(photos)] == [["a", "b"], ["c"], ["d"]]


OTHER = dict(matching="sequential", mapper="global", camera_model="OPENCV", focal_length=321.0, max_image_size=800,
             max_features=1234, frames=30)  # fmt: skip
"""A different value for every setting."""


def test_every_setting_is_part_of_the_key(copied: Copy, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, keys = copied("keys"), []
    monkeypatch.setattr("bitymi_ns.capture.poses._find", lambda *arguments: keys.append(arguments[-2].name))
    assert OTHER.keys() == {field.name for field in fields(SfmSettings)}
    for name, value in (("max_image_size", 0), ("max_features", 2e6), ("frames", 2), ("focal_length", float("inf"))):
        with pytest.raises(CaptureError, match=f"{name} is .*: give a number from [0-9]+ to 1,000,000"):
            SfmOptions(**{name: value})
    for options in [{}, {}, *({name: value} for name, value in OTHER.items())]:
        find_poses(folder, SfmOptions(**options))
    assert keys[0] == keys[1] and len(set(keys)) == 1 + len(OTHER)


def test_every_setting_reaches_the_job(tmp_path: Path) -> None:
    photos = [photo("a.jpg", focal_length=350.0)]
    job = make_job(photos, tmp_path, {"a.jpg": "a.jpg"}, {}, SfmOptions(**OTHER), tmp_path, sequence=False)
    assert (job.matching, job.mapper, job.max_image_size, job.max_features) == ("sequential", "global", 800, 1234)
    camera = job.cameras[0].camera
    assert camera.model == "OPENCV" and camera.params[:2] == (321.0, 321.0) and not job.opencv_if_better


def test_photographs_are_in_the_order_of_their_times() -> None:
    times = {"a": "2024:05:01 10:00:02", "b": "2024:05:01 10:00:01.5", "c": "2024:05:01 10:00:01.25"}
    taken = [photo(name, time=time) for name, time in times.items()]
    assert [each.name for each in ordered(taken)] == ["c", "b", "a"]
    assert ordered([*taken, photo("d")])[-1].name == "d", "by name where one has no time"
    same = [photo(name, time=times["a"]) for name in "xcb"]
    assert [each.name for each in ordered(same)] == ["x", "c", "b"], "as they are where all times are the same"


@pytest.mark.slow
def test_heic_photographs(tmp_path: Path, pictures: list[np.ndarray], views: list[RoomView]) -> None:
    """HEIC files as phones take them: rotated, with lens, time and gravity in EXIF."""
    folder = tmp_path / "phone"
    folder.mkdir()
    for i, (picture, view) in enumerate(zip(pictures, views, strict=True)):
        exif = Image.Exif()
        exif[B.Make], exif[B.Orientation] = "Apple", 6
        film = round(view.focal / np.hypot(288, 216) * np.hypot(36, 24))
        note = apple_note(*-view.camera_to_world[2, :3])  # the phone's axes are the upright picture's, each reversed
        exif.get_ifd(ExifTags.IFD.Exif).update(
            {B.FocalLengthIn35mmFilm: film, B.DateTimeOriginal: f"2024:05:01 10:00:{59 - i}", B.MakerNote: note}
        )
        stored = Image.fromarray(np.ascontiguousarray(np.rot90(picture)))
        stored.save(folder / f"IMG_{i}.HEIC", exif=exif.tobytes(), quality=95)
    poses = find_poses(folder)
    assert poses.registered == len(pictures)
    model = pycolmap.Reconstruction(poses.model)
    assert {image.name for image in model.images.values()} == {f"IMG_{i}.HEIC.jpg" for i in range(len(pictures))}
    assert all(Image.open(poses.images / image.name).size == (288, 216) for image in model.images.values())
    (camera,) = json.loads((poses.report / "report.json").read_text("utf8"))["cameras"]
    assert camera["prior"] and abs(camera["params"][0] / views[0].focal - 1) < 0.05
    frame = json.loads((poses.report / "frame.json").read_text("utf8"))
    assert frame["up"] == "gravity"
    names = [f"IMG_{i}.HEIC.jpg" for i in range(len(pictures))]
    found = np.array([model.find_image_with_name(name).projection_center() for name in names])
    similarity = pycolmap.estimate_sim3d(found, known_centers(views))
    assert (similarity.rotation.matrix() @ [0, 0, 1])[2] > 0.999
