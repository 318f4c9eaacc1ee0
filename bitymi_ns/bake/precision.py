"""Quantisation steps of the surfels' columns from the image error of rounding each."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice

import numpy.typing as npt
import torch
from torch import Tensor

from bitymi_ns.codec.surfel_codes import CODED, REFERENCE, code_surfels, reordered, term_numbers
from bitymi_ns.progress import Progress, no_progress
from bitymi_ns.scene.baked import BakedScene
from bitymi_ns.train.losses import psnr
from bitymi_ns.train.views import View

WIDEST, NARROWEST = 4.0, 1.0 / 64
"""Range of the steps, as multiples of the reference steps: beyond, errors are not proportional to them."""
PER_BIT = 2.0 * math.log(2.0)  # relative fall, per bit, of an error proportional to the square of a step


class Pictures:
    """Sample of the training views, for comparison with renderings; `numbers`: of colour values in unmasked pixels."""

    def __init__(
        self, views: Sequence[View], background: Tensor, most: int, device: torch.device | str = "cpu"
    ) -> None:
        """Take up to `most` of the views with an unmasked pixel, spread over all. `background`: [3]."""
        taken = [views[i] for i in range(0, len(views), max(1, math.ceil(len(views) / most)))]
        chosen = [*filter(_counts, taken)] or [*islice(filter(_counts, views), most)]
        self._device, self._background = device, background.to(device)
        self._targets = [view.target(self._background, device) for view in chosen]
        self._views = [v._replace(image=t).to(device) for v, t in zip(chosen, self._targets, strict=True)]
        self._masks = [view.mask for view in self._views]
        self.views = len(chosen)
        counts = (t.numel() if m is None else 3 * int(m.sum()) for t, m in zip(self._targets, self._masks, strict=True))
        self.numbers = sum(counts)

    def of(self, scene: BakedScene) -> list[Tensor]:
        """Draw the views [H, W, 3] with the corrections of their photographs."""
        scene = scene.to(self._device)
        drawn = [(view, scene.render(view.camera, self._background)) for view in self._views]
        return [view.shown(d.rgb, d.alpha, self._background).clamp(0.0, 1.0) for view, d in drawn]

    def square(self, pictures: Sequence[Tensor], than: Sequence[Tensor] | None = None) -> float:
        """Average the square difference from other pictures; None: from the photographs."""
        pairs = zip(pictures, self._targets if than is None else than, self._masks, strict=True)
        return sum(_square(*pair) for pair in pairs) / max(1, self.views)

    def psnr(self, pictures: Sequence[Tensor]) -> float:
        pairs = zip(pictures, self._targets, self._masks, strict=True)
        return sum(psnr(*pair) for pair in pairs) / max(1, self.views)


def _counts(view: View) -> bool:
    return view.mask is None or bool(view.mask.any())


@dataclass(frozen=True)
class ColumnNoise:
    noise: Mapping[str, float]  # mean square error of the pictures over the squared step; 0 = not visible
    counts: Mapping[str, int]  # numbers of the column

    def steps(self, lmbda: float) -> dict[str, float]:
        """Choose the steps at which one more bit per number of a column lowers the error by lambda: a column of step s
        adds D s^2 to the mean square error, and halving s takes a bit per number. `lmbda`: mean square error per bit; 0
        = unknown: take the reference steps."""
        if lmbda == 0:
            return dict(REFERENCE)
        return {name: _step(name, lmbda * self.counts[name] / PER_BIT, self.noise[name]) for name in REFERENCE}


@torch.no_grad()
def column_noise(
    scene: BakedScene, sizes: npt.ArrayLike, extent: Tensor, pictures: Pictures, progress: Progress = no_progress
) -> ColumnNoise:
    """Measure the image error of each column rounded alone, at its reference step. `scene`: N surfels with reduced view
    colours, on the CPU. `sizes`: [N, 2] sides of the tiles, texels; (0, 0) = none. `extent`: [N] their half sides."""
    codes, order = code_surfels(scene.surfels, scene.view_color, sizes, extent, REFERENCE)
    moved = {name: getattr(scene, name) for name in ("tiles", "extent", "mean_residual", "mean_alpha")}
    moved = {name: None if value is None else value[order].contiguous() for name, value in moved.items()}
    plain = replace(scene, surfels=reordered(scene.surfels, order), **moved)
    drawn = pictures.of(scene)
    rounded = codes.surfels()
    tiled = torch.from_numpy(codes.sizes[:, 0] > 0)
    extent = torch.where(tiled, codes.extent(1.0), extent[order])
    noise, counts = {}, {}
    for done, name in enumerate(REFERENCE):
        column = codes.codes[name]
        counts[name] = len(column) * (3 if name == "place" else column.shape[1])
        if name == "extent":
            changed = replace(plain, extent=extent)
        elif name in ("term_shape", "term_color"):
            numbers = term_numbers(codes.kind)[name == "term_shape"]
            terms = plain.surfels["view_terms"].clone()
            terms[:, numbers] = rounded["view_terms"][:, numbers]
            changed = replace(plain, surfels={**plain.surfels, "view_terms": terms})
        else:
            parameter = CODED.get(name, name)
            changed = replace(plain, surfels={**plain.surfels, parameter: rounded[parameter]})
        error = pictures.square(pictures.of(changed), drawn) if len(column) and pictures.views else 0.0
        noise[name] = error / codes.steps[name] ** 2
        progress("rounding the surfels", done + 1, len(REFERENCE))
    return ColumnNoise(noise, counts)


def _step(name: str, error: float, noise: float) -> float:
    wanted = math.sqrt(error / noise) / REFERENCE[name] if noise > 0 else WIDEST
    return REFERENCE[name] * min(WIDEST, max(NARROWEST, wanted))


def _square(rgb: Tensor, target: Tensor, mask: Tensor | None) -> float:
    difference = (rgb.clamp(0.0, 1.0) - target.clamp(0.0, 1.0)).square()
    return float((difference if mask is None else difference[mask.reshape(mask.shape[:2])]).mean())
