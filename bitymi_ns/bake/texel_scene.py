"""A bake as a list of texels: what they add to the photographs' pictures, and the gradients of these."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from bitymi_ns.bake.baked import Baked
from bitymi_ns.bake.early_stopping import look
from bitymi_ns.codec.pages import listed_texels, paged_texels
from bitymi_ns.ops import (
    Fragments,
    Projection,
    TexelFragments,
    TexelTiles,
    add_texel_coverage,
    add_texel_gradient,
    blended_image,
    fitting_lists,
    project,
    texel_image,
    view_color,
)
from bitymi_ns.ops.backend import require
from bitymi_ns.progress import Progress, no_progress
from bitymi_ns.scene.camera import Camera
from bitymi_ns.scene.scene import GEOMETRY
from bitymi_ns.train.views import MemoryBudget, View, shown


@dataclass
class TexelView:
    """A photograph, and what the texels add to its picture.

    Attributes:
        fragments: those that show a texel.
        base: [N, 3] f_view of every surfel.
        rest: [H, W, 3] the picture without these fragments: the faint ones, and the background.
        target: [H, W, 3] the photograph over the background.
        mask: [H, W, 1] bool, True where the pixel counts; None = everywhere.
        correction: of the photograph's exposure, as in `View`; None = there is none.
        alpha: [H, W, 1] coverage; None without a correction.
    """

    fragments: TexelFragments
    base: Tensor
    rest: Tensor
    target: Tensor
    mask: Tensor | None
    correction: Tensor | None = None
    alpha: Tensor | None = None

    @property
    def nbytes(self) -> int:
        """Memory that it takes."""
        arrays = (self.base, self.rest, self.target, self.mask, self.alpha)
        return self.fragments.nbytes + sum(array.nbytes for array in arrays if array is not None)


class TexelScene:
    """A baked scene as a list of texels, for pictures and gradients.

    Attributes:
        tiles: where the texels lie. A surfel without a tile has one texel, its constant residual.
        texels: [T, 3] as baked.
        sizes: [N, 2] int32 sides of the tiles; (0, 0) = none.
    """

    def __init__(self, baked: Baked, background: Tensor) -> None:
        """
        Args:
            baked: with an atlas, on the CPU.
            background: [3] colour behind the scene, on any device.

        Raises:
            ValueError: there is no atlas.
            RuntimeError: the scene of the bake was moved to another device.
        """
        if baked.texels is None:
            raise ValueError("a scene without texture has no texels to tune")
        advice = "give it the bake as it was made, or move its scene there"
        require("the fine-tuning", "cpu", baked.scene.tiles.device, advice)
        self._baked, self._background = baked, background.cpu()
        self.sizes = torch.from_numpy(baked.packing.tiles[:, 3:])
        self.tiles = TexelTiles.of_sizes(self.sizes.clamp(min=1), baked.extent.float())
        self.texels = listed_texels(baked.texels, baked.packing, baked.mean_residual)

    def baked(self, texels: Tensor) -> Baked:
        """The bake with these texels [T, 3], to be `encoded`."""
        pages = paged_texels(texels, self._baked.packing, self._baked.texels)
        bare = self.sizes[:, 0] == 0
        constants = torch.where(bare[:, None], texels[self.tiles.first], self._baked.mean_residual)
        return self._baked.with_mean_residual(constants).with_texels(pages)

    def projection(self, camera: Camera) -> Projection:
        """Of the surfels into a view, on the CPU."""
        scene = self._baked.scene
        geometry = (scene.surfels[name] for name in GEOMETRY)
        return project(*geometry, camera.to("cpu"), scene.near, scene.through_pixel)

    def coverage(self, views: Sequence[View], progress: Progress = no_progress, squared: bool = False) -> Tensor:
        """How much of the pictures every texel makes up, in pixels: [T, 1] sum over views and fragments of the blending
        weight, or its square, times the bilinear weight, in pixels that count; 0 where no view sees it."""
        total = torch.zeros_like(self.texels)
        self.add_coverage(views, None if squared else total, total if squared else None, progress)
        return total[:, :1]

    def add_coverage(
        self, views: Sequence[View], total: Tensor | None, squares: Tensor | None, progress: Progress = no_progress
    ) -> None:
        """Adds the same of both kinds.

        Args:
            views: training views.
            total: [T, 3], added to, alike in all columns; None = not wanted.
            squares: [T, 3], added to: that of the blending weights' squares. None = not wanted.
            progress: called after every view.
        """
        for done, view in enumerate(views, start=1):
            lists = fitting_lists(self.projection(view.camera))
            add_texel_coverage(lists, self.tiles, view.mask, self._baked.scene.weight_bound, total, squares)
            progress("tracing the training views", done, len(views))

    @torch.no_grad()
    def view(self, view: View) -> TexelView:
        """Traces a view."""
        scene, projection = self._baked.scene, self.projection(view.camera)
        p, camera = scene.surfels, projection.camera
        base = view_color(scene.view_color, p, p["means"], camera.exact_center, projection.visible)
        drawn: list[Tensor] = []

        def chosen_lists() -> Iterator[tuple[Fragments, Tensor]]:
            for fragments in fitting_lists(projection):
                drawn.append(blended_image(fragments, projection, base))
                yield fragments, fragments.weight >= scene.weight_bound
                del fragments  # before the next list is made

        chosen = TexelFragments.of_lists(chosen_lists())
        plain = torch.cat(drawn)
        without = texel_image(chosen, base, self.texels, self.tiles, bound=math.inf)  # their colours without residual
        rest = plain[:, :3] - without + (1 - plain[:, 3:4]) * self._background
        size = (camera.height, camera.width)
        target = view.target(self._background, "cpu")
        mask = None if view.mask is None else view.mask.cpu().reshape(*size, 1)
        correction = alpha = None
        if view.correction is not None:
            correction, alpha = view.correction.detach().cpu(), plain[:, 3:4].reshape(*size, 1)
        return TexelView(chosen, base, rest.view(*size, 3), target.contiguous(), mask, correction, alpha)

    @torch.no_grad()
    def render(self, view: TexelView, texels: Tensor) -> Tensor:
        """[H, W, 3] the picture with these texels, as the baked renderer shows it before any quantisation."""
        return texel_image(view.fragments, view.base, texels, self.tiles).view_as(view.rest) + view.rest

    def shown(self, view: TexelView, rgb: Tensor) -> Tensor:
        """[H, W, 3] a picture as the view's photograph shows it, by its correction."""
        return rgb if view.alpha is None else shown(rgb, view.correction, view.alpha, self._background)

    def add_gradient(self, view: TexelView, texels: Tensor, dimage: Tensor, out: Tensor) -> None:
        """Adds the gradient [T, 3] of a picture's gradient [H, W, 3]."""
        add_texel_gradient(dimage.reshape(-1, 3), view.fragments, view.base, texels, self.tiles, 0.0, out)


LEAST_KEPT = 1 / 8
"""Share of the views that fits where any are kept: of fewer, the memory is worth more than the time that they save."""


class TexelViews(Sequence[TexelView]):
    """Views of a scene, traced when they are needed and kept while there is budget for them."""

    def __init__(self, scene: TexelScene, views: Sequence[View], budget: MemoryBudget) -> None:
        self._scene, self._views, self._budget = scene, views, budget
        self._kept: dict[int, TexelView] = {}
        self._keeps: bool | None = None  # whether any; not known before the first one

    def __len__(self) -> int:
        return len(self._views)

    def __getitem__(self, index: int) -> TexelView:  # type: ignore[override]
        if index in self._kept:
            return self._kept[index]
        view = self._scene.view(self._views[index])
        if self._keeps is None:
            self._keeps = self._budget.left >= LEAST_KEPT * len(self) * view.nbytes
        if self._keeps and self._budget.reserve(view.nbytes):
            self._kept[index] = view
        return view

    def psnr(self, texels: Tensor, progress: Progress = no_progress) -> float:
        """Mean dB over the views of which any pixel counts."""
        scene = self._scene
        pictures = ((scene.shown(view, scene.render(view, texels)), view.target, view.mask) for view in self)
        return look(pictures, len(self), progress)
