"""Fine-tuning of texels alone against the photographs."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from pydantic import NonNegativeInt
from torch import Tensor

from bitymi_ns.bundle.statistics import FineTuning
from bitymi_ns.codec.pages import first_texels, listed_texels
from bitymi_ns.codec.texel_codes import TexelCoder, TexelCodes
from bitymi_ns.progress import Progress, no_progress
from bitymi_ns.ranges import Count, Positive, PositiveCount, Share, check_ranges
from bitymi_ns.train.config import TexelSteps
from bitymi_ns.train.schedules import falling
from bitymi_ns.train.views import MemoryBudget, View, training_order
from .early_stopping import FEWEST_VIEWS, EarlyStopping, gain, validation_split
from .stages import Coded, Reduced, Rounded, encoded_texels
from .tuning_views import TexelList, TuningViews

TO_START = 0.93  # share of the byte limit before the steps with coded texels, in which they grow a little
TO_FILL = 0.99  # share of it that the last steps aim at, where it is to be used up


@dataclass(frozen=True)
class StoredTexels:
    listed: Tensor  # [T, 3] what was coded
    texels: Tensor  # [T, 3] as they are drawn
    stored: Any  # `TexelCodes` of `Cosines`, `EncodedAtlas` of `Pages`


class Cosines:
    """Coder of texels for a compact bundle, within its limit of bytes."""

    def __init__(self, baked: Rounded, weights: Tensor) -> None:
        self._most, self._fill = baked.most_bytes, baked.fill
        self._coder = TexelCoder(baked.sizes, weights, baked.step, baked.alpha_codes)

    def first(self, texels: Tensor) -> StoredTexels:
        if self._most is None:
            return self._coded(texels, self._coder.code(texels))
        if self._fill:
            self._coder.aim(self._coder.code(texels), self._most * TO_START)
        return self._coded(texels, self._coder.fit(texels, self._most * TO_START))

    def again(self, texels: Tensor) -> StoredTexels:
        codes = self._coder.code(texels, rounds=0)
        if self._fill and self._most is not None:
            self._coder.aim(codes, self._most * TO_FILL)
        return self._coded(texels, codes)

    def last(self, best: StoredTexels) -> StoredTexels:
        """Return the best texels, coded again if they exceed the limit."""
        if self._most is None or best.stored.nbytes() <= self._most:
            return best
        return self._coded(best.listed, self._coder.fit(best.texels, self._most, rounds=1))

    def _coded(self, texels: Tensor, codes: TexelCodes) -> StoredTexels:
        return StoredTexels(texels.clone(), codes.texels(self._coder.blocks), codes)


class Pages:
    """Encoder of an atlas, with the range of values of the initial texels."""

    def __init__(self, baked: Reduced) -> None:
        self._baked, self._range = baked, None

    def first(self, texels: Tensor) -> StoredTexels:
        self._range = None
        coded = self.again(texels)
        self._range = coded.stored.range
        return coded

    def again(self, texels: Tensor) -> StoredTexels:
        baked, packing = self._baked, self._baked.packing
        atlas = encoded_texels(baked.with_alpha(texels), packing, baked.options, value_range=self._range)
        constants = texels[first_texels(baked.sizes)]
        drawn = listed_texels(torch.from_numpy(atlas.decoded()[..., :3]), packing, constants)
        return StoredTexels(texels.clone(), drawn, atlas)

    def last(self, best: StoredTexels) -> StoredTexels:
        return best


@dataclass
class TuneOptions(TexelSteps):
    """Options of the fine-tuning."""

    rate: Positive = TexelSteps.rate
    steps: Count = 400  # Steps before the texels are coded, of a training view each.
    ssim_weight: Share = 0.2
    val_every: Count = 8
    """Spacing of the validation views, which choose the texels to keep. 0: none; the last texels are kept."""
    checks: PositiveCount = 16  # Evaluations of the validation views over the run.
    patience: PositiveCount = 6  # Evaluations without a gain after which the run ends.
    cache_bytes: NonNegativeInt = 1_000_000_000
    """Memory for traced views, first of validation, which are drawn most often; others are traced at every use."""
    seed: int = 0  # Seed of the order of the views.
    coded_steps: Count = 120  # Further steps, which draw the texels as stored.
    coded_every: PositiveCount = 10  # Steps between codings of the texels.
    coded_rate: float = 0.02  # First rate of these steps.

    @classmethod
    def of_learned(cls, steps: int, cache_bytes: int = cache_bytes) -> TuneOptions:
        """Make options for trained texels: all views train, and all steps draw the texels as stored, at twice the rate
        for half the steps."""
        return cls(steps=0, coded_steps=steps, coded_rate=2 * cls.rate, val_every=0, cache_bytes=cache_bytes)

    def check(self) -> None:
        """Raise ValueError for an option out of range."""
        check_ranges(self)
        if self.val_every == 1:
            raise ValueError("val_every must not be 1: no view would be left to learn from")


def tune_atlas(
    baked: Reduced | Rounded,
    views: Sequence[View],
    background: Tensor,
    options: TuneOptions | None = None,
    progress: Progress = no_progress,
    eval_views: Sequence[View] = (),
) -> Coded:
    """Fine-tune the texels of a bake against its training photographs (`losses.photometric`).

    A step moves texel t by t <- t - rate g / (m + prior), with the gradient g of one view's loss, summed over pixels,
    and the texel's coverage m over all views. This is the step of simultaneous algebraic reconstruction (SART), with
    the loss's gradient for the residual: a texel that is hardly seen hardly moves.

    Args:
        baked: with tiles; constants of surfels without one are tuned, too.
        views: training views, with the corrections of training, on any device.
        background: [3].
        eval_views: held-out views on which the gain is measured.

    Returns the bake with coded texels, which stay as they are with fewer than `FEWEST_VIEWS` views (without validation,
    none), and `statistics.finetune`."""
    options = options or TuneOptions()
    options.check()
    if len(views) < (FEWEST_VIEWS if options.val_every else 1):
        return baked.encoded(progress).stating(finetune=FineTuning(steps=0, views=len(views)))
    started, cpu_started = time.perf_counter(), time.process_time()
    texels = TexelList(baked)
    budget = MemoryBudget(options.cache_bytes)
    held_back, trained = validation_split(views, options.val_every)
    validation, tuned = (TuningViews(texels, part, background, budget) for part in (held_back, trained))
    before = validation.psnr(texels.values, progress)  # first, to fill the cache
    stopping = EarlyStopping(options.steps, options.checks, options.patience, before, texels.values)
    if isinstance(baked, Rounded):
        covered = baked.coverage.to(baked.device)
        coder = Cosines(baked, baked.coverage[:, 1])
    else:
        covered = texels.coverage(trained, progress)
        coder = Pages(baked)
    step_size = 1.0 / (covered[:, 0] + options.prior)  # [T]
    moved = texels.values.clone()
    for step in range(options.steps):
        view = training_order(len(tuned), options.seed, step)
        rate = falling(options.rate, step, options.steps)
        tuned.step(view, moved, step_size, rate, options.ssim_weight)
        progress("tuning texels", step + 1, options.steps)
        if stopping.due(step + 1) and not stopping.update(step + 1, validation.psnr(moved), moved.clone):
            progress("tuning texels", step + 1, step + 1)  # completes the bar
            break
    held_out = TuningViews(texels, eval_views, background, MemoryBudget(0))
    untuned = held_out.psnr(coder.first(texels.values.cpu()).texels) if eval_views else None
    coded = _coded(tuned, validation, step_size, stopping.best, coder, options, progress)
    spent = time.perf_counter() - started, time.process_time() - cpu_started
    statistics = stopping.statistics(len(tuned), len(validation), *spent).replace(
        steps=stopping.done + options.coded_steps,
        steps_asked=options.steps + options.coded_steps,
        psnr_held_out=None if untuned is None else gain(untuned, held_out.psnr(coded.texels)),
    )
    return baked.coded(coded.stored, coded.listed).stating(finetune=statistics)


def _coded(
    views: TuningViews,
    validation: TuningViews,
    step_size: Tensor,
    texels: Tensor,
    coding: Cosines | Pages,
    options: TuneOptions,
    progress: Progress,
) -> StoredTexels:
    """Optimise texels [T, 3] through their coding: the gradient of the image of the stored texels moves the uncoded."""
    coded = coding.first(texels.cpu())
    texels = coded.texels.to(texels.device, copy=True)
    psnr = validation.psnr(texels, progress)
    stopping = EarlyStopping(max(1, options.coded_steps), options.checks, options.patience, psnr, coded)
    shift = torch.zeros_like(texels)
    for step in range(options.coded_steps):
        view = training_order(len(views), options.seed, step)
        rate = falling(options.coded_rate, step, options.coded_steps)
        views.step(view, texels, step_size, rate, options.ssim_weight, texels + shift)
        progress("tuning texels as they are stored", step + 1, options.coded_steps)
        last = step + 1 == options.coded_steps
        if (step + 1) % options.coded_every == 0 or last:
            coded = coding.again(texels.cpu())
            shown = coded.texels.to(texels.device)
            shift = shown - texels
            if stopping.due(step + 1) or last:
                stopping.update(step + 1, validation.psnr(shown), lambda coded=coded: coded)
    return coding.last(stopping.best)
