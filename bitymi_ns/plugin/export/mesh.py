"""`ns-export bitymi-mesh`: extract the surface of a trained scene or of a bundle as a triangle mesh."""

import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from bitymi_ns import exit_messages
from bitymi_ns.bundle import BundleError, read_bundle
from bitymi_ns.bundle.parts import CAMERAS, bundle_at
from bitymi_ns.bundle.strict_json import plain
from bitymi_ns.bundle.world import WorldEntry
from bitymi_ns.codec.pages import texel_alpha
from bitymi_ns.files import reserved, size_text, write_errors_as, write_file
from bitymi_ns.interchange.extras import Frame, training_cameras
from bitymi_ns.interchange.frame import to_capture, up_of
from bitymi_ns.interchange.surface import NoSurface, SurfaceOptions, extract_surface
from bitymi_ns.interchange.surface_files import MeshFormat, mesh_bytes
from bitymi_ns.ops import TexelAlpha
from bitymi_ns.progress import rich_progress
from bitymi_ns.ranges import check_ranges
from bitymi_ns.scene.camera import Camera
from ..console import InputError, fail, say, warn
from ..data.cameras import to_cameras
from .trained import load_trained, world_of

NAME = "mesh"
MOST_VIEWS = 400  # most fused views


class MeshScene(NamedTuple):
    """Scene that a mesh is made of, on the device that draws it."""

    surfels: Mapping[str, Tensor]
    render: Callable[[Camera], Tensor]  # [H, W, 3] colors of a view
    cameras: Sequence[Camera]
    near: float  # nearest drawn depth, camera z
    world: WorldEntry
    alpha: TexelAlpha | None  # None = opaque


@dataclass(kw_only=True)
class ExportMesh(SurfaceOptions):
    """Extract the surface as a triangle mesh with vertex colors: TSDF fusion of median depths (open3d)."""

    load_config: Path  # config.yml of a trained scene or of a bundle, or a bundle in one file.
    output_dir: Path  # Folder of the mesh: mesh.ply, mesh.glb or mesh.obj.
    format: MeshFormat = "ply"  # Format of the file; files of other formats stay.
    frame: Frame = "capture"
    """Frame of the vertices: the capture's, in its unit of length, or the scene's, in which nerfstudio trains."""
    crop: bool = False  # Leave out the surfels that the bundle's notes.json hides.
    overwrite: bool = False  # Replace an existing mesh.

    def main(self) -> None:
        exit_messages.install()
        path = self.output_dir / f"{NAME}.{self.format}"
        try:
            check_ranges(self)
        except ValueError as error:
            fail(f"--{error}.", error)
        try:
            with write_errors_as(path, InputError, " (--output-dir)."), reserved(path, tell=warn):
                self._check_target(path)
                bundle = bundle_at(self.load_config)
                if bundle is None and self.crop:
                    fail(f"--crop is for bundles, which have notes.json: {self.load_config} is a run's.")
                source = from_run(self.load_config) if bundle is None else from_bundle(bundle, self.crop)
                say(f"{path}: {self._write(source, path)}")
        except BundleError as error:
            fail(str(error), error)
        except NoSurface as error:
            fail(f"{self.load_config}: {error}.", error)

    def _check_target(self, path: Path) -> None:
        if os.path.lexists(path) and not self.overwrite:
            fail(f"{path} is there already: choose another --output-dir, or add --overwrite True.")

    def _write(self, source: MeshScene, path: Path) -> str:
        to = to_capture(source.world) if self.frame == "capture" else None
        step = max(1, -(-len(source.cameras) // MOST_VIEWS))
        cameras = source.cameras[::step]
        with rich_progress() as progress:
            drawn = (cameras, source.near, self, progress, source.alpha, to)
            mesh = extract_surface(source.surfels, source.render, *drawn)
        note = "" if to is None else to.note
        up, origin = up_of(source.world, to), torch.zeros(3) if to is None else to.origin
        self._check_target(path)
        write_file(path, mesh_bytes(mesh, self.format, up, origin, note), follow=True)
        parts = int(mesh.parts().max()) + 1
        counts = f"{len(mesh.vertices):,} vertices, {len(mesh):,} triangles, {parts:,} part{'s' if parts > 1 else ''}"
        say(f"{counts}, of {len(cameras)} views")
        if self.watertight and (left := mesh.open_edges()):
            warn(f"{left:,} edges could not be closed: the mesh is not watertight. Try another --resolution.")
        where = " (its node is moved there)" if self.format == "glb" else " (a comment of the file)"
        return f"{size_text(path.stat().st_size)}, in the {self.frame}'s frame" + (note and f"; {note}{where}")


def from_run(load_config: Path) -> MeshScene:
    """Load a training run's last checkpoint."""
    _, pipeline = load_trained(load_config)
    model, datamanager = pipeline.model, pipeline.datamanager
    cameras = to_cameras(datamanager.train_dataset.cameras, model.device)
    scene = model.scene
    surfels = {name: value.detach() for name, value in scene.surfels.items()}
    world = WorldEntry.model_validate_json(json.dumps(plain(world_of(datamanager).described())))
    alpha = scene.opacity(learns=False)
    drawn = (cameras, scene.near, world, alpha)
    return MeshScene(surfels, lambda camera: model.render(camera, model.background, maps=False).rgb, *drawn)


def from_bundle(folder: Path, crop: bool = False) -> MeshScene:
    """Load a bundle. Raises BundleError: it cannot be read, or has no cameras."""
    bundle = read_bundle(folder, crop=crop)
    if bundle.hidden:
        say(f"{bundle.hidden}.")
    scene = bundle.scene
    cameras = training_cameras(bundle) or [row.camera for row in bundle.cameras]
    if not cameras:
        raise BundleError(f"{folder} has no cameras ({CAMERAS}): give the config.yml of the run that it was made from")
    drawn = (cameras, scene.near, bundle.info.world, texel_alpha(scene))
    return MeshScene(scene.surfels, lambda camera: bundle.render(camera).rgb, *drawn)
