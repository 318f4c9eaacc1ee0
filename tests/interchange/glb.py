"""Quads of a binary glTF file."""

from pathlib import Path

import numpy as np
import torch
import trimesh

from bitymi_ns.interchange.quads import Quads


def read_glb(path: str | Path) -> Quads:
    """Read the quads of a `quads_glb` file, transformed by their nodes."""
    scene = trimesh.load_scene(path, process=False)
    corners, coordinates, page, pages = [], [], [], []
    for node in sorted(scene.graph.nodes_geometry):
        transform, name = scene.graph[node]
        mesh = scene.geometry[name]
        placed = mesh.vertices @ transform[:3, :3].T + transform[:3, 3]
        uv = np.array(mesh.visual.uv)
        uv[:, 1] = 1.0 - uv[:, 1]
        corners.append(torch.from_numpy(placed).float().view(-1, 4, 3))
        coordinates.append(torch.from_numpy(uv).float().view(-1, 4, 2))
        page.append(torch.full((len(mesh.vertices) // 4,), len(pages)))
        pages.append(torch.from_numpy(np.array(mesh.visual.material.baseColorTexture.convert("RGBA"))))
    return Quads(torch.cat(corners), torch.cat(coordinates), torch.cat(page), torch.stack(pages))
