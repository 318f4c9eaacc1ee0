"""Frames of baked scenes with the CUDA kernels: working memory, kernel calls, CUDA graphs."""

from __future__ import annotations

import gc
from collections.abc import Sequence
from enum import IntFlag

import torch
from torch import Tensor

from .backend import cuda_backend, function, module, on_device
from .baked_cuda import compiled
from .baked_scene import IMAGES, BakedSceneLike, check_images, common_size
from .constants import TILE
from .project import CameraLike


class Stage(IntFlag):
    """Stages of a frame, for timing; drawing needs the lists in the working memory."""

    LIST = 1
    DRAW = 2
    ALL = 3


def tiles_of(views: int, width: int, height: int) -> int:
    """Count the screen tiles of all views."""
    return -(-width // TILE) * -(-height // TILE) * views


def slots_per_tile(capacity: int, tiles: int) -> int:
    """Choose the slots for each screen tile's pairs: twice the mean of `capacity`, more if all fit in 32 MB, at most
    what a block of threads sorts at once. Further pairs share one list of all tiles."""
    return max(32, min(1024, max(2 * capacity, 1 << 23) // tiles) // 32 * 32)


class Workspace:
    """Working memory of frames on a device; it grows as needed and is kept.

    Attributes:
        capacity: pairs of surfel and screen tile that fit, however they are distributed.
        slots: per tile; 0 before the first frame.
        memory: [bytes] uint8; None before the first frame.
    """

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self.capacity = self.slots = 0
        self.memory: Tensor | None = None

    def resize(self, surfels: int, views: int, width: int, height: int, normals: bool, capacity: int = 0) -> None:
        """Allocate for such frames with at least `capacity` pairs, or as many as before. Raises ValueError: more
        surfels, views or pairs than a frame can have."""
        kernels, device = module(self._device), self._device
        most = kernels.MOST_PAIRS
        if capacity > most:
            raise ValueError(f"the view needs {capacity} pairs of surfel and tile, a frame can have {most}")
        self.capacity = max(self.capacity, capacity) or min(most, 4 * surfels * views)
        self.slots = slots_per_tile(self.capacity, tiles_of(views, width, height))
        size = {"surfels": surfels, "views": views, "width": width, "height": height, "normals": normals}
        with on_device(device):
            needed = kernels.baked_memory(**size, slots=self.slots, capacity=self.capacity)
        if self.memory is None or self.memory.numel() < needed:
            self.memory = None  # frees the old memory first
            self.memory = torch.empty(needed, dtype=torch.uint8, device=device)

    def counts(self) -> tuple[int, int]:
        """Return the pairs of the latest non-empty frame, and those without a slot; waits for the device."""
        assert self.memory is not None
        pairs, spilled = self.memory[:16].view(torch.int64).tolist()
        return pairs, spilled

    @property
    def pairs(self) -> int:
        """All pairs of `counts`."""
        return self.counts()[0]


class BakedRenderer:
    """Renderer of frames of one size into the same images: each frame overwrites the one before.

    Args:
        scene: on a CUDA device.
        width, height: image size, pixels.
        views: per frame.
        images, background, photo_pixel: as in `baked.draw`; fewer images cost less.
        graph: record the frame as a CUDA graph, which costs the host one call per frame. GPU only.
        workspace: not used elsewhere meanwhile; None: a new one.

    Raises:
        RuntimeError: the scene is on the CPU, or the device has too little memory.
        TypeError: the surfels are not float32.
        ValueError: an image does not exist, `graph` without a GPU, or surfels times views is above 2^24.
    """

    def __init__(
        self,
        scene: BakedSceneLike,
        width: int,
        height: int,
        views: int = 1,
        images: Sequence[str] = ("rgb",),
        background: Tensor | None = None,
        graph: bool = False,
        photo_pixel: float = 1.0,
        workspace: Workspace | None = None,
    ) -> None:
        self._device = device = scene.tiles.device
        if not cuda_backend(device):
            raise RuntimeError("the scene is on the CPU: move it to a CUDA device, or use BakedScene.render")
        if graph and device.type != "cuda":
            raise ValueError("CUDA graphs need a GPU")
        check_images(images, on_cuda=True)
        self._scene, self._surfels = compiled(scene, photo_pixel), len(scene.tiles)
        self._size, self._photo_pixel = (views, width, height), photo_pixel
        self.images = {
            name: torch.empty(views, height, width, IMAGES[name][0], dtype=IMAGES[name][1], device=device)
            for name in images
        }
        self.workspace = workspace or Workspace(device)
        self._viewmats = torch.eye(4, dtype=torch.float32, device=device).repeat(views, 1, 1)
        self._Ks = torch.eye(3, dtype=torch.float32, device=device).repeat(views, 1, 1)
        self._background = None if background is None else background.to(device, torch.float32, copy=True)
        self._use_graph, self._graph = graph, None
        self._resize(0)

    def draw(
        self, cameras: Sequence[CameraLike], check: bool = True, background: Tensor | None = None
    ) -> dict[str, Tensor]:
        """Render the views into `images`.

        Args:
            cameras: one per view, of the renderer's size.
            check: wait for the frame and render it again if the working memory was too small; False: only start it, and
                call `complete` later.
            background: [3] new background colour, if the renderer has one; None: as before.

        Raises:
            ValueError: the cameras do not match the renderer.
        """
        size = (len(cameras), *common_size(cameras))
        if size != self._size:
            raise ValueError(f"the renderer draws {self._size} (views, width, height), not {size}")
        self._viewmats.copy_(torch.stack([camera.viewmat for camera in cameras]))
        self._Ks.copy_(torch.stack([camera.K for camera in cameras]))
        if background is not None and self._background is not None:
            self._background.copy_(background)
        self.run()
        while check and not self.complete():
            self._resize(self.workspace.pairs * 5 // 4)
            self.run()
        return self.images

    def run(self, stages: Stage = Stage.ALL) -> None:
        """Start a frame with the latest cameras; single stages, for timing, never use the graph."""
        with on_device(self._device):  # a graph is recorded on a stream of the current device
            if not self._use_graph or stages != Stage.ALL:
                self._draw(stages)
                return
            if self._graph is None:
                self._graph = self._record()
            self._graph.replay()

    def _record(self) -> torch.cuda.CUDAGraph:
        self._draw(Stage.ALL)  # the first call loads kernels, which cannot be recorded
        torch.cuda.synchronize(self._device)
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
        """Wait for the latest frame; return True if the working memory had room for its pairs."""
        return self._surfels == 0 or self.workspace.counts()[1] <= self.workspace.capacity

    def _draw(self, stages: Stage) -> None:
        """Start a frame without allocating or waiting, so that it can be recorded."""
        _, width, height = self._size
        function("baked_frame", self._device)(
            **self.images,
            scene=self._scene,
            viewmats=self._viewmats,
            Ks=self._Ks,
            width=width,
            height=height,
            background=self._background,
            stages=int(stages),
            photo_pixel=self._photo_pixel,
            memory=self.workspace.memory,
            slots=self.workspace.slots,
            capacity=self.workspace.capacity,
        )

    def _resize(self, capacity: int) -> None:
        views, width, height = self._size
        self.workspace.resize(self._surfels, views, width, height, "normal" in self.images, capacity)
        self._graph = None  # it points at the old memory
