"""A bundle as a nerfstudio model: what ns-eval, ns-viewer and ns-render show of a baked scene."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from bitymi_ns.host.bundle_config import BakedModelConfig
from bitymi_ns.host.errors import fail
from bitymi_ns.host.surfel_model import SurfelModel
from bitymi_ns.scene.camera import Camera


class BakedModel(SurfelModel):
    """Renders from the files of a bundle alone: no network, no checkpoint."""

    config: BakedModelConfig

    def populate_modules(self) -> None:
        super().populate_modules()
        from bitymi_ns.bake import REMEDY, BundleError, read_bundle
        from bitymi_ns.bake.manifest import ATLAS
        from bitymi_ns.scene.baked import BakedScene

        folder = Path(self.config.bundle)
        try:
            bundle = read_bundle(folder)
        except BundleError as error:
            fail(f"{error}. {REMEDY}", error)
        self._atlas_bytes = bundle.info.files[ATLAS].bytes if ATLAS in bundle.info.files else 0
        self._scene = [BakedScene.from_bundle(bundle)]  # in a list: it has no parameters to register
        self._count = len(bundle)

    def render(self, camera: Camera, background: Tensor, maps: bool) -> Any:
        return self._scene[0].render(camera.to(self.device), background=background.to(self.device), maps=maps)

    def surfel_count(self) -> int:
        return self._count

    @property
    def background(self) -> Tensor:
        return torch.tensor(self.config.background, device=self.device)

    def size_metrics(self) -> dict[str, float]:
        return {**super().size_metrics(), "atlas_bytes": float(self._atlas_bytes)}

    def to(self, *args: Any, **kwargs: Any) -> BakedModel:
        super().to(*args, **kwargs)
        if self._scene[0].tiles.device != self.device:
            self._scene[0] = self._scene[0].to(self.device)
        return self

    def load_state_dict(self, state_dict: Any, strict: bool = True, assign: bool = False) -> Any:
        """Nothing to load: everything is in the bundle."""
        return torch.nn.modules.module._IncompatibleKeys([], [])
