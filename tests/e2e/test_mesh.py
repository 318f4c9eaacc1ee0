"""`ns-export bitymi-mesh` on a run and on its bundle."""

from pathlib import Path

import numpy as np
import open3d
import pytest
import trimesh

from bitymi_ns.plugin.console import InputError
from bitymi_ns.plugin.export.mesh import ExportMesh
from bitymi_ns.plugin.run.config import BitymiTrainerConfig


def mesh_of(load_config: Path, folder: Path, **options: object) -> open3d.geometry.TriangleMesh:
    ExportMesh(load_config=load_config, output_dir=folder, resolution=48, **options).main()
    return open3d.io.read_triangle_mesh(str(next(folder.iterdir())))


def test_a_run_and_its_bundle_give_the_same_surface(trained: BitymiTrainerConfig, bundle: Path, tmp_path: Path) -> None:
    run = mesh_of(trained.get_base_dir() / "config.yml", tmp_path / "run", frame="scene")
    baked = mesh_of(bundle / "config.yml", tmp_path / "bundle", frame="scene")
    assert len(run.triangles) > 100 and run.has_vertex_colors()
    a, b = (np.asarray(mesh.vertices) for mesh in (run, baked))
    side = np.ptp(a, axis=0).max()
    assert np.abs(a.mean(0) - b.mean(0)).max() < 0.1 * side
    # the capture's frame is the scene's by a rotation, a scale and a shift
    captured = mesh_of(bundle / "config.yml", tmp_path / "capture")
    ratio = np.sqrt(captured.get_surface_area() / baked.get_surface_area())
    assert ratio > 1.0  # nerfstudio scales cameras into a box from -1 to 1; the room is metres wide
    mesh_of(bundle / "config.yml", tmp_path / "glb", format="glb")
    (shape,) = trimesh.load(tmp_path / "glb" / "mesh.glb").geometry.values()
    assert len(shape.faces) == len(captured.triangles)


def test_what_stands_in_the_place_of_a_mesh_is_kept(trained: BitymiTrainerConfig, tmp_path: Path) -> None:
    config, folder = trained.get_base_dir() / "config.yml", tmp_path / "mesh"
    folder.mkdir()
    (folder / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="holds other files"):
        mesh_of(config, folder)
    (folder / "notes.txt").rename(folder / "mesh.ply")
    with pytest.raises(InputError, match="holds a mesh already"):
        mesh_of(config, folder)
    assert (folder / "mesh.ply").read_text() == "mine"
    with pytest.raises(InputError, match="--resolution must be greater than or equal to 16"):
        ExportMesh(load_config=config, output_dir=tmp_path / "new", resolution=2).main()
    with pytest.raises(InputError, match="there is no"):
        ExportMesh(load_config=tmp_path / "config.yml", output_dir=tmp_path / "new").main()
    assert not (tmp_path / "new").exists()
