"""Polish of a bake: texels, geometry, opacities and view colours are optimised together, without the network."""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from bitymi_ns.bake.early_stopping import FEWEST_VIEWS, EarlyStopping, evaluate, gain, validation_split
from bitymi_ns.bake.state import BakeState
from bitymi_ns.bake.tune import TuneOptions
from bitymi_ns.bake.tuning_views import TexelList
from bitymi_ns.bundle.statistics import FineTuning
from bitymi_ns.ops import TexelDescent
from bitymi_ns.progress import Progress, no_progress
from bitymi_ns.ranges import Positive, PositiveCount
from bitymi_ns.scene.config import SceneConfig
from bitymi_ns.scene.field import TexelField
from bitymi_ns.scene.scene import Scene
from bitymi_ns.train.config import TrainConfig
from bitymi_ns.train.init import scene_extent
from bitymi_ns.train.losses import numbers, photometric
from bitymi_ns.train.optimizers import forget_gradients, set_rate, step, surfel_optimizers
from bitymi_ns.train.schedules import Schedule, falling
from bitymi_ns.train.views import View, background_changes, step_background, training_order

MEANS = (1.6e-4, 1.6e-6)
"""Rates of the positions in shares of the extent, as polishing was measured with: steps in pixels have not been."""


@dataclass
class PolishOptions(TuneOptions):
    """Options of the polish: `rate` and `prior` are of the texels."""

    steps: PositiveCount = 300
    share: Positive = 0.4
    """Rates of the surfels, as a share of those of a training run of as many steps; they fall to 0 as a cosine."""
    checks: PositiveCount = 10
    pixels_per_texel: Positive = 0.25
    """A tile starts with at most one texel per this number of pixels in the view that shows most of its surfel."""


class _Polish:
    """One polish, step by step."""

    def __init__(
        self,
        baked: BakeState,
        views: Sequence[View],
        background: Tensor,
        options: PolishOptions,
        train: TrainConfig,
        device: torch.device | str,
    ) -> None:
        self.texels, self.device = TexelList(baked, device), device
        drawn = self.texels.scene
        config = SceneConfig(
            view_color=drawn.view_color,  # type: ignore[arg-type]
            weight_bound=drawn.weight_bound,
            prefilter=drawn.prefilter,  # type: ignore[arg-type]
        )
        tiles = self.texels.tiles
        self.field = TexelField(tiles.size, tiles.extent, self.texels.values)
        self.scene = Scene(config, drawn.surfels, self.field, near=drawn.near)
        self.options, self.background = options, background.to(device)
        centers = torch.stack([view.camera.center.to(device) for view in views])
        extent = scene_extent(centers, drawn.surfels["means"])
        rates = replace(train.lr, means=MEANS).times(options.share)
        self.schedule = Schedule(replace(train, lr=rates), options.steps, extent)
        self.optimizers = surfel_optimizers(self.scene)
        self.train, self.factor = train, 1.0

    def shown(self, view: View, background: Tensor | None) -> Tensor:
        """Draw a view with the exposure of its photograph over a colour [3]: [H, W, 3]."""
        output = self.scene.render(view.camera, background)
        return view.shown(output.rgb, output.alpha, background)

    @torch.no_grad()
    def psnr(self, views: Sequence[View], progress: Progress = no_progress) -> float:
        """Average the PSNR, dB, over views with an unmasked pixel."""
        pictures = (
            (self.shown(view, self.background), view.target(self.background, self.device), view.mask)
            for view in (view.to(self.device) for view in views)
        )
        return evaluate(pictures, len(views), progress)

    def step(self, number: int, view: View, share: Tensor) -> bool:
        """Step on one view; returns False, without a step, if it is not finite."""
        options, view = self.options, view.to(self.device)
        for name, optimizer in self.optimizers.items():
            set_rate(optimizer, self.factor * falling(self.schedule.lr(name, 0), number, options.steps))
        forget_gradients(self.optimizers.values())
        background = self.background
        if background_changes(self.train, view):
            background = step_background(self.train, view, number, self.device)
        mask, target = view.mask, view.target(background, self.device)
        # the loss is a mean, the step wants a sum
        rate = self.factor * falling(options.rate, number, options.steps) * numbers(target, mask)
        self.field.descent = TexelDescent(share, rate)
        loss = photometric(self.shown(view, background), target, options.ssim_weight, mask)
        if not math.isfinite(float(loss.detach())):
            return False
        if not loss.requires_grad:  # nothing of the scene is in the view
            return True
        loss.backward()
        step(self.optimizers, {})
        return True

    def state(self) -> dict[str, Any]:
        """Copy the parameters."""
        return {name: value.detach().clone() for name, value in self.scene.state_dict().items()}

    def go_back(self, state: dict[str, Any]) -> None:
        """Restore an earlier state, with slower steps from here on."""
        self.scene.load_state_dict(state)
        self.optimizers = surfel_optimizers(self.scene)
        self.factor *= self.train.guard.rates


def polish_scene(
    baked: BakeState,
    views: Sequence[View],
    background: Tensor,
    options: PolishOptions | None = None,
    train: TrainConfig | None = None,
    progress: Progress = no_progress,
    eval_views: Sequence[View] = (),
    device: torch.device | str = "cpu",
) -> BakeState:
    """Optimise texels and surfels of a bake together against its training photographs, 0.8 L1 + 0.2 (1 - SSIM).

    Surfels move by Adam, texels as in `tune_atlas`, with the coverage of the bake. Surfels keep their tiles with their
    extents and sizes: a fragment beyond its tile reads the edge, while it learns and when it is drawn. Nothing is
    densified. The state kept is the one that shows the validation views best, the bake itself where none is better. A
    step that is not finite takes the scene back to that state, with smaller rates.

    Args:
        baked: a bake with texels and all of its view colours, made with `pixels_per_texel`.
        views: training views, with the corrections that training found; every `val_every`-th is for validation.
        background: [3] colour behind the scene, but for steps on views behind which it changes (`train.background`).
        train: options of the training, for the learning rates, the colours behind the scene, and for what is done when
            a step is not finite.
        eval_views: views of which the gain is stated; they decide nothing.

    Returns:
        a new bake with `statistics.polish`, to be `reduced`; `baked` itself without change where there are fewer than 4
        views.

    Raises:
        ValueError: there is no atlas, the view colours are reduced, or an option is out of range.
    """
    options = options or PolishOptions()
    options.check()
    if "view_terms" in baked.scene.surfels:
        raise ValueError("the view colours are reduced already: polish a bake that was made with pixels_per_texel")
    if len(views) < FEWEST_VIEWS:
        return replace(baked, statistics=baked.statistics.replace(polish=FineTuning(steps=0, views=len(views))))
    started, cpu_started = time.perf_counter(), time.process_time()
    validation, trained = validation_split(views, options.val_every)
    run = _Polish(baked, views, background, options, train or TrainConfig(), device)
    before = run.psnr(eval_views) if eval_views else math.nan
    stopping = _optimise(run, trained, validation, progress)
    run.scene.load_state_dict(stopping.best)
    spent = time.perf_counter() - started, time.process_time() - cpu_started
    statistics = stopping.statistics(len(trained), len(validation), *spent).replace(
        psnr_held_out=gain(before, run.psnr(eval_views)) if eval_views else None
    )
    texels = run.field.texels.detach()
    result = baked.with_texels(texels).with_surfels(dict(run.scene.surfels))
    return replace(result, statistics=result.statistics.replace(polish=statistics))


def _optimise(
    run: _Polish, views: Sequence[View], validation: Sequence[View], progress: Progress
) -> EarlyStopping[dict[str, Any]]:
    """Find the state that shows the validation views best; also returns the evaluations."""
    options = run.options
    before = run.psnr(validation, progress)
    stopping = EarlyStopping(options.steps, options.checks, options.patience, before, run.state())
    share, attempts = 1.0 / (run.texels.coverage(views, progress)[:, 0] + options.prior), 0  # [T]
    for number in range(options.steps):
        view = views[training_order(len(views), options.seed, number)]
        if not run.step(number, view, share):
            attempts += 1
            run.go_back(stopping.best)
        more = attempts < run.train.guard.rollbacks
        if not more or stopping.due(number + 1):
            more = stopping.update(number + 1, run.psnr(validation), run.state) and more
        progress("polishing", number + 1, options.steps if more else number + 1)
        if not more:
            break
    return stopping
