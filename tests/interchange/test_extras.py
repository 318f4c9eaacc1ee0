"""The folder of extras beside a bundle: files, location, refusals."""

import io
import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from bitymi_ns import cli
from bitymi_ns.bundle import Bundle, BundleError, check_files, read_bundle
from bitymi_ns.bundle.cameras import CapturedCamera, cameras_data
from bitymi_ns.bundle.read import read_cameras
from bitymi_ns.bundle.single import write_single
from bitymi_ns.interchange import extras
from bitymi_ns.interchange.extras import extras_folder, training_cameras, write_extras
from bitymi_ns.interchange.frame import to_capture, up_of
from bitymi_ns.interchange.glb import upright
from bitymi_ns.ply import parse_ply
from tests.bundle.made import make
from tests.interchange.glb import read_glb
from tests.typed import Patch, Printed


def positions(path: Path) -> torch.Tensor:
    vertex = parse_ply(path.read_bytes())["vertex"]
    return torch.from_numpy(np.stack([vertex[name] for name in "xyz"], 1))


@pytest.fixture
def with_cameras(surfels, camera, tmp_path: Path) -> Path:
    """Write a bundle with cameras.json and a photograph of half its camera's size."""
    buffer = io.BytesIO()
    Image.fromarray(np.full((24, 32, 3), 90, np.uint8)).save(buffer, format="PNG")
    views = [("a.jpg", camera(6.0), False), ("b.jpg", camera(7.0), False), ("d.jpg", camera(8.0), True)]
    views.append(("c.jpg", camera(6.5), True, "photograph-0001.jpg"))
    files = {"cameras.json": cameras_data(CapturedCamera.of(*view) for view in views)}
    files["photograph-0001.jpg"] = buffer.getvalue()
    make(surfels, tmp_path / "scene", count=12, mean_residual=torch.zeros(12, 3), extra_files=files)
    return tmp_path / "scene"


def test_both_files_hold_the_scene(bundle: Bundle, camera, tmp_path: Path) -> None:
    out = tmp_path / "out"
    written = write_extras(bundle, out, cameras=[camera(6.0), camera(8.0)])
    assert {path.name for path in out.iterdir()} == {"gaussians.ply", "mesh.glb", "extras.json"}
    stated = json.loads((out / "extras.json").read_text())
    assert stated["frame"] == "scene" and stated["training_views"] == 2
    for kind, each in written.items():
        assert each.bytes == (out / each.file).stat().st_size == stated[kind]["bytes"]
        assert extras.summary_line(each).startswith(f"{each.file}: {each.count}, ")
    assert torch.equal(positions(out / "gaussians.ply"), bundle.scene.surfels["means"])
    assert len(read_glb(out / "mesh.glb")) == written["mesh"].count


def test_the_captures_frame_is_reached(bundle: Bundle, tmp_path: Path) -> None:
    for frame in ("scene", "capture"):
        write_extras(bundle, tmp_path / frame, frame=frame)
    place = bundle.info.world
    transform = torch.tensor(place.transform)

    def back(points: torch.Tensor) -> torch.Tensor:
        return place.scale * (points @ transform[:, :3].T + transform[:, 3])

    def unturned(points: torch.Tensor, up: torch.Tensor) -> torch.Tensor:
        return points @ torch.from_numpy(upright(up)[:3, :3]).float()

    old, new = (positions(tmp_path / frame / "gaussians.ply") for frame in ("scene", "capture"))
    assert torch.allclose(back(new), old, atol=2e-5)
    old, new = (read_glb(tmp_path / frame / "mesh.glb").corners for frame in ("scene", "capture"))
    old = torch.stack([old[..., 0], -old[..., 2], old[..., 1]], -1)  # z up
    assert torch.allclose(back(unturned(new, up_of(place, to_capture(place)))), old, atol=2e-5)


def test_far_away_the_files_state_their_origin(bundle: Bundle, tmp_path: Path) -> None:
    place = bundle.info.world
    far = [[*row[:3], row[3] + 1e5] for row in place.transform]
    bundle.info.world = place.model_copy(update={"transform": far})
    written = write_extras(bundle, tmp_path / "out", frame="capture")
    to = to_capture(bundle.info.world)
    header = (tmp_path / "out" / "gaussians.ply").read_bytes().split(b"end_header")[0].decode()
    assert f"comment {to.note}\n" in header and to.note
    assert all(to.note in extras.summary_line(each) for each in written.values())
    assert json.loads((tmp_path / "out" / "extras.json").read_text())["mesh"]["note"] == to.note
    turn = torch.from_numpy(upright(up_of(bundle.info.world, to))[:3, :3])
    corners = read_glb(tmp_path / "out" / "mesh.glb").corners.double().mean((0, 1))
    means = positions(tmp_path / "out" / "gaussians.ply").double().mean(0)
    assert float((corners - turn @ (means + to.origin)).norm()) < 20.0 < float(to.origin.norm())


def test_the_command_writes_a_bundle_alone(with_cameras: Path, tmp_path: Path, capsys: Printed) -> None:
    assert cli.main(["extras", str(with_cameras)]) == 0
    out = capsys.readouterr().out
    assert "gaussians.ply: 12, " in out
    folder = tmp_path / "scene.extras"
    assert extras_folder(with_cameras) == folder and (folder / "mesh.glb").is_file()
    assert cli.main(["extras", str(with_cameras)]) == 1
    assert "--overwrite\n" in capsys.readouterr().err
    assert cli.main(["extras", str(with_cameras), "--kinds", "gaussians"]) == 1
    assert "removes mesh.glb unless you ask for all kinds" in " ".join(capsys.readouterr().err.split())
    args = ["extras", str(with_cameras), "--kinds", "gaussians", "--overwrite", "--frame", "capture"]
    assert cli.main(args) == 0
    assert {path.name for path in folder.iterdir()} == {"gaussians.ply", "extras.json"}
    assert "Removed mesh.glb of the earlier " in " ".join(capsys.readouterr().out.split())


def test_a_crop_hides_surfels_of_notes(with_cameras: Path, tmp_path: Path, capsys: Printed) -> None:
    args = ["extras", str(with_cameras), "--crop", "--overwrite"]
    assert cli.main(args) == 1 and "hides no surfels" in capsys.readouterr().err
    assert not (tmp_path / "scene.extras").exists()
    means = read_bundle(with_cameras).scene.surfels["means"]
    notes = {"format": "bitymi-notes", "version": 2, "views": [], "notes": []}
    floor = {"normal": [1, 0, 0], "offset": float(means[:, 0].median())}
    (with_cameras / "notes.json").write_text(json.dumps({**notes, "crop": {"floor": floor}}))
    assert cli.main(args) == 0
    out = capsys.readouterr().out
    left = means[means[:, 0] >= floor["offset"]]
    assert f"{12 - len(left)} of 12 surfels are hidden" in out
    assert torch.equal(positions(tmp_path / "scene.extras" / "gaussians.ply"), left)
    assert cli.main(["view", str(with_cameras), "--export", str(tmp_path / "site")]) == 0
    assert "The page hides surfels" in capsys.readouterr().out


def test_cameras_are_read_from_folder_and_file(with_cameras: Path, tmp_path: Path) -> None:
    write_single(with_cameras, tmp_path / "scene.bitymi")
    for bundle in (with_cameras, tmp_path / "scene.bitymi"):
        read = read_bundle(bundle)
        assert [camera.width for camera in training_cameras(read)] == [64, 64] and len(read.cameras) == 4
    assert extras_folder(tmp_path / "scene.bitymi") == tmp_path / "scene.extras"


ROW = b"""{"cameras": [{"name": "a", "held_out": true, "width": 8, "height": 6, "fx": 5, "fy": 5, "cx": 4, "cy": 3,
"viewmat": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1], "correction": %s}]}"""


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b"{", "cannot be read as JSON"),
        (b'{"cameras": 3}', "must have a list cameras"),
        (b'{"cameras": [' + b"[]," * 300_000 + b"[]]}", "of at most 100,000"),
        (b'{"cameras": [' + b"[]," * 90_000 + b"[]]}", "cameras.0: "),
        (b'{"cameras": [{"name": "a"}]}', "held_out"),
        (b'{"cameras": [{"name": "a", "held_out": true, "width": 0}]}', "width"),
        (ROW % b"[1, 1, 1, 1]", "cameras.0.correction: .*must be 3 or 12 numbers, not 4"),
        (ROW % b"[1, 1, NaN]", "NaN"),
        (ROW % b"[1, 1, 1e999]", "1e999 is not a finite number"),
        (ROW % b"[1, 1, 2e9]", "correction.2"),
    ],
)
def test_damaged_cameras_are_refused(surfels, tmp_path: Path, text: bytes, message: str, monkeypatch: Patch) -> None:
    monkeypatch.setattr("bitymi_ns.bundle.write.read_bundle", Path)  # as a program that does not read what it wrote
    make(surfels, tmp_path / "b", extra_files={"cameras.json": text})
    with pytest.raises(BundleError, match=message):
        read_bundle(tmp_path / "b")
    (*_, contents) = check_files(tmp_path / "b")[1]
    assert not contents.ok and re.search(message, contents.detail)
    (tmp_path / "b" / "cameras.json").write_bytes(text[:-1] + b"?")
    with pytest.raises(BundleError, match="altered"):
        read_cameras(tmp_path / "b")


def test_what_cannot_be_written_is_refused_before_the_work(bundle: Bundle, tmp_path: Path) -> None:
    with pytest.raises(BundleError, match="there is no extra 'spz'"):
        write_extras(bundle, tmp_path / "out", ["spz"])  # type: ignore[list-item]
    with pytest.raises(BundleError, match="no extra is asked for"):
        write_extras(bundle, tmp_path / "out", [])
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "letter.txt").write_text("dear")
    with pytest.raises(BundleError, match="is not a folder of extras and is not replaced"):
        write_extras(bundle, tmp_path / "mine", overwrite=True)
    (tmp_path / "mine" / "extras.json").write_text("{}")
    with pytest.raises(BundleError, match="also holds letter.txt, which would be lost"):
        write_extras(bundle, tmp_path / "mine", overwrite=True)
    assert (tmp_path / "mine" / "letter.txt").read_text() == "dear"


def test_nothing_is_left_half_written(bundle: Bundle, tmp_path: Path, monkeypatch: Patch) -> None:
    write_extras(bundle, tmp_path / "out", ["gaussians"])
    before = (tmp_path / "out" / "extras.json").read_bytes()
    names = {path.name for path in tmp_path.iterdir()}
    bundle.scene.surfels["opacity_logits"][:] = -9.0
    with pytest.raises(BundleError, match="there is no mesh"):
        write_extras(bundle, tmp_path / "out", overwrite=True)

    def full(*args: object, **more: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(extras, "write_gaussians", full)
    with pytest.raises(BundleError, match="the disk is full"):
        write_extras(bundle, tmp_path / "out", ["gaussians"], overwrite=True)
    assert {path.name for path in tmp_path.iterdir()} == names
    assert (tmp_path / "out" / "extras.json").read_bytes() == before
