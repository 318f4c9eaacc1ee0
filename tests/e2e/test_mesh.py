"""`ns-export bitymi-mesh` on a run and on its bundle."""

import json
import re
from pathlib import Path

import numpy as np
import open3d
import pytest
import trimesh

from bitymi_ns.bundle import read_bundle
from bitymi_ns.bundle.manifest import dump
from bitymi_ns.bundle.world import World
from bitymi_ns.plugin.console import InputError
from bitymi_ns.plugin.export.mesh import ExportMesh
from bitymi_ns.plugin.run.config import BitymiTrainerConfig as Run
from tests.typed import Patch, Printed


def mesh_of(load_config: Path, folder: Path, **options: object) -> open3d.geometry.TriangleMesh:
    ExportMesh(load_config=load_config, output_dir=folder, resolution=48, **options).main()
    return open3d.io.read_triangle_mesh(str(folder / "mesh.ply"))


def place(bundle: Path, transform: np.ndarray) -> None:
    info = read_bundle(bundle).info
    info.world = info.world.replace(transform=tuple(map(tuple, transform.tolist())))
    (bundle / "bundle.json").write_bytes(dump(info))


@pytest.mark.slow
def test_a_run_and_its_bundle_give_the_same_surface(trained: Run, bundle: Path, tmp_path: Path) -> None:
    run = mesh_of(trained.get_base_dir() / "config.yml", tmp_path / "run", frame="scene")
    baked = mesh_of(bundle / "config.yml", tmp_path / "bundle", frame="scene")
    assert len(run.triangles) > 100 and run.has_vertex_colors()
    a, b = (np.asarray(mesh.vertices) for mesh in (run, baked))
    side = np.ptp(a, axis=0).max()
    assert np.abs(a.mean(0) - b.mean(0)).max() < 0.1 * side
    # the frames differ by a rotation, a scale and a shift
    captured = mesh_of(bundle / "config.yml", tmp_path / "capture")
    ratio = np.sqrt(captured.get_surface_area() / baked.get_surface_area())
    assert ratio > 1.0  # nerfstudio scales cameras into [-1, 1]; the room is metres wide
    folder = tmp_path / "capture"
    before = (folder / "mesh.ply").read_bytes()
    for form in ("glb", "obj"):
        mesh_of(bundle / "config.yml", folder, format=form)
        shape = trimesh.load_mesh(folder / f"mesh.{form}", process=False)
        assert len(shape.faces) == len(captured.triangles)
        assert shape.area == pytest.approx(captured.get_surface_area(), rel=1e-4)
    assert (folder / "mesh.ply").read_bytes() == before


def test_a_mesh_of_a_crop(copied: Path, trained: Run, tmp_path: Path, capsys: Printed) -> None:
    low = float(read_bundle(copied).scene.surfels["means"][:, 2].median())
    crop = {"floor": {"normal": [0, 0, 1], "offset": low}}
    notes = {"format": "bitymi-notes", "version": 2, "views": [], "notes": [], "crop": crop}
    (copied / "notes.json").write_text(json.dumps(notes))
    whole, some = (mesh_of(copied / "config.yml", tmp_path / f"{crop}", frame="scene", crop=crop) for crop in (0, 1))
    assert np.quantile(np.asarray(some.vertices)[:, 2], 0.05) > low - 0.1 > np.asarray(whole.vertices)[:, 2].min()
    assert "surfels are hidden by notes.json" in capsys.readouterr().out
    with pytest.raises(InputError, match="--crop is for bundles"):
        mesh_of(trained.get_base_dir() / "config.yml", tmp_path / "run", crop=True)


@pytest.mark.slow
def test_a_closed_mesh_is_closed(bundle: Path, tmp_path: Path, capsys: Printed) -> None:
    mesh_of(bundle / "config.yml", tmp_path / "mesh", watertight=True, triangles=5000)
    shape = trimesh.load_mesh(tmp_path / "mesh" / "mesh.ply")
    assert shape.is_watertight and shape.is_winding_consistent and shape.volume > 0 and 500 < len(shape.faces) <= 5000
    assert "not watertight" not in capsys.readouterr().out


@pytest.mark.slow
def test_a_mesh_on_a_map(copied: Path, bundle: Path, tmp_path: Path, capsys: Printed) -> None:
    """A capture in map coordinates gives the same sizes and shapes."""
    turn = np.array(read_bundle(copied).info.world.transform)
    turn[:, 3] -= turn[:, :3] @ (500123.0, 4649876.0, 312.0)
    place(copied, turn)
    mesh_of(bundle / "config.yml", tmp_path / "home")
    home = trimesh.load_mesh(tmp_path / "home" / "mesh.ply", process=False)
    capsys.readouterr()
    for form in ("ply", "obj", "glb"):
        ExportMesh(load_config=copied / "config.yml", output_dir=tmp_path / "far", resolution=48, format=form).main()
        said = "".join(capsys.readouterr().out.split())
        assert "relativetotheorigin" in said
        path = tmp_path / "far" / f"mesh.{form}"
        scene = trimesh.load_scene(path, process=False)
        (shape,) = scene.geometry.values()
        assert shape.area == pytest.approx(home.area, rel=1e-4) and shape.area_faces.min() > 0
        if form == "glb":
            middle = scene.bounds.mean(0)[[0, 2, 1]] * (1, -1, 1)
        else:
            stated = re.search(rb"relative to the origin (.*)", path.read_bytes()[:2000])
            middle = shape.bounds.mean(0) + np.array(stated[1].split(), float)
        assert np.abs(middle - home.bounds.mean(0) - (500123.0, 4649876.0, 312.0)).max() < 0.01


def test_a_bent_capture_names_the_scenes_frame(trained: Run, copied: Path, tmp_path: Path, monkeypatch: Patch) -> None:
    bent = World(np.diag([1.0, 2.0, 1.0, 1.0])[:3], 1.0)
    place(copied, bent.transform)
    monkeypatch.setattr("bitymi_ns.plugin.export.mesh.world_of", lambda datamanager: bent)
    for config in (copied / "config.yml", trained.get_base_dir() / "config.yml"):
        with pytest.raises(InputError, match=r"no rotation with one scale, .* \(--frame scene\)") as raised:
            mesh_of(config, tmp_path / "mesh")
        assert "bundle" not in str(raised.value) and not (tmp_path / "mesh").exists()


@pytest.mark.slow
def test_what_stands_in_the_place_of_a_mesh_is_kept(trained: Run, tmp_path: Path) -> None:
    config, folder = trained.get_base_dir() / "config.yml", tmp_path / "mesh"
    folder.mkdir()
    for name in ("notes.txt", "mesh.ply", "mesh.mtl"):
        (folder / name).write_text("mine")
    with pytest.raises(InputError, match="mesh.ply is there already: .*--overwrite True"):
        mesh_of(config, folder)
    mesh_of(config, folder, format="glb")
    assert {path.name for path in folder.iterdir()} == {"notes.txt", "mesh.ply", "mesh.mtl", "mesh.glb"}
    mesh_of(config, folder, format="obj")
    assert {path.name for path in folder.iterdir()} == {"notes.txt", "mesh.ply", "mesh.mtl", "mesh.obj", "mesh.glb"}
    (tmp_path / "file").write_text("mine")
    with pytest.raises(InputError, match="file is not a folder"):
        mesh_of(config, tmp_path / "file")
    assert (folder / "mesh.ply").read_text() == "mine"
    with pytest.raises(InputError, match="--resolution must be greater than or equal to 16"):
        ExportMesh(load_config=config, output_dir=tmp_path / "new", resolution=2).main()
    with pytest.raises(InputError, match="there is no"):
        ExportMesh(load_config=tmp_path / "config.yml", output_dir=tmp_path / "new").main()
    assert not (tmp_path / "new").exists()
