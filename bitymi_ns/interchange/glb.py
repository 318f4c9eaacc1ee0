"""Quads as a binary glTF file, by trimesh."""

from typing import Any

import numpy as np
import torch
import trimesh
from PIL import Image
from torch import Tensor

from bitymi_ns.interchange.quads import MASK, Quads

_LINEAR, _CLAMP = 9729, 33071
_FACES = ((0, 1, 2), (0, 2, 3))


def glb_bytes(quads: Quads, up: Tensor | None = None) -> bytes:
    """The file: a mesh for each page, four vertices and two triangles for each quad, seen from both sides and unlit
    (KHR_materials_unlit), with its page as a PNG. Texels are read without mip levels, which would mix tiles.

    Args:
        quads: at least one.
        up: [3] direction that the node turns to +y, which is up in glTF; None = the node turns nothing.
    """
    turn = np.eye(4)
    if up is not None:
        turn[:3, :3] = _to_y(up.double().numpy())
    scene = trimesh.Scene()
    for page in torch.unique(quads.page).tolist():
        rows = torch.nonzero(quads.page == page).squeeze(1)
        material = trimesh.visual.material.PBRMaterial(
            baseColorTexture=Image.fromarray(quads.pages[page].numpy()),
            metallicFactor=0.0,
            roughnessFactor=1.0,
            alphaMode="MASK",
            alphaCutoff=MASK,
            doubleSided=True,
        )
        uv = quads.uv[rows].reshape(-1, 2).double().numpy()
        uv[:, 1] = 1.0 - uv[:, 1]  # trimesh counts from the bottom, glTF from the top
        mesh = trimesh.Trimesh(
            quads.corners[rows].reshape(-1, 3).numpy(),
            (4 * np.arange(len(rows))[:, None, None] + np.array(_FACES)).reshape(-1, 3),
            visual=trimesh.visual.TextureVisuals(uv=uv, material=material),
            process=False,
        )
        scene.add_geometry(mesh, node_name=f"surfels-{page}", geom_name=f"surfels-{page}", transform=turn)
    return trimesh.exchange.gltf.export_glb(scene, include_normals=False, tree_postprocessor=_unlit)


def _unlit(tree: dict[str, Any]) -> None:
    """Add the unlit extension and the sampler, which trimesh does not write, to the JSON."""
    tree["extensionsUsed"] = sorted({*tree.get("extensionsUsed", ()), "KHR_materials_unlit"})
    for material in tree["materials"]:
        material["extensions"] = {"KHR_materials_unlit": {}}
    tree["samplers"] = [{"magFilter": _LINEAR, "minFilter": _LINEAR, "wrapS": _CLAMP, "wrapT": _CLAMP}]
    for texture in tree["textures"]:
        texture["sampler"] = 0


def _to_y(up: np.ndarray) -> np.ndarray:
    """The smallest rotation that turns a direction to +y."""
    up = up / np.linalg.norm(up)
    axis, cosine = np.cross(up, (0.0, 1.0, 0.0)), up[1]
    if cosine < -1 + 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    skew = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + skew + skew @ skew / (1 + cosine)
