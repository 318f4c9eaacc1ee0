"""A bundle as a nerfstudio model, for ns-eval, ns-viewer and ns-render."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import torch
from nerfstudio.data.scene_box import OrientedBox
from torch import Tensor

from bitymi_ns.bundle import REMEDY, BundleError, read_bundle
from bitymi_ns.bundle.notes import NotesError
from bitymi_ns.bundle.read import download_bytes, read_cameras
from bitymi_ns.ops import webgpu
from bitymi_ns.scene.baked import FAST
from bitymi_ns.scene.camera import Camera
from bitymi_ns.scene.crop import Box
from bitymi_ns.scene.scene_renderer import SceneRenderer
from ..console import fail
from ..data.cameras import to_cameras
from ..data.views import DATA
from .device import kernel_device
from .surfel_model import SurfelModel, SurfelModelConfig, box_of

RENDERER, CROP = "BITYMI_RENDERER", "BITYMI_CROP"
"""Environment variables that override `BakedModelConfig.renderer` and `crop`, for nerfstudio's commands."""


@dataclass
class BakedModelConfig(SurfelModelConfig):
    _target: type = field(default_factory=lambda: BakedModel)
    bundle: Path = Path()  # Its folder when written; a moved one is found beside its config.yml.
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)  # Colour behind the scene.
    renderer: Literal["kernels", "fast", "webgpu"] = "kernels"
    """kernels: on CUDA or the CPU; fast: the same, but a pixel ends when what follows adds less than half an 8-bit
    step; webgpu: on any vendor's GPU, by the package wgpu."""
    crop: bool = False
    """Leave out the surfels that the bundle's notes.json hides."""


class BakedModel(SurfelModel):
    """Model that renders a bundle."""

    config: BakedModelConfig

    def populate_modules(self) -> None:
        super().populate_modules()
        folder = Path(self.config.bundle)
        renderer = os.environ.get(RENDERER) or self.config.renderer
        if renderer not in ("kernels", "fast", "webgpu"):
            fail(f"{RENDERER} must be kernels, fast or webgpu, not {renderer!r}")
        crop = os.environ.get(CROP) or str(self.config.crop)
        if crop.lower() not in ("true", "false"):
            fail(f"{CROP} must be True or False, not {crop!r}")
        through_webgpu = renderer == "webgpu"
        if through_webgpu:
            with _webgpu_needed():
                webgpu.device.device()
        on_card = kernel_device(self.kwargs.get("device", "cpu")).type == "cuda" and not through_webgpu
        try:
            bundle = read_bundle(folder, decode=not on_card, crop=crop.lower() == "true")
        except BundleError as error:
            fail(f"{error}." if isinstance(error, NotesError) else f"{error}. {REMEDY}", error)
        atlas = bundle.info.atlas
        self._sizes = {
            "surfels": float(len(bundle)),
            "atlas_bytes": 0.0 if atlas is None else float(bundle.info.files[atlas.file].bytes),
            "bundle_bytes": float(download_bytes(folder, bundle.info)),
        }
        bundle.scene.through_webgpu = through_webgpu
        if renderer == "fast":
            bundle.scene.transmittance_min = FAST
        self._scene = bundle.scene
        self._renderer = self._new_renderer(None)
        self.corrections = [(row.camera, row.exposure) for row in bundle.cameras if row.correction is not None]

    def crop_to(self, box: OrientedBox | None) -> None:
        wanted = box_of(box)
        if wanted != self.crop_box:
            renderer = self._new_renderer(wanted)
            self.crop_box, self._renderer = wanted, renderer  # at once: the viewer may interrupt

    def _new_renderer(self, box: Box | None) -> SceneRenderer:
        scene = self._scene
        return SceneRenderer(scene if box is None else scene.only(box.contains(scene.surfels["means"])))

    def render(self, camera: Camera, background: Tensor, maps: bool) -> Any:
        with _webgpu_needed():
            drawn = self._renderer.render(camera.to(self.device), background.to(self.device), maps)
        if not self._renderer.scene.through_webgpu:
            return drawn
        return replace(drawn, **{name: t.to(self.device) for name, t in vars(drawn).items() if t is not None})

    @property
    def background(self) -> Tensor:
        return torch.tensor(self.config.background, device=self.device)

    def sizes(self) -> dict[str, float]:
        return self._sizes

    def to(self, *args: Any, **kwargs: Any) -> BakedModel:
        super().to(*args, **kwargs)
        if self._scene.tiles.device != self.device and not self._scene.through_webgpu:
            self._scene = self._scene.to(self.device)
            self._renderer = self._new_renderer(self.crop_box)
        return self

    def load_state_dict(self, state_dict: Any, strict: bool = True, assign: bool = False) -> Any:
        """Load nothing: all is in the bundle."""
        return torch.nn.modules.module._IncompatibleKeys([], [])


def check_same_capture(bundle: Path, pipeline: Any) -> None:
    """Check that a bundle is of a pipeline's capture, in the same frame: half of its cameras need one of the capture's
    within 5 % of their extent and 5 degrees. Raises InputError: it is not."""
    stated = [row.camera for row in read_cameras(bundle)]
    if not stated:
        return
    data = pipeline.datamanager
    captured = to_cameras(data.train_dataset.cameras, "cpu") + to_cameras(data.eval_dataset.cameras, "cpu")
    theirs, ours = (torch.stack([camera.viewmat.double() for camera in some]) for some in (stated, captured))
    centers = [torch.linalg.inv(some)[:, :3, 3] for some in (theirs, ours)]
    extent = (centers[0] - centers[0].mean(0)).norm(dim=1).max().clamp(min=1e-9)
    apart, nearest = (torch.cdist(*centers) / extent).min(1)
    traces = (theirs[:, :3, :3] * ours[nearest, :3, :3]).sum((1, 2))
    turned = torch.rad2deg(torch.acos((0.5 * (traces - 1)).clamp(-1, 1)))
    if apart.median() > 0.05 or turned.median() > 5:
        fail(
            f"{bundle} is not of the capture {data.config.data}, or of its frame: half of its cameras are "
            f"{float(apart.median()):.0%} of their extent, or {float(turned.median()):.0f} degrees, or more from the "
            f"capture's. Name its own: `{DATA}=/where/it/is`."
        )


@contextmanager
def _webgpu_needed() -> Iterator[None]:
    try:
        yield
    except webgpu.WebGpuUnavailable as error:
        fail(f"{error}. Or draw with the kernels, without {RENDERER} and the option renderer.", error)
