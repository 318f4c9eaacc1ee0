"""Fine-tuning of an atlas against the photographs: texels alone; geometry, opacity and view colours stand still."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from bitymi_ns.bake.baked import Baked
from bitymi_ns.bake.codings import C, Coding, Cosines, CosineTexels, Pages, PageTexels
from bitymi_ns.bake.early_stopping import FEWEST_VIEWS, Looks, gain, set_aside
from bitymi_ns.bake.texel_scene import TexelScene, TexelView, TexelViews
from bitymi_ns.bundle.statistics import FineTuning
from bitymi_ns.codec.texel_codes import TexelCodeOptions, TexelCoder
from bitymi_ns.progress import Progress, no_progress
from bitymi_ns.train.config import TexelSteps
from bitymi_ns.train.losses import numbers, photometric
from bitymi_ns.train.schedules import falling
from bitymi_ns.train.views import MemoryBudget, OnDemand, View, training_order


@dataclass
class TuneOptions(TexelSteps):
    """How an atlas is fine-tuned."""

    steps: int = 400
    """Steps, before the texels are stored; each looks at one training view."""
    ssim_weight: float = 0.2
    """Share of 1 - SSIM in the loss; the rest is L1."""
    held_in_every: int = 8
    """Every so-many-th training view is set aside; the texels kept are those that show these best. 0 = none is, and the
    last texels are kept: where they have learned from all views already, these tell nothing."""
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
    """Further steps, which see what is stored of the texels: blocks of BC7, say, or the codes of a compact bundle."""
    coded_every: int = 10
    """After so many steps it is looked what is stored of them."""
    coded_rate: float = 0.02
    """Their rate at the start."""

    @classmethod
    def of_learned(cls, steps: int, cache_bytes: int = cache_bytes) -> TuneOptions:
        """For texels that have learned in training, from all views: these go on teaching them, and all steps see what
        is stored. With half of the rate it takes twice the steps."""
        return cls(steps=0, coded_steps=steps, coded_rate=2 * cls.rate, held_in_every=0, cache_bytes=cache_bytes)

    def check(self) -> None:
        """Refuses values that make no sense."""
        least_of = {"steps": 0, "held_in_every": 0, "checks": 1, "patience": 1, "cache_bytes": 0}
        for name, least in {**least_of, "coded_steps": 0, "coded_every": 1}.items():
            if getattr(self, name) < least:
                raise ValueError(f"{name} of the fine-tuning must be at least {least}, not {getattr(self, name)}")
        if self.held_in_every == 1:
            raise ValueError("held_in_every of the fine-tuning must not be 1: no view would be left to learn from")
        if not self.rate > 0 or not self.prior > 0 or not 0 <= self.ssim_weight <= 1:
            raise ValueError("rate and prior of the fine-tuning must be positive, the SSIM weight between 0 and 1")


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
        eval_views: views of which the gain is stated, of what is stored; they decide nothing.
        coding: how texels are coded, where the surfels are rounded for a compact bundle. The last steps then see what
            the coding makes of the texels, and the codes that show the set-aside views best are kept.

    Returns:
        a new bake, encoded, with `statistics.finetune`; `baked` itself without change where there are fewer than 4
        views.
    """
    options = options or TuneOptions()
    options.check()
    if len(views) < (FEWEST_VIEWS if options.held_in_every else 1):
        return replace(baked, statistics=baked.statistics.but(finetune=FineTuning(steps=0, views=len(views))))
    started, cpu_started = time.perf_counter(), time.process_time()
    scene = TexelScene(baked, background)
    budget = MemoryBudget(options.cache_bytes)
    aside, learned = (
        OnDemand(len(rows), lambda i, rows=rows: views[rows[i]])
        for rows in set_aside(len(views), options.held_in_every)
    )
    held_in, tuned = (TexelViews(scene, part, budget) for part in (aside, learned))
    before = held_in.psnr(scene.texels, progress)  # first: these views are kept first
    looks = Looks(options, before, scene.texels)
    squares = None if baked.codes is None else torch.zeros_like(scene.texels)
    covered = torch.zeros_like(scene.texels)
    scene.add_coverage(learned, covered, squares, progress)
    share = 1.0 / (covered[:, :1] + options.prior)  # [T, 1]
    _descend(scene, tuned, held_in, share, looks, options, progress)
    held_out = TexelViews(scene, eval_views, MemoryBudget(0))
    coder = _coding(baked, scene, squares, coding or TexelCodeOptions())
    untuned = held_out.psnr(coder.first(scene.texels).texels()) if eval_views else None
    coded = _coded(scene, tuned, held_in, share, looks.best, coder, options, progress)
    spent = time.perf_counter() - started, time.process_time() - cpu_started
    statistics = looks.statistics(len(tuned), len(held_in), *spent).but(
        steps=looks.done + options.coded_steps,
        steps_asked=options.steps + options.coded_steps,
        error_before=baked.statistics.error,
        psnr_held_out=None if untuned is None else gain(untuned, held_out.psnr(coded.texels())),
    )
    if isinstance(coded, CosineTexels):
        result = baked.with_texel_codes(coded.codes, coded.listed)
    else:
        result = scene.baked(coded.listed).with_atlas(coded.atlas)
    return replace(result, statistics=result.statistics.but(finetune=statistics))


def _coding(
    baked: Baked, scene: TexelScene, squares: Tensor | None, options: TexelCodeOptions
) -> Coding[CosineTexels] | Coding[PageTexels]:
    """How the texels are stored: by their squared coverage [T, 3], or as blocks where there is none."""
    if squares is not None:
        return Cosines(TexelCoder(scene.sizes, squares[:, 0], options), options)
    return Pages(baked, scene.tiles)


def _descend(
    scene: TexelScene,
    views: TexelViews,
    held_in: TexelViews,
    share: Tensor,
    looks: Looks[Tensor],
    options: TuneOptions,
    progress: Progress,
) -> None:
    """Moves texels by their shares [T, 1], and looks at what that brings."""
    texels, gradient = scene.texels.clone(), torch.zeros_like(scene.texels)
    for step in range(options.steps):
        view = views[training_order(len(views), options.seed, step)]
        _gradient(scene, view, texels, options.ssim_weight, gradient)
        texels.addcmul_(gradient, share, value=-falling(options.rate, step, options.steps))
        progress("tuning texels", step + 1, options.steps)
        if looks.due(step + 1) and not looks.note(step + 1, held_in.psnr(texels), texels.clone):
            progress("tuning texels", step + 1, step + 1)  # no more is to come
            break


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
    share: Tensor,
    texels: Tensor,
    coding: Coding[C],
    options: TuneOptions,
    progress: Progress,
) -> C:
    """What is stored of texels [T, 3] after steps that see it: the picture is that of the stored texels, and its
    gradient moves the texels behind them. What shows the set-aside views best."""
    coded = coding.first(texels)
    texels = coded.texels().clone()
    looks = Looks(replace(options, steps=max(1, options.coded_steps)), held_in.psnr(texels, progress), coded)
    shift, gradient = torch.zeros_like(texels), torch.zeros_like(texels)
    for step in range(options.coded_steps):
        view = views[training_order(len(views), options.seed, step)]
        _gradient(scene, view, texels + shift, options.ssim_weight, gradient)
        texels.addcmul_(gradient, share, value=-falling(options.coded_rate, step, options.coded_steps))
        progress("tuning texels as they are stored", step + 1, options.coded_steps)
        last = step + 1 == options.coded_steps
        if (step + 1) % options.coded_every == 0 or last:
            coded = coding.again(texels)
            shown = coded.texels()
            shift = shown - texels
            if looks.due(step + 1) or last:
                looks.note(step + 1, held_in.psnr(shown), lambda coded=coded: coded)
    return coding.last(looks.best)
