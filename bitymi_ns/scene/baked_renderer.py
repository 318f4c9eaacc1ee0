"""Renderers of baked scenes that keep their working memory between frames and, on a GPU, use CUDA graphs."""

import gc
import threading
from collections.abc import Sequence

import torch
from torch import Tensor

from bitymi_ns.ops.backend import cuda_backend, on_device
from bitymi_ns.ops.baked_cuda import Stage, Workspace, compiled, empty_images, frame, stack_cameras
from .baked import OUTPUTS, BakedOutput, BakedScene, image_names
from .camera import Camera
from .sampling import Sampling


class BakedRenderer:
    """Renderer of frames of one size into the same images: each frame overwrites the one before.

    Args:
        scene: on a CUDA device.
        width, height: image size, pixels.
        views: number of views per frame.
        images: names of `ops.baked.IMAGES`: fewer images cost less.
        background: [3] colour behind the scene; None: black.
        graph: record the frame as a CUDA graph, which costs the host one call per frame. GPU only.

    Raises:
        RuntimeError: the scene is on the CPU, or the device has too little memory.
        ValueError: an image does not exist, `graph` without a GPU, or surfels times views is above 2^24.
    """

    def __init__(
        self,
        scene: BakedScene,
        width: int,
        height: int,
        views: int = 1,
        images: Sequence[str] = ("rgb",),
        background: Tensor | None = None,
        graph: bool = False,
    ) -> None:
        device = scene.tiles.device
        if not cuda_backend(device):
            raise RuntimeError("the scene is on the CPU: move it to a CUDA device, or use BakedScene.render")
        if graph and device.type != "cuda":
            raise ValueError("CUDA graphs need a GPU")
        self._scene, self._surfels = compiled(scene), len(scene)
        self.images = empty_images(images, views, width, height, device)
        self.workspace = Workspace(device)
        self._viewmats = torch.eye(4, device=device, dtype=torch.float32).repeat(views, 1, 1)
        self._Ks = torch.eye(3, device=device, dtype=torch.float32).repeat(views, 1, 1)
        self._background = None if background is None else background.to(device, torch.float32, copy=True)
        self._size = (views, width, height)
        self._use_graph, self._graph = graph, None
        self._resize(0)

    def draw(
        self, cameras: Sequence[Camera], check: bool = True, background: Tensor | None = None
    ) -> dict[str, Tensor]:
        """Render the views.

        Args:
            cameras: one per view, of the renderer's size.
            check: wait for the frame and render it again if the working memory was too small. If False, the frame is
                only started; call `complete` later.
            background: [3] new background colour, if the renderer has one; None: as before.

        Returns:
            name -> [views, height, width, channels]; the same memory every time.

        Raises:
            ValueError: the cameras do not match the renderer.
        """
        viewmats, Ks, width, height = stack_cameras(cameras, self._viewmats.device)
        if (len(cameras), width, height) != self._size:
            raise ValueError(
                f"the renderer draws {self._size} (views, width, height), not {(len(cameras), width, height)}"
            )
        self._viewmats.copy_(viewmats)
        self._Ks.copy_(Ks)
        if background is not None and self._background is not None:
            self._background.copy_(background)
        self.run()
        if check and not self.complete():
            self._resize(self.workspace.pairs * 5 // 4)
            self.run()
        return self.images

    def run(self, stages: Stage = Stage.ALL) -> None:
        """Start a frame with the latest cameras; single stages, for timing, never use the graph."""
        with on_device(self._viewmats.device):  # a graph is recorded on a stream of the current device
            if not self._use_graph or stages != Stage.ALL:
                self._draw(stages)
                return
            if self._graph is None:
                self._graph = self._record()
            self._graph.replay()

    def _record(self) -> torch.cuda.CUDAGraph:
        self._draw(Stage.ALL)  # the first call loads kernels, which cannot be recorded
        torch.cuda.synchronize(self._viewmats.device)
        graph = torch.cuda.CUDAGraph()
        # freeing a texture synchronises the device, which is an error during recording
        collects = gc.isenabled()
        gc.disable()
        try:
            with torch.cuda.graph(graph, capture_error_mode="thread_local"):
                self._draw(Stage.ALL)
        finally:
            if collects:
                gc.enable()
        return graph

    def complete(self) -> bool:
        """Wait for the latest frame; return True if the working memory was large enough for it."""
        return self._surfels == 0 or self.workspace.complete

    def _draw(self, stages: Stage) -> None:
        frame(self._scene, self._viewmats, self._Ks, self._background, self.images, self.workspace, stages)

    def _resize(self, capacity: int) -> None:
        views, width, height = self._size
        self.workspace.resize(self._surfels, views, width, height, "normal" in self.images, capacity)
        self._graph = None  # it points at the old memory


class SceneRenderer:
    """Renderer for any camera and device. On a CUDA device each repeated image size gets its own `BakedRenderer`, on a
    GPU with a CUDA graph. Thread-safe.

    Args:
        scene: on the device to render on.
        kept: maximum number of `BakedRenderer`, each with its own working memory; the oldest is dropped first.
    """

    def __init__(self, scene: BakedScene, kept: int = 4) -> None:
        self.scene, self._kept = scene, kept
        self._renderers: dict[tuple[int, int, bool, bool], BakedRenderer] = {}
        self._latest: tuple[int, int, bool, bool] | None = None
        self._lock = threading.Lock()

    def __reduce__(self) -> tuple[type, tuple[BakedScene, int]]:
        """Pickle scene and settings only: working memory and graphs belong to one process."""
        return SceneRenderer, (self.scene, self._kept)

    @torch.no_grad()
    def render(self, camera: Camera, background: Tensor | None = None, maps: bool = False) -> BakedOutput:
        """Render a view; arguments and images as in `BakedScene.render`."""
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
            copies = {name: image[0].clone() for name, image in images.items()}
            return BakedOutput(copies["rgb"], copies["alpha"], *map(copies.get, OUTPUTS[2:]))
