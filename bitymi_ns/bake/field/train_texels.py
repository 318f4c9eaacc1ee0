"""Polish of a bake: a training run of texels and surfels, without network and densification."""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from bitymi_ns.bundle.statistics import FineTuning
from bitymi_ns.ops.view_kinds import kind_of
from bitymi_ns.progress import Progress, no_progress
from bitymi_ns.ranges import Positive, PositiveCount
from bitymi_ns.scene.config import SceneConfig
from bitymi_ns.scene.field import TexelField
from bitymi_ns.scene.scene import Scene
from bitymi_ns.train.config import DensifyConfig, GuardConfig, LossConfig, TexelConfig, TrainConfig
from bitymi_ns.train.divergence import TrainingDiverged
from bitymi_ns.train.fit import Trainer
from bitymi_ns.train.views import View
from ..early_stopping import FEWEST_VIEWS, EarlyStopping, evaluate, gain, validation_split
from ..stages import Trained
from ..tune import TuneOptions
from ..tuning_views import TexelList

MEANS = (1.6e-4, 1.6e-6)
"""First and last learning rates of positions, in scene extents."""


@dataclass
class PolishOptions(TuneOptions):
    """Options of the polish; `rate` and `prior` are of the texels."""

    steps: PositiveCount = 300
    share: Positive = 0.4
    """Rates of the surfels, as a share of those of a training run of as many steps; cosine decay to 0."""
    checks: PositiveCount = 10
    pixels_per_texel: Positive = 0.25
    """Least number of pixels per texel, in the view that shows most of the surfel."""


def _polish_run(
    baked: Trained,
    views: Sequence[View],
    background: Tensor,
    options: PolishOptions,
    train: TrainConfig,
    progress: Progress,
) -> Trainer:
    """Set up a training run of the texel stage alone that keeps the number of surfels."""
    texels = TexelList(baked)
    drawn, tiles = texels.scene, texels.tiles
    step_size = 1.0 / (texels.coverage(views, progress)[:, 0] + options.prior)
    config = SceneConfig(texture="texels", view_color=kind_of(drawn.surfels), weight_bound=drawn.weight_bound)
    field = TexelField(tiles.size, tiles.extent, texels.values, step_size)
    scene = Scene(config, drawn.surfels, field, near=drawn.near)
    train = replace(
        train,
        loss=LossConfig(ssim_weight=options.ssim_weight, falloff_weight=0.0, depth_weight=0.0, normal_weight=0.0),
        densify=DensifyConfig(final_prune_steps=()),
        lr=replace(train.lr, means=MEANS),
        guard=GuardConfig(rollbacks=0),  # the guard may drop surfels; here the best state is restored
        texels=TexelConfig(start=0, rate=options.rate, travel=0.0, surfel_rates=options.share),
        num_downscales=0,
        dropout=0.0,
        exposure="off",
        refine_poses="off",
        seed=options.seed,
    )
    run = Trainer(scene, views, train, options.steps)
    run.training.background = background
    return run


@torch.no_grad()
def _psnr(run: Trainer, background: Tensor, views: Sequence[View], progress: Progress = no_progress) -> float:
    moved = (view.to(background.device) for view in views)
    drawn = ((view, run.scene.render(view.camera, background)) for view in moved)
    pictures = (
        (view.shown(output.rgb, output.alpha, background), view.target(background, background.device), view.mask)
        for view, output in drawn
    )
    return evaluate(pictures, len(views), progress)


def polish_scene(
    baked: Trained,
    views: Sequence[View],
    background: Tensor,
    options: PolishOptions | None = None,
    train: TrainConfig | None = None,
    progress: Progress = no_progress,
    eval_views: Sequence[View] = (),
) -> Trained:
    """Optimise texels and surfels of a bake together against its training photographs (`losses.photometric`).

    Surfels move by Adam, texels as in `tune_atlas`, with the coverage of the bake. Tiles keep their sizes: a fragment
    beyond its tile reads the edge. The state that shows the validation views best is kept, the bake itself included. A
    step that is not finite takes the scene back to that state, with smaller rates.

    Args:
        baked: with texels and whole view colours.
        views: training views, with the corrections of training.
        background: [3], except in steps where `train.background` changes it.
        eval_views: views of which the gain is stated.

    Returns the bake with `statistics.polish`; with fewer than `FEWEST_VIEWS` views it has 0 steps. Raises ValueError:
    there is no atlas, view colours are reduced, or an option is out of range."""
    options = options or PolishOptions()
    options.check()
    if len(views) < FEWEST_VIEWS:
        return baked.stating(polish=FineTuning(steps=0, views=len(views)))
    started, cpu_started = time.perf_counter(), time.process_time()
    validation, trained = validation_split(views, options.val_every)
    train = train or TrainConfig()
    background = background.to(baked.device)
    run = _polish_run(baked, trained, background, options, train, progress)
    before = _psnr(run, background, eval_views) if eval_views else math.nan
    stopping = _optimise(run, background, validation, options, train.guard, progress)
    run.scene.load_state_dict(stopping.best)
    spent = time.perf_counter() - started, time.process_time() - cpu_started
    statistics = stopping.statistics(len(trained), len(validation), *spent).replace(
        psnr_held_out=gain(before, _psnr(run, background, eval_views)) if eval_views else None
    )
    result = baked.with_colors(stopping.best["field.texels"]).with_surfels(dict(run.scene.surfels))
    return result.stating(polish=statistics)


def _optimise(
    run: Trainer,
    background: Tensor,
    validation: Sequence[View],
    options: PolishOptions,
    guard: GuardConfig,
    progress: Progress,
) -> EarlyStopping[dict[str, Tensor]]:
    """Train; return the best state and the evaluations."""

    def state() -> dict[str, Tensor]:
        return {name: value.detach().clone() for name, value in run.scene.state_dict().items()}

    before, failures = _psnr(run, background, validation, progress), 0
    stopping = EarlyStopping(options.steps, options.checks, options.patience, before, state())
    for number in range(options.steps):
        run.step, due = number, stopping.due(number + 1)
        try:
            run.advance()
            if due:
                run.training.watch.finish(run.scene)
        except TrainingDiverged:
            run.scene.load_state_dict(stopping.best)
            for optimizer in run.optimizers.values():
                optimizer.state.clear()
            run.training.guard.factor *= guard.rates
            failures += 1
        more = failures < guard.rollbacks
        if not more or due:
            more = stopping.update(number + 1, _psnr(run, background, validation), state) and more
        progress("polishing", number + 1, options.steps if more else number + 1)
        if not more:
            break
    return stopping
