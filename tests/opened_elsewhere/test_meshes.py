"""Meshes and Gaussians, read by Khronos's validator, trimesh and plyfile."""

from pathlib import Path
from typing import get_args

import numpy as np
import plyfile
import pytest
import torch
import trimesh

from bitymi_ns.bundle import Bundle
from bitymi_ns.interchange.extras import write_extras
from bitymi_ns.interchange.surface_files import MeshFormat, mesh_bytes
from bitymi_ns.interchange.triangles import Triangles
from tests.opened_elsewhere.node import said_by

UP, HOME = torch.tensor([0.0, 0.0, 1.0]), torch.zeros(3)
NOTE = "positions are relative to the origin 500000 4600000 0"
FAR = torch.tensor([500000.0, 4600000.0, 0.0])
FORMATS = get_args(MeshFormat)


@pytest.fixture(scope="module")
def surface() -> Triangles:
    """An ellipsoid with more than 2^16 vertices and colours of every lightness."""
    shape = trimesh.creation.uv_sphere(1.0, [190, 190])
    vertices = (shape.vertices * (1.0, 2.0, 3.0) + (3.0, 0.0, 33_000.0 / 256)).astype(np.float32)
    colors = np.linspace(0, 1, 3 * len(vertices), dtype=np.float32).reshape(-1, 3)
    return Triangles(vertices, np.array(shape.faces, np.int64), colors)


def issues_of(file: Path) -> list[dict]:
    found = said_by("validate_gltf.mjs", "gltf-validator", file)
    assert found["info"]["totalTriangleCount"] > 0
    return [each for each in found["issues"]["messages"] if each["severity"] < 2]


@pytest.mark.parametrize("origin", [HOME, FAR])
def test_gltf_of_a_surface_is_valid(surface: Triangles, origin: torch.Tensor, tmp_path: Path) -> None:
    (tmp_path / "mesh.glb").write_bytes(mesh_bytes(surface, "glb", UP, origin))
    assert len(surface.vertices) > 1 << 16 and issues_of(tmp_path / "mesh.glb") == []


@pytest.mark.parametrize("frame", ["scene", "capture"])
def test_gltf_of_extras_is_valid(bundle: Bundle, frame: str, tmp_path: Path) -> None:
    write_extras(bundle, tmp_path / "out", ["mesh"], frame=frame)
    assert issues_of(tmp_path / "out" / "mesh.glb") == []


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("origin", [HOME, FAR])
def test_trimesh_finds_the_surface(surface: Triangles, form: MeshFormat, origin: torch.Tensor, tmp_path: Path) -> None:
    path = tmp_path / f"mesh.{form}"
    path.write_bytes(mesh_bytes(surface, form, UP, origin, NOTE if origin.any() else ""))
    scene = trimesh.load_scene(path, process=False)
    (shape,) = scene.geometry.values()
    expected = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
    assert np.array_equal(shape.vertices.astype(np.float32), surface.vertices)
    assert np.array_equal(shape.faces, surface.faces)
    assert shape.is_watertight and shape.area_faces.min() > 0
    assert shape.volume == pytest.approx(expected.volume) and shape.area == pytest.approx(expected.area)
    assert (shape.vertex_normals * (surface.vertices - expected.centroid)).sum(1).min() > 0
    if form == "glb":
        assert np.allclose(scene.bounds.mean(0)[[0, 2, 1]] * (1, -1, 1), expected.bounds.mean(0) + origin.numpy())
    else:
        assert (NOTE.encode() in path.read_bytes()[:1000]) == bool(origin.any())
        colors = shape.visual.vertex_colors[:, :3] / 255
        assert np.abs(colors - surface.colors).max() < 0.005


def test_gltf_has_a_matte_material_and_linear_colors(surface: Triangles, tmp_path: Path) -> None:
    (tmp_path / "mesh.glb").write_bytes(mesh_bytes(surface, "glb", UP, HOME))
    (shape,) = trimesh.load_scene(tmp_path / "mesh.glb", process=False).geometry.values()
    material = shape.visual.material
    assert (material.metallicFactor, material.roughnessFactor, material.doubleSided) == (0.0, 1.0, True)
    read = shape.visual.vertex_attributes["color"][:, :3]
    srgb = np.where(read <= 0.0031308, 12.92 * read, 1.055 * read.clip(1e-9) ** (1 / 2.4) - 0.055)
    assert np.abs(srgb - surface.colors).max() < 1e-5


def test_plyfile_reads_float_positions_and_the_origin(surface: Triangles, tmp_path: Path) -> None:
    (tmp_path / "mesh.ply").write_bytes(mesh_bytes(surface, "ply", UP, FAR, NOTE))
    read = plyfile.PlyData.read(tmp_path / "mesh.ply")
    vertex, face = read["vertex"], read["face"]
    kinds = {each.name: each.dtype()[1:] for each in vertex.properties}
    assert {kinds[name] for name in ("x", "y", "z", "nx", "ny", "nz")} == {"f4"}
    assert {kinds[name] for name in ("red", "green", "blue")} == {"u1"}
    assert NOTE in read.comments and np.array_equal(np.vstack(face["vertex_indices"]), surface.faces)
    assert np.array_equal(np.column_stack([vertex[name] for name in "xyz"]), surface.vertices)
    assert np.abs(vertex["red"] / 255 - surface.colors[:, 0]).max() < 0.005


def test_plyfile_reads_gaussians_and_surfels(bundle: Bundle, tmp_path: Path) -> None:
    write_extras(bundle, tmp_path / "out", ["gaussians"])
    vertex = plyfile.PlyData.read(tmp_path / "out" / "gaussians.ply")["vertex"]
    assert vertex.count == len(bundle.scene) and len(vertex.properties) == 62
    positions = np.column_stack([vertex[name] for name in "xyz"])
    assert np.array_equal(positions, bundle.scene.surfels["means"].numpy())
    surfels = plyfile.PlyData.read(tmp_path / "bundle" / "surfels.ply")["vertex"]
    assert np.array_equal(np.column_stack([surfels[name] for name in "xyz"]), positions)
