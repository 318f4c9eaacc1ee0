"""Fine-tuning of an atlas against the photographs: texels alone; geometry, opacity and view colours stand still."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from bitymi_ns.bake.looks import Looks, gain, look, set_aside
from bitymi_ns.bake.pages import listed_texels, paged_texels
from bitymi_ns.bake.pipeline import Baked
from bitymi_ns.bake.statistics import FineTuning
from bitymi_ns.bake.texel_codes import TexelCodeOptions, TexelCoder, TexelCodes
from bitymi_ns.ops import (
    Fragments,
    TexelFragments,
    TexelTiles,
    add_texel_coverage,
    add_texel_gradient,
    composite_image,
    fitting_lists,
    project,
    shade,
    texel_image,
    view_color,
)
from bitymi_ns.ops.backend import require
from bitymi_ns.progress import Progress, no_progress
from bitymi_ns.scene.scene import GEOMETRY
from bitymi_ns.train.config import TexelSteps
from bitymi_ns.train.losses import numbers, photometric
from bitymi_ns.train.memory import MemoryBudget, OnDemand
from bitymi_ns.train.schedules import falling
from bitymi_ns.train.views import View, shown, training_order

TO_START = 0.93
"""Share of the bytes that coded texels may have before their last steps, in which they grow a little."""
FEWEST_VIEWS = 4
"""With fewer views none can be set aside: an atlas is then not tuned."""


@dataclass
class TuneOptions(TexelSteps):
    """How an atlas is fine-tuned."""

    steps: int = 400
    """Steps; each looks at one training view."""
    ssim_weight: float = 0.2
    """Share of 1 - SSIM in the loss; the rest is L1."""
    held_in_every: int = 8
    """Every so-many-th training view is set aside; the texels kept are those that show these best."""
    checks: int = 16
    """How often these views are looked at over the run."""
    patience: int = 6
    """Looks without a gain after which the run ends."""
    cache_bytes: int = 1_000_000_000
    """Memory for the fragments of the views, first of those set aside, which are looked at most often; what does not
    fit is traced anew whenever it is needed."""
    seed: int = 0
    """Of the order of the views."""
    coded_steps: int = 120
    """Further steps for texels that will be coded: they see what the coding makes of the texels."""
    coded_every: int = 10
    """How often it is looked what the coding makes of them."""
    coded_rate: float = 0.02
    """Their rate at the start."""

    def check(self) -> None:
        """Refuses values that make no sense."""
        least_of = {"steps": 1, "held_in_every": 2, "checks": 1, "patience": 1, "cache_bytes": 0}
        for name, least in {**least_of, "coded_steps": 0, "coded_every": 1}.items():
            if getattr(self, name) < least:
                raise ValueError(f"{name} of the fine-tuning must be at least {least}, not {getattr(self, name)}")
        if not self.rate > 0 or not self.prior > 0 or not 0 <= self.ssim_weight <= 1:
            raise ValueError("rate and prior of the fine-tuning must be positive, the SSIM weight between 0 and 1")


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

    @torch.no_grad()
    def view(self, view: View) -> TexelView:
        """Traces a view."""
        scene, camera = self._baked.scene, view.camera.to("cpu")
        p = scene.surfels
        geometry = (p[name] for name in GEOMETRY)
        projection = project(*geometry, camera, scene.near, scene.through_pixel)
        base = view_color(scene.view_color, p, p["means"], camera.exact_center, projection.visible)
        drawn: list[Tensor] = []

        def chosen_lists() -> Iterator[tuple[Fragments, Tensor]]:
            for fragments in fitting_lists(projection):
                drawn.append(composite_image(fragments, projection, shade(fragments, base, projection.frames)))
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


class TexelViews(Sequence[TexelView]):
    """Views of a scene, traced when they are needed and kept while there is budget for them."""

    def __init__(self, scene: TexelScene, views: Sequence[View], budget: MemoryBudget) -> None:
        self._scene, self._views, self._budget = scene, views, budget
        self._kept: dict[int, TexelView] = {}

    def __len__(self) -> int:
        return len(self._views)

    def __getitem__(self, index: int) -> TexelView:  # type: ignore[override]
        if index in self._kept:
            return self._kept[index]
        view = self._scene.view(self._views[index])
        if self._budget.reserve(view.nbytes):
            self._kept[index] = view
        return view

    def psnr(self, texels: Tensor, progress: Progress = no_progress) -> float:
        """Mean dB over the views of which any pixel counts."""
        scene = self._scene
        pictures = ((scene.shown(view, scene.render(view, texels)), view.target, view.mask) for view in self)
        return look(pictures, len(self), progress)


def tune_atlas(
    baked: Baked,
    views: Sequence[View],
    background: Tensor,
    options: TuneOptions | None = None,
    progress: Progress = no_progress,
    eval_views: Sequence[View] = (),
    coding: TexelCodeOptions | None = None,
) -> Baked:
    """Fine-tunes the texels of a bake against its training photographs, 0.8 L1 + 0.2 (1 - SSIM).

    A step moves texel t by t <- t - rate g / (m + prior). Here g is the gradient of one view's loss, as a sum over
    pixels. m is the sum over all views and fragments of weight times bilinear weight: the number of pixels that show
    the texel. This is the step of simultaneous algebraic reconstruction (SART), with the loss's gradient for the
    residual. It needs no second moments, and a texel that is hardly seen hardly moves. The texels that show the
    set-aside views best are kept, or the baked ones if none are better.

    It runs on the CPU, because `ops.texel_image` and its gradient have no other kernels. A bake is on the CPU, whatever
    device made it. Photographs and cameras may be on another device: each view is copied when it is traced.

    Args:
        baked: a bake with an atlas; reduced tiles, extents and constants are tuned as they are.
        views: training views, with the corrections that training found; every `held_in_every`-th is set aside.
        background: [3] colour behind the scene.
        options: see `TuneOptions`.
        progress: called after every step.
        eval_views: views of which the gain is stated; they decide nothing.
        coding: how texels are coded, where the surfels are rounded for a compact bundle. The last steps then see what
            the coding makes of the texels, and the codes that show the set-aside views best are kept.

    Returns:
        a new bake, encoded, with `statistics.finetune`; `baked` itself without change where there are fewer than 4
        views.
    """
    options = options or TuneOptions()
    options.check()
    if len(views) < FEWEST_VIEWS:
        return replace(baked, statistics=baked.statistics.but(finetune=FineTuning(steps=0, views=len(views))))
    started, cpu_started = time.perf_counter(), time.process_time()
    scene = TexelScene(baked, background)
    budget = MemoryBudget(options.cache_bytes)
    held_in, tuned = (
        TexelViews(scene, OnDemand(len(rows), lambda i, rows=rows: views[rows[i]]), budget)
        for rows in set_aside(len(views), options.held_in_every)
    )
    looks = _descend(scene, tuned, held_in, options, progress)
    spent = time.perf_counter() - started, time.process_time() - cpu_started
    statistics = looks.statistics(len(tuned), len(held_in), *spent)
    held_out, texels, codes = TexelViews(scene, eval_views, MemoryBudget(0)), looks.best, None
    if baked.codes is not None:
        codes = _coded(scene, tuned, held_in, texels, coding or TexelCodeOptions(), options, progress)
        texels = codes.texels()
    statistics = statistics.but(
        error_before=baked.statistics.error,
        psnr_held_out=gain(held_out.psnr(scene.texels), held_out.psnr(texels)) if eval_views else None,
    )
    result = scene.baked(texels).encoded(progress) if codes is None else baked.with_texel_codes(codes)
    return replace(result, statistics=result.statistics.but(finetune=statistics))


def _descend(
    scene: TexelScene, views: TexelViews, held_in: TexelViews, options: TuneOptions, progress: Progress
) -> Looks[Tensor]:
    """The texels [T, 3] that show the set-aside views best, and the looks at these."""
    looks = Looks(options, held_in.psnr(scene.texels, progress), scene.texels)  # first: these views are kept first
    inverse = 1.0 / (coverage(scene, views, progress) + options.prior)  # [T, 1]
    texels, gradient = scene.texels.clone(), torch.zeros_like(scene.texels)
    for step in range(options.steps):
        view = views[training_order(len(views), options.seed, step)]
        _gradient(scene, view, texels, options.ssim_weight, gradient)
        texels.addcmul_(gradient, inverse, value=-falling(options.rate, step, options.steps))
        progress("tuning texels", step + 1, options.steps)
        if looks.due(step + 1) and not looks.note(step + 1, held_in.psnr(texels), texels.clone):
            progress("tuning texels", step + 1, step + 1)  # no more is to come
            break
    return looks


def _gradient(scene: TexelScene, view: TexelView, texels: Tensor, ssim_weight: float, out: Tensor) -> None:
    """Writes the gradient [T, 3] of a view's loss, as a sum over its numbers."""
    rgb = scene.render(view, texels).requires_grad_()
    photometric(scene.shown(view, rgb), view.target, ssim_weight, view.mask).backward()
    out.zero_()
    # the loss is a mean, the step wants a sum
    scene.add_gradient(view, texels, rgb.grad * numbers(rgb, view.mask), out)


def _coded(
    scene: TexelScene,
    views: TexelViews,
    held_in: TexelViews,
    texels: Tensor,
    coding: TexelCodeOptions,
    options: TuneOptions,
    progress: Progress,
) -> TexelCodes:
    """Codes of texels [T, 3] after steps that see what the coding makes of them: the picture is that of the coded
    texels, and its gradient moves the texels behind them. The codes that show the set-aside views best."""
    inverse = 1.0 / (coverage(scene, views, progress) + options.prior)
    coder = TexelCoder(scene.sizes, coverage(scene, views, progress, squared=True)[:, 0], coding)
    codes = coder.code(texels) if coding.most_bytes is None else coder.fit(texels, coding.most_bytes * TO_START)
    texels = codes.texels()
    looks = Looks(replace(options, steps=max(1, options.coded_steps)), held_in.psnr(texels, progress), codes)
    shift, gradient = torch.zeros_like(texels), torch.zeros_like(texels)
    for step in range(options.coded_steps):
        view = views[training_order(len(views), options.seed, step)]
        _gradient(scene, view, texels + shift, options.ssim_weight, gradient)
        texels.addcmul_(gradient, inverse, value=-falling(options.coded_rate, step, options.coded_steps))
        progress("tuning coded texels", step + 1, options.coded_steps)
        last = step + 1 == options.coded_steps
        if (step + 1) % options.coded_every == 0 or last:
            codes = coder.code(texels, rounds=0)
            shown = codes.texels()
            shift = shown - texels
            if looks.due(step + 1) or last:
                looks.note(step + 1, held_in.psnr(shown), lambda codes=codes: codes)
    best = looks.best
    if coding.most_bytes is not None and best.nbytes() > coding.most_bytes:
        best = coder.fit(best.texels(), coding.most_bytes, rounds=1)
    return best


@torch.no_grad()
def coverage(scene: TexelScene, views: TexelViews, progress: Progress = no_progress, squared: bool = False) -> Tensor:
    """How much of the pictures every texel makes up, in pixels: [T, 1] sum over views and fragments of the blending
    weight, or its square, times the bilinear weight, in pixels that count; 0 where no view sees it."""
    total = torch.zeros_like(scene.texels)
    for index in range(len(views)):
        view = views[index]
        add_texel_coverage(view.fragments, scene.tiles, view.mask, total, squared)
        progress("tracing the training views", index + 1, len(views))
    return total[:, :1]
