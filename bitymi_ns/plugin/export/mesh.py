"""`ns-export bitymi-mesh`: the surface of a trained scene or of a bundle as a triangle mesh."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from bitymi_ns import endings
from bitymi_ns.bundle import BundleError, read_bundle
from bitymi_ns.bundle.manifest import MANIFEST, WorldFrame
from bitymi_ns.bundle.strict_json import plain
from bitymi_ns.codec.pages import texel_alpha
from bitymi_ns.files import complete_folder, reason, reserved, size_text
from bitymi_ns.interchange import Frame
from bitymi_ns.interchange.bundle_cameras import named_cameras
from bitymi_ns.interchange.frame import to_capture
from bitymi_ns.interchange.surface import NoSurface, SurfaceOptions, extract_surface
from bitymi_ns.ops import Prefilter, TexelAlpha
from bitymi_ns.plugin.console import fail, say, warn
from bitymi_ns.plugin.data.cameras import to_cameras
from bitymi_ns.plugin.export.trained import load_trained, world_of
from bitymi_ns.progress import rich_progress
from bitymi_ns.ranges import check_ranges
from bitymi_ns.scene.camera import Camera

NAME = "mesh"
MOST_VIEWS = 400  # training views that are fused at most, evenly spaced


@dataclass(frozen=True)
class Source:
    """Scene that a mesh is made of."""

    surfels: Mapping[str, Tensor]  # geometry by name, on the device where it is drawn
    render: Callable[[Camera], Tensor]  # [H, W, 3] colors of a view
    cameras: Sequence[Camera]  # of the training views, on that device
    near: float  # nearest depth that is drawn, camera z
    prefilter: Prefilter  # as in `ops.project`
    world: WorldFrame  # how the scene lies in the capture
    alpha: TexelAlpha | None  # opacities of the texels, on that device; None = opaque texels


@dataclass(kw_only=True)
class ExportMesh(SurfaceOptions):
    """Extract the surface as a triangle mesh with vertex colors: TSDF fusion of median depths (open3d)."""

    load_config: Path  # config.yml of a trained scene or of a bundle.
    output_dir: Path  # Folder of the mesh: mesh.ply, mesh.glb or mesh.obj.
    format: Literal["ply", "glb", "obj"] = "ply"  # Of the file.
    frame: Frame = "capture"
    """Frame of the vertices: the capture's own, with its unit of length, or the scene's, in which nerfstudio trains."""
    overwrite: bool = False  # Replace a mesh that is there already.

    def main(self) -> None:
        """Run the export."""
        endings.install()
        path = self.output_dir / f"{NAME}.{self.format}"
        try:
            check_ranges(self)
        except ValueError as error:
            fail(f"--{error}.", error)
        try:
            with reserved(self.output_dir, warn):
                self._check_target()
                source = from_bundle(self.load_config.parent) if self._is_bundle else from_run(self.load_config)
                self._write(source, path)
        except BundleError as error:
            fail(str(error), error)
        except NoSurface as error:
            fail(f"{self.load_config}: {error}.", error)
        except OSError as error:
            fail(f"{path} cannot be written: {reason(error, self.output_dir)} (--output-dir).", error)
        say(f"{path}: {size_text(path.stat().st_size)}, in the {self.frame}'s frame")

    @property
    def _is_bundle(self) -> bool:
        return (self.load_config.parent / MANIFEST).is_file()

    def _check_target(self) -> None:
        """Stop where the folder holds anything that may not be replaced."""
        if not self.output_dir.exists():
            return
        if not self.output_dir.is_dir():
            fail(f"{self.output_dir} is no folder: choose another --output-dir.")
        there = {path.name for path in self.output_dir.iterdir()}
        own = {f"{NAME}.{ending}" for ending in ("ply", "glb", "obj", "mtl")}
        if there - own:
            fail(f"{self.output_dir} holds other files and is not replaced: choose another --output-dir.")
        if there and not self.overwrite:
            fail(f"{self.output_dir} holds a mesh already: choose another --output-dir, or add --overwrite True.")

    def _write(self, source: Source, path: Path) -> None:
        import open3d

        to = to_capture(source.world) if self.frame == "capture" else None
        step = max(1, -(-len(source.cameras) // MOST_VIEWS))
        cameras = source.cameras[::step]
        with rich_progress() as progress:
            drawn = (cameras, source.near, self, source.prefilter, progress, source.alpha)
            mesh = extract_surface(source.surfels, source.render, *drawn)
        if to is not None:
            vertices = torch.from_numpy(np.asarray(mesh.vertices))
            mesh.vertices = open3d.utility.Vector3dVector(to.points(vertices).numpy())
            if float(torch.linalg.det(to.turn)) < 0:  # a mirror image turns triangles inside out
                mesh.triangles = open3d.utility.Vector3iVector(np.asarray(mesh.triangles)[:, ::-1])
            mesh.compute_vertex_normals()
        with complete_folder(self.output_dir, self._check_target) as new:
            if not open3d.io.write_triangle_mesh(str(new / path.name), mesh):
                raise BundleError(f"open3d could not write {path}")
        say(f"{len(mesh.vertices):,} vertices, {len(mesh.triangles):,} triangles of {len(cameras)} views")


def from_run(load_config: Path) -> Source:
    """The scene of a training run's last checkpoint."""
    _, pipeline = load_trained(load_config)
    model, datamanager = pipeline.model, pipeline.datamanager
    cameras = to_cameras(datamanager.train_dataset.cameras, model.device)
    scene = model.scene
    surfels = {name: value.detach() for name, value in scene.surfels.items()}
    return Source(
        surfels,
        lambda camera: model.render(camera, model.background, maps=False).rgb,
        cameras,
        scene.near,
        scene.config.prefilter,
        WorldFrame.model_validate_json(json.dumps(plain(world_of(datamanager).described()))),
        None if scene.field is None else scene.field.opacity(scene.config.weight_bound, learns=False),
    )


def from_bundle(folder: Path) -> Source:
    """A bundle, from the training cameras that it holds."""
    bundle = read_bundle(folder)
    scene = bundle.scene
    rows = named_cameras(folder, bundle.info)
    cameras = [row.camera for row in rows if not row.held_out] or [row.camera for row in rows]
    drawn = (cameras, scene.near, scene.prefilter, bundle.info.world, texel_alpha(scene))
    return Source(scene.surfels, lambda camera: bundle.render(camera).rgb, *drawn)
