"""Panoramas are distinguished from photographs of the same shape."""

import zlib
from functools import cache
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image

from bitymi_ns.capture.exif import Exif
from bitymi_ns.capture.known_poses import triangulate
from bitymi_ns.capture.poses import _with_panoramas, find_poses
from bitymi_ns.capture.sfm_photos import Photo, has_panorama_metadata, looks_panoramic
from bitymi_ns.capture.types import SPHERICAL_MODEL, CaptureError, ColmapCamera, Photograph, SfmOptions
from bitymi_ns.sample.room import Room

XMP = (
    b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
    b'<rdf:Description xmlns:GPano="http://ns.google.com/photos/1.0/panorama/" '
    b'GPano:ProjectionType="equirectangular"/></rdf:RDF></x:xmpmeta>'
)


def panorama(turn: float = 0.0, height: int = 256, centre: tuple[float, float, float] = (0.0, 0.0, 1.2)) -> np.ndarray:
    """Render [h, 2 h, 3] an equirectangular panorama of the sample room, rows from zenith to nadir."""
    theta, phi = np.meshgrid(
        (np.arange(height) + 0.5) / height * np.pi, turn + (np.arange(2 * height) + 0.5) / height * np.pi, indexing="ij"
    )
    rays = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)
    return shaded(rays, centre)


def photograph(turn: float, height: int = 256) -> np.ndarray:
    """Render [h, 2 h, 3] a photograph of that shape."""
    y, x = np.meshgrid((np.arange(height) + 0.5) / height - 0.5, np.arange(2 * height) / height - 1.0, indexing="ij")
    forward = np.array([np.cos(turn), np.sin(turn), -0.1])
    right = np.array([np.sin(turn), -np.cos(turn), 0.0])
    rays = forward + x[..., None] * right - y[..., None] * np.array([0.0, 0.0, 1.0])
    return shaded(rays / np.linalg.norm(rays, axis=-1, keepdims=True), (0.0, 0.0, 1.2))


room_of_tests = cache(lambda: Room(0))


def shaded(rays: np.ndarray, centre: tuple[float, float, float]) -> np.ndarray:
    room, flat = room_of_tests(), rays.reshape(-1, 3).astype(np.float32)
    origin, direction = np.float32(centre)[:, None], np.ascontiguousarray(flat.T)
    colors = room.color(origin, direction)
    return np.uint8(np.clip(colors, 0.0, 1.0) * 255.0 + 0.5).reshape(rays.shape)


def grey(pixels: np.ndarray) -> np.ndarray:
    return np.asarray(Image.fromarray(pixels).convert("L").resize((256, 128), Image.Resampling.BOX), np.float32)


@pytest.mark.parametrize("turn", [0.0, 2.2])
def test_what_pictures_show(turn: float) -> None:
    assert looks_panoramic(grey(panorama(turn, centre=(0.5, -0.4, 1.3))))
    assert not looks_panoramic(grey(photograph(turn)))
    assert not looks_panoramic(grey(panorama(turn))[:, 8:-8])  # another shape


def test_other_pictures_of_that_shape() -> None:
    y, x = np.mgrid[:128, :256]
    product = np.where(np.hypot(x - 128, y - 64) < 40, 90.0, 245.0)  # on a white background
    sea = np.where(y < 60, 200.0 - y, 90.0) + np.random.default_rng(0).normal(0, 12, (128, 256)) * (y > 60)
    for pixels in (product, sea, np.zeros((128, 256)), np.random.default_rng(1).uniform(0, 255, (128, 256))):
        assert not looks_panoramic(pixels.astype(np.float32))


@pytest.mark.parametrize(("model", "told", "seams", "answer"), [
    ("auto", 2, 0.7, True), ("auto", 2, 0.3, False), ("auto", 3, 0.3, True), ("auto", 0, 0.3, False),
    ("SIMPLE_RADIAL", 12, 0.9, False), ("EQUIRECTANGULAR", 0, 0.0, True),
])  # fmt: skip
def test_pictures_of_a_size_and_folder_have_one_answer(model: str, told: int, seams: float, answer: bool) -> None:
    """A pole may have detail, and a seam may close by chance."""
    some = dict(exif=Exif(), plain=True, thumb=np.zeros((1, 1)), sharpness=1.0)
    photos = [Photo(f"a/{i}.jpg", Path(), 1024, 512, **some, panorama=i < told, seam=seams) for i in range(12)]
    photos.append(Photo("b/0.jpg", Path(), 1024, 512, **some))
    lines: list[str] = []
    decided = _with_panoramas(Path("walk"), photos, {}, model, lines.append)
    assert [photo.panorama for photo in decided[:12]] == [answer] * 12
    assert decided[12].panorama is (model == "EQUIRECTANGULAR")
    assert [line.split(" look")[0] for line in lines] == (
        [f"{told} of 12 photographs of 1024 x 512 pixels in walk/a"] if model == "auto" and told else []
    )


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_what_metadata_say(tmp_path: Path, suffix: str) -> None:
    plain, marked = tmp_path / f"plain{suffix}", tmp_path / f"marked{suffix}"
    image = Image.new("RGB", (64, 32))
    image.save(plain)
    data = plain.read_bytes()
    if suffix == ".jpg":
        body = b"http://ns.adobe.com/xap/1.0/\0" + XMP
        data = data[:2] + b"\xff\xe1" + (len(body) + 2).to_bytes(2, "big") + body + data[2:]
    else:
        chunk = b"iTXtXML:com.adobe.xmp\0\0\0\0\0" + XMP
        size, check = (value.to_bytes(4, "big") for value in (len(chunk) - 4, zlib.crc32(chunk)))
        data = data[:33] + size + chunk + check + data[33:]
    marked.write_bytes(data)
    Image.open(marked).load()
    assert [has_panorama_metadata(path) for path in (marked, plain, tmp_path / "none.jpg")] == [True, False, False]


@pytest.fixture
def walk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    (tmp_path / "walk").mkdir()
    return tmp_path / "walk"


@pytest.mark.slow
def test_they_get_poses_as_pictures_of_all_directions(walk: Path) -> None:
    centres = [(-1.0 + 0.4 * i, -1.3 + 0.1 * i * i, 1.3 + 0.1 * (i % 2)) for i in range(5)]
    for i, centre in enumerate(centres):
        Image.fromarray(panorama(0.3 * i, 512, centre)).save(walk / f"{i}.png")
    found = find_poses(walk)
    model = pycolmap.Reconstruction(found.model)
    assert found.registered == 5 and [c.model_name for c in model.cameras.values()] == [SPHERICAL_MODEL]
    at = {int(Path(image.name).stem): image.projection_center() for image in model.images.values()}
    ours, true = (np.linalg.norm(np.diff(np.array(x), axis=0), axis=1) for x in ([at[i] for i in range(5)], centres))
    assert np.abs(ours / ours.mean() - true / true.mean()).max() < 0.03


def test_those_of_less_than_all_directions_are_refused(walk: Path) -> None:
    for i in range(4):
        Image.fromarray(panorama(0.3 * i, 64)[:, : 128 - 40]).save(walk / f"{i}.png")
    with pytest.raises(CaptureError, match="4 of 4 photographs .* are panoramas .* show all directions"):
        find_poses(walk, SfmOptions(camera_model="EQUIRECTANGULAR"))


@pytest.mark.slow
def test_points_are_triangulated_from_panoramas_with_poses(walk: Path) -> None:
    axes = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])  # the middle column looks along -x
    views = []
    for i in range(4):
        centre = np.array([-1.0 + 0.4 * i, -1.3 + 0.1 * i * i, 1.3])
        Image.fromarray(panorama(0.0, 512, tuple(centre.tolist()))[:, ::-1]).save(walk / f"{i}.png")
        pose = np.eye(4)
        pose[:3] = np.column_stack([axes.T * (1, -1, -1), centre])
        camera = ColmapCamera(SPHERICAL_MODEL, 1024, 512, (1024.0, 512.0))
        views.append(Photograph(walk / f"{i}.png", camera, pose, ""))
    model = pycolmap.Reconstruction(triangulate(walk, views))
    xyz = np.array([point.xyz for point in model.points3D.values()])
    inside = ((xyz > np.array([-3.05, -2.55, -0.05])) & (xyz < np.array([3.05, 2.55, 2.65]))).all(1)
    assert len(xyz) > 50 and inside.mean() > 0.9
