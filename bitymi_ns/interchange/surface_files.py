"""Surface mesh files: PLY, glTF and OBJ."""

import io
from typing import Literal

import numpy as np
import trimesh
from torch import Tensor
from trimesh.exchange.ply import export_ply

from .glb import surface_glb, upright
from .triangles import Triangles

MeshFormat = Literal["ply", "glb", "obj"]


def mesh_bytes(mesh: Triangles, form: MeshFormat, up: Tensor, origin: Tensor, note: str = "") -> bytes:
    """Encode a mesh with vertex colors and normals. PLY and OBJ keep its axes and have `note`, one line or empty, as a
    comment; glTF has +y up and the origin in its node. `up`, `origin`: [3]."""
    normals = _normals(mesh)
    if form == "glb":
        return surface_glb(mesh, normals, upright(up, origin))
    if form == "obj":
        return _obj(mesh, normals, note)
    colors = np.rint(mesh.colors * 255).astype(np.uint8)
    shape = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_normals=normals, vertex_colors=colors, process=False)
    data = export_ply(shape, vertex_normal=True)
    return data.replace(b"\nelement", f"\ncomment {note}\nelement".encode("ascii"), 1) if note else data


def _normals(mesh: Triangles) -> np.ndarray:
    a, b, c = (mesh.vertices.astype(np.float64)[corner] for corner in mesh.faces.T)
    total = np.zeros(mesh.vertices.shape)
    for corner in mesh.faces.T:
        np.add.at(total, corner, np.cross(b - a, c - a))
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.where(length > 0, total / np.where(length > 0, length, 1.0), (0.0, 0.0, 1.0)).astype(np.float32)


def _obj(mesh: Triangles, normals: np.ndarray, note: str) -> bytes:
    buffer = io.StringIO()
    buffer.write("# bitymi-ns: position and color of vertices, normals, triangles\n" + (f"# {note}\n" if note else ""))
    # nine digits, which float32 needs
    np.savetxt(buffer, np.concatenate([mesh.vertices, mesh.colors], 1), "v %.9g %.9g %.9g %.4f %.4f %.4f")
    np.savetxt(buffer, normals, "vn %.5f %.5f %.5f")
    np.savetxt(buffer, (mesh.faces + 1).repeat(2, axis=1), "f %d//%d %d//%d %d//%d")
    return buffer.getvalue().encode("ascii")
