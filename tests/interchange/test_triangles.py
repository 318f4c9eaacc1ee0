"""Meshes are closed and have no degenerate faces, whatever the input; trimesh, which merges vertices by position,
agrees."""

import numpy as np
import pytest
import trimesh

from bitymi_ns.interchange.triangles import Triangles, cleaned, solid


def triangles(mesh: trimesh.Trimesh, faces: np.ndarray | None = None) -> Triangles:
    faces = np.array(mesh.faces if faces is None else faces, np.int64)
    return Triangles(mesh.vertices.astype(np.float32), faces, np.full(mesh.vertices.shape, 0.5, np.float32))


def as_read(mesh: Triangles) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=True)


SPHERE = trimesh.creation.icosphere(4)
CORNERS = trimesh.util.concatenate([trimesh.creation.icosphere(3), trimesh.creation.icosphere(3)])
CORNERS.vertices[len(CORNERS.vertices) // 2 :] += 2.0 * CORNERS.vertices[0]  # touch in one point


def with_holes() -> np.ndarray:
    return SPHERE.faces[np.random.default_rng(0).random(len(SPHERE.faces)) > 0.2]


def turned_over() -> np.ndarray:
    faces, chosen = SPHERE.faces.copy(), np.random.default_rng(1).random(len(SPHERE.faces)) < 0.05
    faces[chosen] = faces[chosen][:, ::-1]
    return faces


def with_fins() -> np.ndarray:
    """Build triangles on edges that have two already."""
    far = (SPHERE.faces[:30, 0] + 1000) % len(SPHERE.vertices)
    return np.concatenate([SPHERE.faces, np.column_stack([SPHERE.faces[:30, :2], far])])


@pytest.mark.parametrize("faces", [with_holes(), turned_over(), with_fins(), SPHERE.faces[:, ::-1]])
def test_a_solid_is_closed_and_seen_from_outside(faces: np.ndarray) -> None:
    broken = triangles(SPHERE, faces)
    mesh = solid(broken, 0.0)
    read = as_read(mesh)
    assert mesh.open_edges() == 0 and read.is_watertight and read.is_winding_consistent
    assert np.isclose(mesh.volume(), SPHERE.volume, rtol=0.03) and np.isclose(read.volume, mesh.volume(), rtol=1e-5)
    assert read.area_faces.min() > 0 and mesh.colors.min() == mesh.colors.max() == 0.5


def test_parts_that_touch_are_closed_each() -> None:
    mesh = solid(triangles(CORNERS), 0.0)
    read = as_read(mesh)
    assert read.is_watertight and np.isclose(mesh.volume(), CORNERS.volume, rtol=0.02)
    one = triangles(SPHERE)
    crumb = Triangles(one.vertices * 0.01 + 3, one.faces[:40], one.colors)
    both = Triangles(
        np.concatenate([one.vertices, crumb.vertices]),
        np.concatenate([one.faces, crumb.faces + len(one.vertices)]),
        np.concatenate([one.colors, crumb.colors]),
    )
    assert solid(both, 0.01).parts().max() == 0 and both.without_specks(0.001).parts().max() > 0


@pytest.mark.parametrize("steps", [8, 14])
def test_positions_that_fall_together_leave_no_flat_faces(steps: int) -> None:
    mesh = triangles(SPHERE)
    coarse = Triangles((mesh.vertices * steps).round() / steps, mesh.faces, mesh.colors)
    mesh = cleaned(coarse)
    read = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert (trimesh.Trimesh(coarse.vertices, coarse.faces, process=False).area_faces == 0).sum() > 30
    assert read.area_faces.min() > 1e-5 and read.is_watertight
    line = np.array([[0, 0, 0], [1, 0, 0], [3, 0, 0], [0, 4, 0]], np.float32)  # a face on a line beside another
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    assert len(cleaned(Triangles(line, faces, line))) == 1


def test_nothing_is_left_of_nothing() -> None:
    empty = triangles(SPHERE, np.empty((0, 3)))
    assert len(cleaned(empty)) == len(solid(empty, 0.1)) == 0
