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
from bitymi_ns.bake.texel_list import TexelList
from bitymi_ns.bake.tuning_views import TuningViews
from bitymi_ns.bundle.statistics import FineTuning
from bitymi_ns.codec.texel_codes import TexelCodeOptions, TexelCoder
from bitymi_ns.progress import Progress, no_progress
from bitymi_ns.train.config import TexelSteps
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
    device: torch.device | str = "cpu",
) -> Baked:
    """Fine-tunes the texels of a bake against its training photographs, 0.8 L1 + 0.2 (1 - SSIM).

    A step moves texel t by t <- t - rate g / (m + prior). Here g is the gradient of one view's loss, as a sum over
    pixels. m is the sum over all views and fragments of weight times bilinear weight: the number of pixels that show
    the texel. This is the step of simultaneous algebraic reconstruction (SART), with the loss's gradient for the
    residual. It needs no second moments, and a texel that is hardly seen hardly moves. The texels that show the
    set-aside views best are kept, or the baked ones if none are better.

    Args:
        baked: a bake with an atlas; reduced tiles, extents and constants are tuned as they are.
        views: training views, with the corrections that training found; every `held_in_every`-th is set aside.
        background: [3] colour behind the scene.
        options: see `TuneOptions`.
        progress: called after every step.
        eval_views: views of which the gain is stated, of what is stored; they decide nothing.
        coding: how texels are coded, where the surfels are rounded for a compact bundle. The last steps then see what
            the coding makes of the texels, and the codes that show the set-aside views best are kept.
        device: where the texels learn. Photographs and cameras may be on another one: each view is copied when it is
            traced.

    Returns:
        a new bake, encoded, with `statistics.finetune`; `baked` itself without change where there are fewer than 4
        views.
    """
    options = options or TuneOptions()
    options.check()
    if len(views) < (FEWEST_VIEWS if options.held_in_every else 1):
        return replace(baked, statistics=baked.statistics.but(finetune=FineTuning(steps=0, views=len(views))))
    started, cpu_started = time.perf_counter(), time.process_time()
    texels = TexelList(baked, device)
    budget = MemoryBudget(options.cache_bytes)
    aside, learned = (
        OnDemand(len(rows), lambda i, rows=rows: views[rows[i]])
        for rows in set_aside(len(views), options.held_in_every)
    )
    held_in, tuned = (TuningViews(texels, part, background, budget) for part in (aside, learned))
    before = held_in.psnr(texels.values, progress)  # first: these views are kept first
    looks = Looks(options, before, texels.values)
    squares = None if baked.codes is None else torch.zeros_like(texels.values)
    covered = torch.zeros_like(texels.values)
    texels.add_coverage(learned, covered, squares, progress)
    share = 1.0 / (covered[:, 0] + options.prior)  # [T]
    _descend(texels.values.clone(), tuned, held_in, share, looks, options, progress)
    held_out = TuningViews(texels, eval_views, background, MemoryBudget(0))
    coder = _coding(baked, texels, squares, coding or TexelCodeOptions())
    untuned = held_out.psnr(coder.first(texels.values.cpu()).texels()) if eval_views else None
    coded = _coded(tuned, held_in, share, looks.best, coder, options, progress)
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
        result = texels.baked(coded.listed).with_atlas(coded.atlas)
    return replace(result, statistics=result.statistics.but(finetune=statistics))


def _coding(
    baked: Baked, texels: TexelList, squares: Tensor | None, options: TexelCodeOptions
) -> Coding[CosineTexels] | Coding[PageTexels]:
    """How the texels are stored: by their squared coverage [T, 3], or as blocks where there is none."""
    if squares is not None:
        return Cosines(TexelCoder(texels.sizes, squares[:, 0].cpu(), options), options)
    return Pages(baked, texels.tiles.first.cpu())


def _descend(
    texels: Tensor,
    views: TuningViews,
    held_in: TuningViews,
    share: Tensor,
    looks: Looks[Tensor],
    options: TuneOptions,
    progress: Progress,
) -> None:
    """Moves texels [T, 3] by their shares [T], and looks at what that brings."""
    for step in range(options.steps):
        rate = falling(options.rate, step, options.steps)
        views.step(training_order(len(views), options.seed, step), texels, share, rate, options.ssim_weight)
        progress("tuning texels", step + 1, options.steps)
        if looks.due(step + 1) and not looks.note(step + 1, held_in.psnr(texels), texels.clone):
            progress("tuning texels", step + 1, step + 1)  # no more is to come
            break


def _coded(
    views: TuningViews,
    held_in: TuningViews,
    share: Tensor,
    texels: Tensor,
    coding: Coding[C],
    options: TuneOptions,
    progress: Progress,
) -> C:
    """What is stored of texels [T, 3] after steps that see it: the picture is that of the stored texels, and its
    gradient moves the texels behind them. What shows the set-aside views best."""
    coded = coding.first(texels.cpu())
    texels = coded.texels().to(texels.device, copy=True)
    looks = Looks(replace(options, steps=max(1, options.coded_steps)), held_in.psnr(texels, progress), coded)
    shift = torch.zeros_like(texels)
    for step in range(options.coded_steps):
        rate, view = (
            falling(options.coded_rate, step, options.coded_steps),
            training_order(len(views), options.seed, step),
        )
        views.step(view, texels, share, rate, options.ssim_weight, texels + shift)
        progress("tuning texels as they are stored", step + 1, options.coded_steps)
        last = step + 1 == options.coded_steps
        if (step + 1) % options.coded_every == 0 or last:
            coded = coding.again(texels.cpu())
            shown = coded.texels().to(texels.device)
            shift = shown - texels
            if looks.due(step + 1) or last:
                looks.note(step + 1, held_in.psnr(shown), lambda coded=coded: coded)
    return coding.last(looks.best)
