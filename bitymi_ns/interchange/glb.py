"""Binary glTF files of quads and surfaces, with trimesh."""

from typing import Any

import numpy as np
import torch
import trimesh
from PIL import Image
from torch import Tensor
from trimesh.exchange.gltf import export_glb
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from .quads import MASK, Quads
from .triangles import Triangles

_LINEAR, _CLAMP = 9729, 33071
_FACES = ((0, 1, 2), (0, 2, 3))
_COLOR = "_COLOR_0"  # float attribute: trimesh writes vertex colors as bytes, too coarse for linear colors


def upright(up: Tensor, origin: Tensor | None = None) -> np.ndarray:
    """Compute the transform [4, 4] of a glTF node from positions relative to an origin [3], with up direction `up` [3],
    to glTF's frame with +y up."""
    place = np.eye(4)
    place[:3, :3] = _to_y(up.double().numpy())
    if origin is not None:
        place[:3, 3] = place[:3, :3] @ origin.double().numpy()
    return place


def quads_glb(quads: Quads, place: np.ndarray) -> bytes:
    """Encode at least one quad as glTF: a mesh per page with the page as PNG, two triangles per quad, double-sided and
    unlit, without mip levels, which would mix tiles. `place`: of `upright`."""
    scene = trimesh.Scene()
    for page in torch.unique(quads.page).tolist():
        rows = torch.nonzero(quads.page == page).squeeze(1)
        texture = Image.fromarray(quads.pages[page].numpy())
        material = _matte(baseColorTexture=texture, alphaMode="MASK", alphaCutoff=MASK)
        uv = quads.uv[rows].reshape(-1, 2).double().numpy()
        uv[:, 1] = 1.0 - uv[:, 1]  # trimesh counts from the bottom, glTF from the top
        mesh = trimesh.Trimesh(
            quads.corners[rows].reshape(-1, 3).numpy(),
            (4 * np.arange(len(rows))[:, None, None] + np.array(_FACES)).reshape(-1, 3),
            visual=TextureVisuals(uv=uv, material=material),
            process=False,
        )
        scene.add_geometry(mesh, node_name=f"surfels-{page}", geom_name=f"surfels-{page}", transform=place)
    return export_glb(scene, include_normals=False, tree_postprocessor=_unlit)


def surface_glb(mesh: Triangles, normals: np.ndarray, place: np.ndarray) -> bytes:
    """Encode a surface with vertex normals [V, 3] as glTF: linear vertex colors, lit, double-sided."""
    linear = np.where(mesh.colors <= 0.04045, mesh.colors / 12.92, ((mesh.colors + 0.055) / 1.055) ** 2.4)
    shape = trimesh.Trimesh(
        mesh.vertices,
        mesh.faces,
        vertex_normals=normals,
        vertex_attributes={_COLOR: linear.clip(0.0, 1.0).astype(np.float32)},
        visual=TextureVisuals(material=_matte()),
        process=False,
    )
    scene = trimesh.Scene()
    scene.add_geometry(shape, node_name="surface", geom_name="surface", transform=place)
    return export_glb(scene, include_normals=True, tree_postprocessor=_colored)


def _matte(**more: Any) -> PBRMaterial:
    return PBRMaterial(metallicFactor=0.0, roughnessFactor=1.0, doubleSided=True, **more)


def _colored(tree: dict[str, Any]) -> None:
    """Rename the vertex color attribute to glTF's COLOR_0."""
    for mesh in tree["meshes"]:
        attributes = mesh["primitives"][0]["attributes"]
        attributes["COLOR_0"] = attributes.pop(_COLOR)


def _unlit(tree: dict[str, Any]) -> None:
    """Add the unlit extension and the sampler, which trimesh cannot write."""
    tree["extensionsUsed"] = sorted({*tree.get("extensionsUsed", ()), "KHR_materials_unlit"})
    for material in tree["materials"]:
        material["extensions"] = {"KHR_materials_unlit": {}}
    tree["samplers"] = [{"magFilter": _LINEAR, "minFilter": _LINEAR, "wrapS": _CLAMP, "wrapT": _CLAMP}]
    for texture in tree["textures"]:
        texture["sampler"] = 0


def _to_y(up: np.ndarray) -> np.ndarray:
    """Compute the smallest rotation of a direction to +y."""
    up = up / np.linalg.norm(up)
    axis, cosine = np.cross(up, (0.0, 1.0, 0.0)), up[1]
    if cosine < -1 + 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    skew = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + skew + skew @ skew / (1 + cosine)
