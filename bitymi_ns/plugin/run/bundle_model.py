"""A bundle as a nerfstudio model, for ns-eval, ns-viewer and ns-render."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from bitymi_ns.bundle import REMEDY, BundleError, read_bundle
from bitymi_ns.bundle.read import download_bytes
from bitymi_ns.ops import webgpu
from bitymi_ns.plugin.console import fail
from bitymi_ns.plugin.run.device import kernel_device
from bitymi_ns.plugin.run.surfel_model import SurfelModel, SurfelModelConfig
from bitymi_ns.scene.baked import FAST, BakedOutput
from bitymi_ns.scene.baked_renderer import SceneRenderer
from bitymi_ns.scene.camera import Camera

RENDERER = "BITYMI_RENDERER"
"""Environment variable that overrides `BakedModelConfig.renderer`: ns-eval has no option for it."""


@dataclass
class BakedModelConfig(SurfelModelConfig):
    """A scene baked into a bundle."""

    _target: type = field(default_factory=lambda: BakedModel)
    bundle: Path = Path()  # Folder of the bundle when written; a moved one is found beside its config.yml.
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)  # Colour behind the scene.
    renderer: Literal["kernels", "fast", "webgpu"] = "kernels"
    """kernels: on CUDA or the CPU; fast: the same, but pixels end at less than half an 8-bit step of light; webgpu: on
    graphics of any maker, by the package wgpu."""


class BakedModel(SurfelModel):
    """Renders a bundle's files alone: no network, no checkpoint."""

    config: BakedModelConfig

    def populate_modules(self) -> None:
        super().populate_modules()
        folder, renderer = Path(self.config.bundle), os.environ.get(RENDERER) or self.config.renderer
        if renderer not in ("kernels", "fast", "webgpu"):
            fail(f"{RENDERER} must be kernels, fast or webgpu, not {renderer!r}")
        through_webgpu = renderer == "webgpu"
        if through_webgpu:
            with _webgpu_needed():
                webgpu.device.device()
        on_card = kernel_device(self.kwargs.get("device", "cpu")).type == "cuda" and not through_webgpu
        try:
            bundle = read_bundle(folder, decode=not on_card)
        except BundleError as error:
            fail(f"{error}. {REMEDY}", error)
        atlas = bundle.info.atlas
        self._sizes = {
            "surfels": float(len(bundle)),
            "atlas_bytes": 0.0 if atlas is None else float(bundle.info.files[atlas.file].bytes),
            "bundle_bytes": float(download_bytes(folder, bundle.info)),
        }
        bundle.scene.through_webgpu = through_webgpu
        if renderer == "fast":
            bundle.scene.transmittance_min = FAST
        self._renderer = SceneRenderer(bundle.scene)

    def render(self, camera: Camera, background: Tensor, maps: bool) -> Any:
        with _webgpu_needed():
            drawn = self._renderer.render(camera.to(self.device), background.to(self.device), maps)
        if not self._renderer.scene.through_webgpu:
            return drawn
        return BakedOutput(**{name: None if t is None else t.to(self.device) for name, t in vars(drawn).items()})

    @property
    def background(self) -> Tensor:
        return torch.tensor(self.config.background, device=self.device)

    def sizes(self) -> dict[str, float]:
        return self._sizes

    def to(self, *args: Any, **kwargs: Any) -> BakedModel:
        super().to(*args, **kwargs)
        scene = self._renderer.scene
        if scene.tiles.device != self.device and not scene.through_webgpu:
            self._renderer = SceneRenderer(scene.to(self.device))
        return self

    def load_state_dict(self, state_dict: Any, strict: bool = True, assign: bool = False) -> Any:
        """Load nothing: all is in the bundle."""
        return torch.nn.modules.module._IncompatibleKeys([], [])


@contextmanager
def _webgpu_needed() -> Iterator[None]:
    try:
        yield
    except webgpu.WebGpuUnavailable as error:
        fail(f"{error}. Or draw with the kernels: leave {RENDERER} and the option renderer as they are.", error)
