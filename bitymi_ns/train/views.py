"""Training views."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypeVar

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from bitymi_ns.ranges import spread
from bitymi_ns.scene.camera import Camera
from .config import TrainConfig

if TYPE_CHECKING:
    from bitymi_ns.scene.scene import RenderOutput, Scene

DOWNSCALED_BYTES = 1 << 28  # cache of downscaled images on the CPU
COVERED_VIEWS = 8  # views sampled by `covered_fraction`


class View(NamedTuple):
    """One photograph.

    Attributes:
        camera: camera of the full-size image.
        image: [H, W, 3] or, with straight (not premultiplied) alpha, [H, W, 4]; float in [0, 1] or uint8.
        mask: [H, W] or [H, W, 1] bool, True where the pixel counts; None: everywhere.
        correction: from the scene's colour c to the photograph's: [3] gain, gain * c; or [3, 4] matrix and offset,
            matrix @ c + offset; None: no correction.
        depth: [H, W] or [H, W, 1] float, camera z in world units, 0 or NaN where unknown; None: everywhere.
        normal: [H, W, 3] float, surface normals in the camera frame (OpenCV axes, facing the camera), 0 or NaN where
            unknown; None: everywhere.
        counted: number of True pixels of `mask`; None: not known.
        file: of the photograph; None: not known.
    """

    camera: Camera
    image: Tensor
    mask: Tensor | None = None
    correction: Tensor | None = None
    depth: Tensor | None = None
    normal: Tensor | None = None
    counted: int | None = None
    file: Path | None = None

    @property
    def nbytes(self) -> int:
        return sum(map_.nbytes for map_ in (self.image, self.mask, self.depth, self.normal) if map_ is not None)

    def to(self, device: torch.device | str) -> View:
        """Move the view to a device, to a GPU asynchronously, from pinned memory."""
        maps = {name: _moved(value, device) for name, value in self._asdict().items() if isinstance(value, Tensor)}
        return self._replace(camera=self.camera.to(device), **maps)

    def shown(self, rgb: Tensor, alpha: Tensor, background: Tensor | None) -> Tensor:
        """Apply this photograph's correction (`shown`)."""
        return shown(rgb, self.correction, alpha, background)

    def target(self, background: Tensor | None, device: torch.device | str) -> Tensor:
        """Compose the photograph over a colour [3] (None: black): [H, W, 3]."""
        return over_background(as_float(self.image.to(device)), background)

    def drawn(self, scene: Scene, background: Tensor | None) -> tuple[RenderOutput, Tensor, Tensor]:
        """Render the view without gradients of the texture: the output, its rgb [H, W, 3] with the photograph's
        correction, and the photograph [H, W, 3] over the same background."""
        output = scene.render(self.camera, background, "frozen")
        rgb = self.shown(output.rgb, output.alpha, background)
        return output, rgb, self.target(background, rgb.device)


@dataclass(frozen=True)
class TrainingData:
    """Inputs of a run.

    Attributes:
        views: training views at full size.
        cameras: of the views, apart from them as these may read photographs.
        extent: `init.scene_extent`.
        image_pixels: total over all views.
        first_surfels: initial number of surfels, also in a resumed run.
        covered: `covered_fraction`.
        exif_stops: log2 exposure of each view (`capture.exif.exif_stops`), NaN: unknown; None: all unknown.
        files: photograph of each view, which views may share; None: one view per photograph.
    """

    views: Sequence[View]
    cameras: Sequence[Camera]
    extent: float
    image_pixels: int
    first_surfels: int
    covered: float
    exif_stops: Sequence[float] | None = None
    files: Sequence[Path] | None = None


def _moved(value: Tensor | None, device: torch.device | str) -> Tensor | None:
    if value is None or value.device.type != "cpu" or torch.device(device).type != "cuda":
        return None if value is None else value.to(device)
    return value.pin_memory().to(device, non_blocking=True)


def covered_fraction(views: Sequence[View]) -> float:
    """Measure the fraction of opaque, unmasked pixels on a sample of the views."""
    fractions = []
    for view in (views[i] for i in spread(len(views), COVERED_VIEWS)):
        shows = view.image[..., -1:] > 0 if view.image.shape[-1] == 4 else torch.ones((), dtype=torch.bool)
        if view.mask is not None:
            shows = shows & view.mask.reshape(*view.mask.shape[:2], 1)
        fractions.append(float(shows.float().mean()))
    return sum(fractions) / max(1, len(fractions))


def shown(rgb: Tensor, correction: Tensor | None, alpha: Tensor, background: Tensor | None) -> Tensor:
    """Apply a photograph's correction to a rendered image [H, W, 3], except to the background's contribution.

    Args:
        rgb: [H, W, 3] over the background.
        correction: as in `View`; None: returns `rgb`.
        alpha: [H, W, 1] coverage.
        background: [3]; None: black.
    """
    if correction is None:
        return rgb
    behind = None if background is None else (1.0 - alpha) * background
    seen = rgb if behind is None else rgb - behind
    if correction.ndim == 1:
        seen = seen * correction
    else:  # no matrix product: cuBLAS fails if torch is set to deterministic algorithms
        mixed = (seen[..., i : i + 1] * correction[:, i] for i in range(3))
        seen = sum(mixed, alpha * correction[:, 3])
    return seen if behind is None else seen + behind


def as_float(image: Tensor) -> Tensor:
    """Convert an image to float32 in [0, 1]."""
    return image / 255.0 if image.dtype == torch.uint8 else image.float()


def downscale_image(image: Tensor, width: int, height: int) -> Tensor:
    """Downscale an image [H, W, C] by area averaging to [height, width, C]; with C = 4 colours are weighted by alpha,
    so that hidden colours do not bleed in."""
    if image.shape[:2] == (height, width):
        return image
    alpha = image[..., 3:]
    if image.shape[-1] == 4:
        image = torch.cat([image[..., :3] * alpha, alpha], -1)
    small = interpolate(image.permute(2, 0, 1)[None], size=(height, width), mode="area")[0].permute(1, 2, 0)
    if image.shape[-1] == 4:
        small = torch.cat([small[..., :3] / small[..., 3:].clamp(min=1e-6), small[..., 3:]], -1)
    return small.contiguous()


def downscale_mask(mask: Tensor, width: int, height: int) -> Tensor:
    """Downscale a mask ([H, W] or [H, W, 1] bool) to [height, width, 1]: True where all pixels are."""
    mask = mask.reshape(*mask.shape[:2], 1)
    if mask.shape[:2] == (height, width):
        return mask
    return downscale_image(mask.float(), width, height) > 0.999


def resample_nearest(values: Tensor, width: int, height: int) -> Tensor:
    """Resample values [H, W, ...] to [height, width, ...] by nearest neighbour: edges must not be averaged."""
    rows, columns = (
        ((torch.arange(new, device=values.device) + 0.5) * (old / new)).long()
        for new, old in zip((height, width), values.shape[:2], strict=True)
    )
    return values if values.shape[:2] == (height, width) else values[rows[:, None], columns]


def background_changes(config: TrainConfig, view: View) -> bool:
    """Return True if each step on a view uses another background colour."""
    return config.background == "random" or (config.background == "auto" and view.image.shape[-1] == 4)


def step_background(config: TrainConfig, view: View, step: int, device: torch.device | str) -> Tensor | None:
    """Choose the background colour [3] of a training step; None: black. A random one depends on seed and step."""
    if not background_changes(config, view):
        return eval_background(config, device)
    return torch.rand(3, generator=random_numbers(config.seed, step)).to(device, non_blocking=True)


def random_numbers(seed: int, number: int, device: torch.device | str = "cpu") -> torch.Generator:
    """Return random numbers that depend on `seed`, `number` and the kind of device."""
    return torch.Generator(device).manual_seed((seed * 1_000_003 + number) & 0x7FFF_FFFF_FFFF_FFFF)


def eval_background(config: TrainConfig, device: torch.device | str) -> Tensor | None:
    """Choose the background colour [3] for evaluation, None: black: that of training, or `config.alpha_color` if that
    is random."""
    kind = config.background if config.background in ("black", "white") else config.alpha_color
    return torch.ones(3, device=device) if kind == "white" else None


def over_background(image: Tensor, background: Tensor | None) -> Tensor:
    """Compose an image, with or without alpha, over a colour [3] (None: black): [H, W, 3]."""
    if image.shape[-1] == 3:
        return image
    color = image[..., :3] * image[..., 3:]
    return color if background is None else color + (1.0 - image[..., 3:]) * background


def at_size(view: View, camera: Camera, device: torch.device | str) -> View:
    """Move a view to a device and downscale it to the size of `camera`, its camera scaled, unless it has that already.
    Raises ValueError: image, mask, depth or normals have the size of neither camera."""
    image = as_float(view.image.to(device))
    for what in ("image", "mask", "depth", "normal"):
        picture = getattr(view, what)
        sizes = ((view.camera.height, view.camera.width), (camera.height, camera.width))
        if picture is not None and tuple(picture.shape[:2]) not in sizes:
            h, w = picture.shape[:2]
            raise ValueError(
                f"the {what} is {w} x {h} pixels, but its camera {view.camera.width} x {view.camera.height}"
            )
    size = (camera.width, camera.height)
    mask = None if view.mask is None else downscale_mask(view.mask.to(device), *size)
    depth, normal = (
        None if values is None else resample_nearest(values.to(device), *size) for values in (view.depth, view.normal)
    )
    return View(camera, downscale_image(image, *size), mask, view.correction, depth, normal)


class DownscaledViews:
    """Training views at the current resolution; downscaled images are cached until the resolution changes.

    On a CUDA device full-size and downscaled images share one budget; images beyond it are copied at every use.

    Args:
        device: of the returned images.
        correction: current correction of a view by its index; None: its own.
        pose: camera of a view, by its index, with the current pose; None: poses are fixed.
        resident_bytes: budget on a CUDA device; None: `photograph_budget`.
    """

    def __init__(
        self,
        views: Sequence[View],
        device: torch.device | str = "cpu",
        correction: Callable[[int], Tensor | None] | None = None,
        pose: Callable[[int, Camera], Camera] | None = None,
        resident_bytes: int | None = None,
    ) -> None:
        self._views = views
        self._correction, self._pose = correction, pose
        self._device = torch.device(device)
        self._factor = 1.0
        self._kept: dict[int, View] = {}
        self._resident: dict[int, View] = {}
        self._counted: dict[int, int] = {}  # avoids a synchronisation in every step
        if resident_bytes is None:
            resident_bytes = photograph_budget(self._device)
        self._budget = MemoryBudget(resident_bytes)
        self._reduced_budget = self._budget if resident_bytes else MemoryBudget(DOWNSCALED_BYTES)

    def __len__(self) -> int:
        return len(self._views)

    def at(self, index: int, factor: float) -> View:
        """Return view `index`, resized by `factor`, with its current correction and pose."""
        view = self._at(index, factor)
        if self._pose is not None:
            view = view._replace(camera=self._pose(index, view.camera))
        correction = None if self._correction is None else self._correction(index)
        return view if correction is None else view._replace(correction=correction)

    def _at(self, index: int, factor: float) -> View:
        if factor != self._factor:
            self._reduced_budget.left += sum(view.nbytes for view in self._kept.values())
            self._factor = factor
            self._kept = {}
            self._counted = {}
        if index in self._kept:
            return self._kept[index]
        view = self._full_size(index)
        camera = view.camera
        view = at_size(view, camera.scaled(factor) if factor < 1.0 else camera, self._device)
        if view.mask is not None:
            if index not in self._counted:
                self._counted[index] = int(view.mask.sum())
            view = view._replace(counted=self._counted[index])
        if factor < 1.0 and self._reduced_budget.reserve(view.nbytes):
            self._kept[index] = view
        return view

    def _full_size(self, index: int) -> View:
        if index in self._resident:
            return self._resident[index]
        moved = self._views[index].to(self._device)
        if self._budget.reserve(moved.nbytes):
            self._resident[index] = moved
        return moved

    def draw(self, k: int, generator: torch.Generator, factor: float) -> Sequence[View]:
        """Sample at most `k` different views, downscaled on access."""
        order = torch.randperm(len(self), generator=generator).tolist()[:k]
        return OnDemand(len(order), lambda i: self.at(order[i], factor))


def photograph_budget(device: torch.device) -> int:
    """Return the bytes of photographs to cache: a quarter of a CUDA device's free memory; 0 for the CPU."""
    return torch.cuda.mem_get_info(device)[0] // 4 if device.type == "cuda" else 0


def training_order(n: int, seed: int, step: int) -> int:
    """Compute the index of the view at position `step` of the training order: each once per epoch, reshuffled. Depends
    only on the arguments: a resumed run uses the same views."""
    epoch, position = divmod(step, n)
    return _order(n, seed, epoch)[position]


@functools.lru_cache(maxsize=2)
def _order(n: int, seed: int, epoch: int) -> list[int]:
    return torch.randperm(n, generator=random_numbers(seed, 7_919 + epoch)).tolist()


T = TypeVar("T")


class MemoryBudget:
    """Byte budget shared by caches, first come, first served: views are used cyclically, so evicting the oldest would
    drop each just before its next use. `left`: bytes not reserved."""

    def __init__(self, nbytes: int) -> None:
        self.left = nbytes

    def reserve(self, nbytes: int) -> bool:
        if nbytes > self.left:
            return False
        self.left -= nbytes
        return True


class OnDemand(Sequence[T]):
    """A sequence that makes its items, 0 to count - 1, at each access."""

    def __init__(self, count: int, make: Callable[[int], T]) -> None:
        self._indices, self._make = range(count), make

    def __len__(self) -> int:
        return len(self._indices)

    def __getitem__(self, index: int) -> T:
        return self._make(self._indices[index])
