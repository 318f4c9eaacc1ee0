"""Renderer of a baked scene for viewers: repeated image sizes keep their memory and, on a GPU, a CUDA graph."""

import threading

import torch
from torch import Tensor

from bitymi_ns.ops.backend import cuda_backend
from bitymi_ns.ops.baked_renderer import BakedRenderer
from .baked import BakedOutput, BakedScene, image_names
from .camera import Camera
from .sampling import Sampling


class SceneRenderer:
    """Renderer for any camera and device. On a CUDA device each repeated image size gets its own `BakedRenderer`, on a
    GPU with a CUDA graph; at most `kept` of them, the oldest is dropped first. Thread-safe."""

    def __init__(self, scene: BakedScene, kept: int = 4) -> None:
        self.scene, self._kept = scene, kept
        self._renderers: dict[tuple[int, int, bool, bool], BakedRenderer] = {}
        self._latest: tuple[int, int, bool, bool] | None = None
        self._lock = threading.Lock()

    def __reduce__(self) -> tuple[type, tuple[BakedScene, int]]:
        """Pickle without working memory and graphs, which belong to one process."""
        return SceneRenderer, (self.scene, self._kept)

    @torch.no_grad()
    def render(self, camera: Camera, background: Tensor | None = None, maps: bool = False) -> BakedOutput:
        """Render a view as `BakedScene.render`."""
        scene, device = self.scene, self.scene.tiles.device
        # a graph fixes the sampling: views of another scale are rendered without one
        if scene.through_webgpu or not cuda_backend(device) or scene.sampling([camera]) != Sampling():
            return scene.render(camera, background, maps)
        key = (camera.width, camera.height, background is None, maps)
        with self._lock:
            repeats, self._latest = key == self._latest, key
            if key not in self._renderers:
                if not repeats:  # a viewer changes its size while the camera moves: recording would not pay off
                    return scene.render(camera, background, maps)
                while len(self._renderers) >= self._kept:
                    del self._renderers[next(iter(self._renderers))]
                names, graph = image_names(maps), device.type == "cuda"
                self._renderers[key] = BakedRenderer(scene, *key[:2], 1, names, background, graph)
            images = self._renderers[key].draw([camera], background=background)
            return BakedOutput(**{name: image[0].clone() for name, image in images.items()})
