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
        return project(*geometry, camera.to(self.device), self.scene.near, self.scene.prefilter, alpha=self.alpha)

    def coverage(
        self, views: Sequence[View], progress: Progress = no_progress, powers: Sequence[int] = (1,)
    ) -> list[Tensor]:
        """Coverage of every texel, in pixels.

        Args:
            powers: of the blending weights, 1 and 2.

        Returns:
            for each power [T], the sum over views and fragments of the power of the blending weight times the bilinear
            weight, in pixels that count; 0 where no view sees it.
        """
        totals = {power: torch.zeros_like(self.values) for power in powers}
        for done, view in enumerate(views, start=1):
            lists = fitting_lists(self.projection(view.camera))
            to = (totals.get(1), totals.get(2))
            add_texel_coverage(lists, self.tiles, view.mask, self.scene.weight_bound, *to)
            progress("tracing the training views", done, len(views))
        return [total[:, 0] for total in totals.values()]
