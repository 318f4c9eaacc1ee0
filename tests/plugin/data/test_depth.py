"""Depth and normals of a capture: files, units, fits, initial points, and faults."""

import io
import json
import os
import struct
import tracemalloc
import zipfile
import zlib
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest
import torch

from bitymi_ns.capture.depth_normal_maps import MapFiles, maps_beside, read_depth
from bitymi_ns.capture.lens import lenses_of
from bitymi_ns.capture.types import CaptureError, ColmapCamera
from bitymi_ns.plugin.data.datamanager import BitymiDataManager
from bitymi_ns.sample.capture import RoomView, first_hits, generate
from bitymi_ns.sample.room import Room
from tests.captures import edit_frames, expect, load, refused

WIDTH, HEIGHT = 64, 48


@pytest.fixture(scope="module")
def room(tmp_path_factory) -> tuple[Path, list[np.ndarray]]:
    """The sample room with few points, and camera z [H, W] of its photographs."""
    folder = generate(tmp_path_factory.mktemp("depth") / "room", 16, WIDTH, HEIGHT, points=400)
    meta, model = json.loads((folder / "transforms.json").read_text()), Room(0)
    depths = []
    for frame in meta["frames"]:
        pose = np.array(frame["transform_matrix"])
        points, *_ = first_hits(model, RoomView(pose, meta["fl_x"], WIDTH, HEIGHT), np.arange(WIDTH * HEIGHT))
        depths.append(((pose[:3, 3] - points) @ pose[:3, 2]).reshape(HEIGHT, WIDTH))
    return folder, depths


def write_exr(path: Path, **channels: np.ndarray) -> None:
    OpenEXR.File({"compression": OpenEXR.PIZ_COMPRESSION, "type": OpenEXR.scanlineimage}, channels).write(str(path))


def write_map(path: Path, values: np.ndarray) -> None:
    if path.suffix == ".npy":
        np.save(path, values)
    elif path.suffix == ".npz":
        np.savez_compressed(path, values)
    elif path.suffix == ".exr":
        write_exr(path, Y=values)
    else:
        assert cv2.imwrite(str(path), values)


@pytest.fixture
def capture(room, tmp_path):
    """write(function of the depth of a frame, ...) -> the capture with those maps."""
    folder, depths = room

    def write(change=lambda z, i: z, ending: str = ".npy", points: bool = True) -> Path:
        meta = json.loads((folder / "transforms.json").read_text())
        for i, (frame, depth) in enumerate(zip(meta["frames"], depths, strict=True)):
            frame["file_path"] = str(folder / frame["file_path"])
            frame["depth_file_path"] = f"depth_{i}{ending}"
            write_map(tmp_path / frame["depth_file_path"], change(depth, i))
        meta["ply_file_path"] = str(folder / meta["ply_file_path"])
        if not points:
            del meta["ply_file_path"]
        (tmp_path / "transforms.json").write_text(json.dumps(meta))
        return tmp_path

    return write


def check(manager: BitymiDataManager, depths: list[np.ndarray], tolerance: float = 0.01) -> None:
    """Check that every training view has the exact depth, scaled like the poses."""
    scale = manager.train_dataparser_outputs.dataparser_scale
    names = [path.name for path in manager.train_dataset.image_filenames]
    for view, name in zip(manager.train_views, names, strict=True):
        exact = depths[int(name[6:11]) - 1] * scale
        assert view.depth.shape == (HEIGHT, WIDTH) and view.depth.dtype == torch.float16
        known = view.depth.float().numpy() > 0
        assert known.mean() > 0.5
        assert np.abs(view.depth.float().numpy() / exact - 1.0)[known].max() < tolerance
    assert all(view.depth is None for view in manager.eval_views)


def on_surface(manager: BitymiDataManager, depths: list[np.ndarray]) -> None:
    """Check that points come from training views and lie on their surfaces."""
    outputs = manager.train_dataparser_outputs
    xyz = outputs.metadata["points3D_xyz"].double().numpy()
    assert len(xyz) == 14 * WIDTH * HEIGHT // 30 and len(outputs.metadata["points3D_rgb"]) == len(xyz)
    box = np.ptp(np.quantile(xyz, (0.02, 0.98), axis=0), axis=0) / outputs.dataparser_scale
    assert (box > (3.0, 3.0, 1.5)).all()


@pytest.mark.parametrize("ending", [".npy", ".png", ".exr"])
def test_metric_depth_is_scaled_with_the_poses(capture, room, ending, capsys) -> None:
    millimetres = lambda z, _: np.round(1000 * z).astype(np.uint16)  # noqa: E731
    manager = load(capture(millimetres if ending == ".png" else lambda z, _: z.astype(np.float32), ending))
    check(manager, room[1])
    on_surface(manager, room[1])
    out = " ".join(capsys.readouterr().out.split())
    assert "Depth of 14 photographs is used as metric." in out and "initial points are added" in out


def test_holes_and_values_that_are_not_depth(capture, room) -> None:
    def holes(z, i):
        z = z.copy()
        z[:6], z[6:9], z[9:12], z[12:15] = 0.0, np.nan, np.inf, 1e10
        return z

    manager = load(capture(holes))
    check(manager, room[1])
    assert not manager.train_views[0].depth[:15].any()


def test_another_unit_is_found_by_the_points(capture, room, capsys) -> None:
    check(load(capture(lambda z, _: 1000.0 * z)), room[1])
    assert "times 0.001 by the points" in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize("inverse", [False, True])
def test_relative_depth_is_fitted_to_the_points(capture, room, inverse, capsys) -> None:
    def relative(z, i):
        return (0.3 + 0.02 * i) / z + 0.1 if inverse else (z + 0.4 * (1 + i % 3)) * (0.2 + 0.05 * i)

    check(load(capture(relative)), room[1], 0.06)
    out = " ".join(capsys.readouterr().out.split())
    assert "is relative and inverse" in out if inverse else "is relative:" in out


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda z, _: 0.0 * z, "have no valid pixel"),
        (lambda z, _: np.nan * z, "have no valid pixel"),
        (lambda z, _: 0.0 * z + 2.0, "depth is not used"),
        (lambda z, i: np.random.default_rng(i).uniform(0.5, 50.0, z.shape), "depth is not used"),
    ],
)
def test_useless_depth_is_not_used(capture, change, message, capsys) -> None:
    manager = load(capture(change))
    assert message in " ".join(capsys.readouterr().out.split())
    assert all(view.depth is None for view in manager.train_views)
    assert len(manager.train_dataparser_outputs.metadata["points3D_xyz"]) == 400


def test_without_points_photographs_are_compared(capture, room, capsys, monkeypatch) -> None:
    monkeypatch.setattr("bitymi_ns.capture.read._Reader._points", lambda *_: None)
    manager = load(capture(points=False))
    check(manager, room[1])
    on_surface(manager, room[1])
    load(capture(lambda z, _: 20.0 * z, points=False))
    assert "Its unit may be another" in " ".join(capsys.readouterr().out.split())
    load(capture(points=False), depth="relative")
    assert "Relative depth needs points" in " ".join(capsys.readouterr().out.split())


def test_depth_that_cannot_be_read_is_refused(capture) -> None:
    with expect("has 3 channels"):
        load(capture(lambda z, i: np.stack([z, z + 1, z], -1)))
    folder = capture()
    (folder / "depth_3.npy").write_bytes(b"no array")
    with expect("depth_3.npy cannot be read"):
        load(folder)


LENS = lenses_of(ColmapCamera("PINHOLE", 64, 64, (60.0, 60.0, 32.0, 32.0)), (64, 64), "a camera")[0]


def header(shape: str, descr: str = "<f8") -> bytes:
    """Build the header of a .npy file."""
    text = f"{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text.encode()


def zipped(data: bytes) -> bytes:
    held = io.BytesIO()
    with zipfile.ZipFile(held, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("arr_0.npy", data)
    return held.getvalue()


def png(width: int, height: int) -> bytes:
    """Build a PNG of one pixel that declares another size."""
    data = bytearray(cv2.imencode(".png", np.zeros((1, 1), np.uint16))[1].tobytes())
    data[16:24] = struct.pack(">2I", width, height)
    data[29:33] = struct.pack(">I", zlib.crc32(data[12:29]))
    return bytes(data)


def exr(width: int, height: int, tmp_path: Path) -> bytes:
    write_exr(tmp_path / "one.exr", Y=np.zeros((1, 1), np.float32))
    data = bytearray((tmp_path / "one.exr").read_bytes())
    at = data.index(b"dataWindow\0box2i\0") + 21
    data[at : at + 16] = struct.pack("<4i", 0, 0, width - 1, height - 1)
    return bytes(data)


@pytest.mark.parametrize(
    ("name", "data", "message"),
    [
        ("a.npy", header("(1000000, 1000000)"), "declares 1000000 x 1000000 numbers for a photograph of 64 x 64"),
        ("a.npz", zipped(header("(30000, 30000)") + bytes(1 << 20)), "declares 30000 x 30000 numbers"),
        ("a.npy", header("(520, 520)") + bytes(520 * 520 * 8), "declares 520 x 520 numbers"),  # above 8 times 64
        ("a.npy", header("(64, 64, 100000000)"), "declares 64 x 64 x 100000000 numbers"),
        ("a.npy", header("(64, 32)"), "32 x 64 pixels, but its camera is for 64 x 64"),
        ("a.npy", header("(64, 64)") + bytes(64), "a.npy cannot be read: it is cut off: it has 64 of 32768 bytes"),
        ("a.npy", header("(-64, 64)"), "no map of numbers, but declares"),
        ("a.npy", header("(64, 64)", "|O"), "cannot be read: it holds no numbers, but object"),
        ("a.npy", header("(" * 3000), "a.npy cannot be read: "),
        ("a.npz", b"PK\x05\x06" + bytes(18), "a.npz cannot be read: "),
        ("a.png", png(1 << 14, 1 << 14), "declares 16384 x 16384 numbers|pixels. exceeds limit of"),
        ("a.png", png(640, 320), "640 x 320 pixels, but its camera is for 64 x 64"),
        ("a.png", png(64, 64), "a.png cannot be read"),
        ("a.exr", 1 << 20, "declares 1048576 x 1048576 numbers"),
        ("a.tif", b"II*\0\x08\0\0\0\x02\0" + struct.pack("<2HIIHHIII", 256, 4, 1, 1 << 20, 257, 4, 1, 1 << 20, 0),
         "declares 1048576 x 1048576 numbers"),
        ("a.tif", b"II*\0\xff\xff\xff\x7f", "a.tif cannot be read: "),
    ],
)  # fmt: skip
def test_headers_are_compared_with_the_photograph_before_numbers_are_read(tmp_path, name, data, message) -> None:
    (tmp_path / name).write_bytes(exr(data, data, tmp_path) if isinstance(data, int) else data)
    tracemalloc.start()
    with refused(message):
        read_depth(MapFiles(tmp_path / name), LENS)
    assert tracemalloc.get_traced_memory()[1] < 20 << 20
    tracemalloc.stop()
    np.save(tmp_path / "depth.npy", np.ones((64, 64)))
    with refused(f"{name} cannot be read|declares"):
        (tmp_path / name).write_bytes(png(1 << 20, 1 << 20))
        read_depth(MapFiles(tmp_path / "depth.npy", confidence=tmp_path / name), LENS)


def test_an_exr_file_whose_header_lacks_something_is_one_message(tmp_path: Path) -> None:
    """OpenEXR ends the process on these. Found by scripts/fuzz.py."""
    file = tmp_path / "a.exr"
    write_exr(file, Y=np.ones((64, 64), np.float32))
    whole = file.read_bytes()
    for name in (b"dataWindow", b"channels", b"displayWindow"):
        file.write_bytes(whole.replace(name, name[:-1] + b"?", 1))
        with pytest.raises(CaptureError, match=f"its header has no {name.decode()}"):
            read_depth(MapFiles(depth=file), LENS)


@pytest.mark.parametrize("ending", [".exr", ".tif"])
def test_a_damaged_map_is_one_message(tmp_path, ending, capfd) -> None:
    """OpenCV prints lines of its own by default; OpenEXR always. Found by scripts/fuzz.py."""
    file = tmp_path / f"a{ending}"
    write_map(file, np.ones((64, 64), np.float32))
    data = bytearray(file.read_bytes())
    data[len(data) // 2 :] = bytes(len(data) - len(data) // 2)
    file.write_bytes(data)
    if ending == ".exr":
        file.write_bytes(data.replace(b"compression", b"compressiom"))
    with refused(f"a{ending} cannot be read"):
        read_depth(MapFiles(file), LENS)
    assert ending == ".exr" or capfd.readouterr().err == ""


@pytest.mark.parametrize("name", ["a.npy", "a.npz", "a.png", "a.exr"])
def test_maps_that_are_no_files(tmp_path, name) -> None:
    with refused(f"{name} cannot be read: it does not exist"):
        read_depth(MapFiles(tmp_path / name), LENS)
    os.mkfifo(tmp_path / name)
    with refused(f"{name} cannot be read: it is not a regular file"):
        read_depth(MapFiles(tmp_path / name), LENS)


@pytest.mark.parametrize("ending", [".npy", ".npz", ".png", ".exr", ".tif", ".tiff"])
def test_maps_of_every_kind_are_read(tmp_path, ending) -> None:
    values = np.arange(1.0, 64 * 64 + 1.0).reshape(64, 64).astype(np.uint16 if ending == ".png" else np.float32)
    file = tmp_path / f"a{ending}"
    write_map(file, np.asfortranarray(values) if ending == ".npy" else values)
    read = read_depth(MapFiles(file), LENS, 1.0)
    assert np.array_equal(read, values)


@pytest.mark.parametrize(("names", "kind"), [("Z", "f4"), ("V", "f2"), ("RGB", "f4"), ("ABGRZ", "f2"), ("YZ", "f4")])
def test_depth_is_found_among_the_channels_of_an_exr_file(tmp_path, names, kind) -> None:
    values = np.arange(1.0, 64 * 64 + 1.0, dtype=np.float32).reshape(64, 64).astype(kind)
    write_exr(
        tmp_path / "a.exr", **{name: values if name in "YRGBV" or names == "Z" else values[::-1] for name in names}
    )
    assert np.array_equal(read_depth(MapFiles(tmp_path / "a.exr"), LENS, 1.0), values.astype(np.float32))
    write_exr(tmp_path / "a.exr", U=values, V=values)
    with refused("a single channel are read, and it has U, V"):
        read_depth(MapFiles(tmp_path / "a.exr"), LENS)


def test_missing_maps_and_switching_off(capture, capsys) -> None:
    folder = capture()
    (folder / "depth_3.npy").unlink()
    views = load(folder).train_views
    assert "1 files of depth_file_path are missing" in " ".join(capsys.readouterr().out.split())
    assert sum(view.depth is None for view in views) == 1
    off = load(folder, depth="off")
    assert all(view.depth is None for view in off.train_views)
    edit_frames(folder, lambda frame: frame.pop("depth_file_path"))
    without = load(folder)
    for a, b in zip(off.train_views, without.train_views, strict=True):
        assert a.depth is None and b.depth is None and torch.equal(a.image, b.image)
    given, expected = (manager.train_dataparser_outputs.metadata for manager in (off, without))
    assert len(given["points3D_xyz"]) == 400 and torch.equal(given["points3D_xyz"], expected["points3D_xyz"])
    assert given.keys() == expected.keys() and not off.train_dataset.facts.fitted
    assert len(load(folder, points="random").train_dataparser_outputs.metadata.get("points3D_xyz", ())) == 0


def test_normals_of_a_capture(capture, room, capsys) -> None:
    folder = capture()
    normal = np.zeros((HEIGHT, WIDTH, 3)) + (0.0, 0.6, 0.8)  # x right, y up, z back
    image = np.round((normal + 1.0) / 2.0 * 255).astype(np.uint8)
    image[:5] = 0
    cv2.imwrite(str(folder / "normal.png"), image[..., ::-1])
    edit_frames(folder, lambda frame: frame.update(normal_file_path="normal.png"))
    manager = load(folder)
    normal = manager.train_views[0].normal.float()
    assert normal.shape == (HEIGHT, WIDTH, 3) and not normal[:5].any()
    torch.testing.assert_close(normal[20, 20], torch.tensor([0.0, -0.6, -0.8]), atol=0.01, rtol=0)
    cv2.imwrite(str(folder / "normal.png"), 255 - image[..., ::-1])
    load(folder)
    assert "face away from the camera" in " ".join(capsys.readouterr().out.split())


def test_maps_of_scanners(tmp_path) -> None:
    for name in ("images", "depth", "confidence"):
        (tmp_path / name).mkdir()
    depth = np.full((48, 64), 1500, np.uint16)
    depth[0] = 65535
    confidence = np.full((24, 32), 255, np.uint8)
    confidence[-1] = 0
    cv2.imwrite(str(tmp_path / "depth/7.png"), depth)
    cv2.imwrite(str(tmp_path / "confidence/7.png"), confidence)
    (files,) = maps_beside([tmp_path / "images/7.jpg"])
    assert files == MapFiles(tmp_path / "depth/7.png", tmp_path / "confidence/7.png")
    (lens,) = lenses_of(ColmapCamera("PINHOLE", 128, 96, (100.0, 100.0, 64.0, 48.0)), (128, 96), "")
    read = read_depth(files, lens)
    assert read.shape == (96, 128) and not read[:2].any() and not read[-4:].any()
    assert np.allclose(read[2:-4], 1.5)
    assert read_depth(files, lens, 0.01).max() == pytest.approx(15.0)


def test_color_pictures_in_a_scanners_depth_folder_are_not_used(tmp_path, capsys) -> None:
    photographs = [tmp_path / f"rgb/{i}.jpg" for i in range(3)]
    (tmp_path / "depth").mkdir()
    color = np.random.default_rng(0).integers(0, 255, (24, 32, 3), np.uint8)
    for i in range(3):
        cv2.imwrite(str(tmp_path / f"depth/{i}.png"), color)
    assert maps_beside(photographs) == [MapFiles()] * 3
    assert "holds color pictures, not depth" in " ".join(capsys.readouterr().out.split())
    for values in (np.full((24, 32, 3), 7, np.uint8), np.full((24, 32), 900, np.uint16)):  # grey, millimetres
        cv2.imwrite(str(tmp_path / "depth/1.png"), values)
        assert all(files.depth is not None for files in maps_beside(photographs))
    (tmp_path / "depth/1.png").write_bytes(b"no image")
    assert all(files.depth is not None for files in maps_beside(photographs))
    assert "color" not in capsys.readouterr().out


def test_distorted_photographs_have_their_depth_moved(tmp_path) -> None:
    camera = ColmapCamera("OPENCV", 64, 48, (60.0, 60.0, 32.0, 24.0, 0.1, 0.02, 0.0, 0.0))
    (lens,) = lenses_of(camera, camera.size, "a camera")
    columns = np.broadcast_to(np.arange(1.0, 65.0), (48, 64))
    np.save(tmp_path / "depth.npy", columns)
    read = read_depth(MapFiles(tmp_path / "depth.npy"), lens)
    assert read.shape == (lens.pinhole.height, lens.pinhole.width)
    assert set(np.unique(read)) <= set(np.arange(1.0, 65.0))  # nearest, not interpolated
    assert (np.diff(read[len(read) // 2]) >= 0).all()
