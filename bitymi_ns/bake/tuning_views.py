"""Texels and traced views for the fine-tuning of a bake."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from bitymi_ns.ops import (
    Fragments,
    Projection,
    TexelDescent,
    TexelTiles,
    add_texel_coverage,
    blended_image,
    fitting_lists,
    project,
    select,
    view_color,
)
from bitymi_ns.ops.project import geometry_of
from bitymi_ns.progress import Progress, no_progress
from bitymi_ns.scene.camera import Camera
from bitymi_ns.train.losses import count_values, photometric
from bitymi_ns.train.views import MemoryBudget, View, shown
from .early_stopping import evaluate
from .stages import Stage


class TexelList:
    """Texels of a bake on its device (`Stage.texels`): residual colours [T, 3], `values`, and alphas, which are not
    tuned (None = opaque)."""

    def __init__(self, baked: Stage) -> None:
        """Raises ValueError: no surfel has a tile."""
        if not baked.textured:
            raise ValueError("a scene without texture has no texels to tune")
        self.device = device = baked.device
        self.scene = baked.scene.to(device)
        self.tiles = TexelTiles.of_sizes(baked.sizes.clamp(min=1).to(device), baked.extent.float().to(device))
        self.values = baked.texels[:, :3].contiguous().to(device, copy=True)
        self.alpha = None if baked.alpha is None else baked.alpha.to(device)

    def projection(self, camera: Camera) -> Projection:
        geometry = geometry_of(self.scene.surfels)
        return project(*geometry, camera=camera.to(self.device), near=self.scene.near, alpha=self.alpha)

    def coverage(self, views: Sequence[View], progress: Progress = no_progress) -> Tensor:
        """Measure the coverage of every texel in unmasked pixels, [T, 2]: the sums over views and fragments of blending
        weight, and of its square, times bilinear weight."""
        covered = self.values.new_zeros(len(self.values), 2)
        for done, view in enumerate(views, start=1):
            projection = self.projection(view.camera)
            add_texel_coverage(projection, self.tiles, view.mask, self.scene.weight_bound, covered)
            progress("tracing the training views", done, len(views))
        return covered


LEAST_KEPT = 1 / 8  # share of the views that must fit the budget for any to be kept


@dataclass
class TuningView:
    """A photograph and its traced view."""

    projection: Projection  # into the first view: blending reads of it only the unused beta channel
    lists: list[Fragments]  # those that show a texel, in bands from top to bottom
    base: Tensor  # [N, 3] f_view
    rest: Tensor  # [H, W, 3] the picture without these fragments
    target: Tensor  # [H, W, 3] the photograph over the background
    mask: Tensor | None  # [H, W, 1] bool, as in `View`
    correction: Tensor | None = None  # as in `View`
    alpha: Tensor | None = None  # [H, W, 1] coverage; None without a correction

    @property
    def nbytes(self) -> int:
        arrays = (self.base, self.rest, self.target, self.mask, self.alpha, *self.lists)
        return sum(array.nbytes for array in arrays if array is not None)


class TuningViews(Sequence[TuningView]):
    """Views of a bake, traced at first use and kept while there is budget for them."""

    def __init__(self, texels: TexelList, views: Sequence[View], background: Tensor, budget: MemoryBudget) -> None:
        self._texels = texels
        self._views = views
        self._budget = budget
        self._background = background.to(texels.device)
        self._kept: dict[int, TuningView] = {}
        self._keeps: bool | None = None  # whether any; None before the first
        self._projection: Projection | None = None  # of the first view

    def __len__(self) -> int:
        return len(self._views)

    def __getitem__(self, index: int) -> TuningView:
        if index in self._kept:
            return self._kept[index]
        view = self._traced(self._views[index])
        if self._keeps is None:
            self._keeps = self._budget.left >= LEAST_KEPT * len(self) * view.nbytes
        if self._keeps and self._budget.reserve(view.nbytes):
            self._kept[index] = view
        return view

    @torch.no_grad()
    def _traced(self, view: View) -> TuningView:
        scene = self._texels.scene
        projection = self._texels.projection(view.camera)
        self._projection = self._projection or projection
        p, camera = scene.surfels, projection.camera
        base = view_color(scene.view_color, p, p["means"], camera.exact_center, projection.visible)
        lists, rest, alpha = [], [], []
        for fragments in fitting_lists(projection):
            plain = blended_image(fragments, projection, base)
            chosen = select(fragments, fragments.weight >= scene.weight_bound)
            del fragments  # before the next list is made
            alpha.append(plain[:, 3:4])
            rest.append(plain[:, :3] - blended_image(chosen, projection, base)[:, :3])
            lists.append(chosen)
        size = (camera.height, camera.width)
        covered = torch.cat(alpha)
        behind = torch.cat(rest) + (1 - covered) * self._background
        device = self._texels.device
        return TuningView(
            self._projection,
            lists,
            base,
            behind.view(*size, 3),
            view.target(self._background, device).contiguous(),
            None if view.mask is None else view.mask.to(device).reshape(*size, 1),
            None if view.correction is None else view.correction.detach().to(device),
            None if view.correction is None else covered.reshape(*size, 1),
        )

    def picture(self, view: TuningView, texels: Tensor, descent: TexelDescent | None = None) -> Tensor:
        """Render a view of this sequence with texels [T, 3] and its photograph's correction: [H, W, 3]."""
        drawn = (view.projection, view.base, texels, self._texels.tiles)
        rgb = torch.cat([blended_image(part, *drawn, descent=descent)[:, :3] for part in view.lists])
        rgb = rgb.view_as(view.rest) + view.rest
        return rgb if view.alpha is None else shown(rgb, view.correction, view.alpha, self._background)

    def step(
        self, index: int, texels: Tensor, step_size: Tensor, rate: float, ssim_weight: float, read: Tensor | None = None
    ) -> None:
        """Move texels [T, 3] in place by -rate step_size[t] times the gradient of a view's loss, summed over pixels and
        channels. `read`: [T, 3] texels that the picture shows; None = those that are moved."""
        view = self[index]
        if read is None:
            read = texels if len(view.lists) == 1 else texels.clone()  # a band must not read what another has moved
        # the loss is a mean, the step wants a sum
        descent = TexelDescent(step_size, rate * count_values(view.target, view.mask), texels)
        photometric(self.picture(view, read, descent), view.target, ssim_weight, view.mask).backward()

    @torch.no_grad()
    def psnr(self, texels: Tensor, progress: Progress = no_progress) -> float:
        texels = texels.to(self._texels.device)
        pictures = ((self.picture(view, texels), view.target, view.mask) for view in self)
        return evaluate(pictures, len(self), progress)
