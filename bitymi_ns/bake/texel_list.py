"""The texels of a bake as one list, on the device where they learn."""

from collections.abc import Sequence

import torch
from torch import Tensor

from bitymi_ns.bake.baked import Baked
from bitymi_ns.ops import Projection, TexelTiles, add_texel_coverage, fitting_lists, project
from bitymi_ns.ops.project import GEOMETRY
from bitymi_ns.progress import Progress, no_progress
from bitymi_ns.scene.camera import Camera
from bitymi_ns.train.views import View


class TexelList:
    """The texels of a bake, tile after tile. A surfel without a tile has one texel, its constant residual.

    Attributes:
        scene: the surfels, on the device.
        tiles: where the texels lie.
        values: [T, 3] residual colours as baked, on the device.
        alpha: opacities of the texels on the device, which stand still; None = opaque texels.
    """

    def __init__(self, baked: Baked, device: torch.device | str = "cpu") -> None:
        """
        Args:
            baked: with an atlas.
            device: where the texels learn.

        Raises:
            ValueError: there is no atlas.
        """
        if not baked.textured:
            raise ValueError("a scene without texture has no texels to tune")
        self.device = torch.device(device)
        self.scene = baked.scene.to(device)
        self.tiles = TexelTiles.of_sizes(baked.sizes.clamp(min=1).to(device), baked.extent.float().to(device))
        self.values = baked.texels[:, :3].contiguous().to(device, copy=True)
        self.alpha = None if baked.alpha is None else baked.alpha.to(device)

    def projection(self, camera: Camera) -> Projection:
        """Of the surfels into a view."""
        geometry = (self.scene.surfels[name] for name in GEOMETRY)
        projection = project(*geometry, camera.to(self.device), self.scene.near, self.scene.prefilter)
        projection.alpha = self.alpha
        return projection

    def coverage(self, views: Sequence[View], progress: Progress = no_progress, squared: bool = False) -> Tensor:
        """Coverage of every texel, in pixels.

        Args:
            squared: square the blending weights.

        Returns:
            [T] sum over views and fragments of the blending weight, or its square, times the bilinear weight, in pixels
            that count; 0 where no view sees it.
        """
        total = torch.zeros_like(self.values)
        self.add_coverage(views, None if squared else total, total if squared else None, progress)
        return total[:, 0]

    def add_coverage(
        self, views: Sequence[View], total: Tensor | None, squares: Tensor | None, progress: Progress = no_progress
    ) -> None:
        """Add the same of both kinds.

        Args:
            total: [T, 3], added to, alike in all columns; None = not wanted.
            squares: [T, 3], added to: that of the blending weights' squares. None = not wanted.
        """
        for done, view in enumerate(views, start=1):
            lists = fitting_lists(self.projection(view.camera))
            add_texel_coverage(lists, self.tiles, view.mask, self.scene.weight_bound, total, squares)
            progress("tracing the training views", done, len(views))
