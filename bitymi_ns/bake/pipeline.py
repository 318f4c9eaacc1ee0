"""From a trained scene and its photographs to a bundle, stage by stage."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from bitymi_ns.bundle.bake_options import BakeOptions
from bitymi_ns.codec.pages import joined
from bitymi_ns.ops.view_kinds import kind_of
from bitymi_ns.progress import Progress, no_progress
from bitymi_ns.scene.baked import BakedScene
from bitymi_ns.scene.camera import Camera
from bitymi_ns.scene.field import TexelField
from bitymi_ns.train.config import TrainConfig
from bitymi_ns.train.views import View
from bitymi_ns.trust import listed
from .compact import Compact, compacted
from .field.tiles import field_tiles
from .field.train_texels import PolishOptions, polish_scene
from .prune import drawable, prune_and_resample
from .stages import BakeableScene, Coded, Trained, laid_out
from .tile_errors import certified
from .tiles import Tiles
from .tune import TuneOptions, tune_atlas


@torch.no_grad()
def trained_texels(scene: BakeableScene, options: BakeOptions) -> Trained:
    """Take drawable surfels with all view colours and trained tiles, if any, from a scene. Raises ValueError: no surfel
    is left, or the atlas would be too large."""
    rows, left_out = drawable(scene.surfels)
    trained = len(scene.surfels["means"])
    if len(rows) == 0:
        raise ValueError(f"no surfel is left to bake of {trained}: left out {dict(left_out)}")
    surfels = {name: value.detach()[rows].float().cpu() for name, value in scene.surfels.items()}
    device, rows, count = rows.device, rows.cpu(), len(rows)
    if isinstance(scene.field, TexelField):
        field = copy.deepcopy(scene.field).cpu()
        field.keep(rows)
        bare = field.size.long().prod(1) == 1  # their one texel is their constant
        texels = joined(field.texels.detach().float(), None if field.alpha is None else field.alpha.detach().float())
        tiles = Tiles(torch.where(bare[:, None], 0, field.size), field.extent.float(), texels)
    else:
        none = torch.zeros(count, 2, dtype=torch.int32)
        tiles = Tiles(none, torch.full((count,), options.extent), torch.zeros(count, 3))
    drawn = {"near": scene.near, "weight_bound": scene.config.weight_bound}
    baked = BakedScene(surfels, kind_of(scene.surfels), torch.zeros(0, 5, dtype=torch.int32), **drawn)
    own = {"rows": rows, "device": device, "trained": trained, "left_out": left_out, "options": options}
    stage = Trained(**own, **laid_out(baked, tiles, options), texel_counts={})
    learned = isinstance(scene.field, TexelField)
    return replace(stage, texel_counts={"learned": stage.packing.texels}) if learned else stage


FEWEST_PASSES = 4  # steps of polish or fine-tuning per photograph below which more may gain
STEPS_AFTER_LEARNING = 100  # fine-tuning steps of trained texels, which recover what the reduction cost


@dataclass(frozen=True)
class RefineOptions:
    """Optimisation after the training."""

    polish: PolishOptions | None = None  # of texels and surfels together; None = none
    tune: TuneOptions | None = None  # of texels alone, after that; None = none
    # options of the training, for the rates of the polish
    train: TrainConfig = dataclasses.field(default_factory=TrainConfig)
    compact: Compact | None = None  # rounding for a compact bundle, before the texels are tuned alone; None = none

    @classmethod
    def for_scene(
        cls,
        scene: BakeableScene,
        views: int,
        polish_steps: int | None = None,
        tune_steps: int | None = None,
        cache_bytes: int = TuneOptions.cache_bytes,
        train: TrainConfig | None = None,
        compact: Compact | None = None,
    ) -> RefineOptions:
        """Choose the steps by the kind of texture.

        `polish_steps`: 0 = none; None = none for trained texels; for a field 300, or `FEWEST_PASSES` per photograph if
        more. `tune_steps`: 0 = none; None = `STEPS_AFTER_LEARNING`, or 400 where a field is not polished."""
        train = TrainConfig() if train is None else train
        if scene.field is None:
            return cls(train=train, compact=compact)
        trained = isinstance(scene.field, TexelField)
        if polish_steps is None:
            polish_steps = 0 if trained else max(PolishOptions.steps, FEWEST_PASSES * views)
        if tune_steps is None:
            tune_steps = STEPS_AFTER_LEARNING if trained or polish_steps else TuneOptions.steps
        options = TuneOptions.of_learned if trained else TuneOptions
        polish = PolishOptions(steps=polish_steps) if polish_steps else None
        tune = options(steps=tune_steps, cache_bytes=cache_bytes) if tune_steps else None
        return cls(polish, tune, train, compact)


def bake(
    scene: BakeableScene,
    cameras: Sequence[Camera],
    photographs: Sequence[View],
    background: Tensor,
    options: BakeOptions,
    refine: RefineOptions,
    progress: Progress = no_progress,
    held_out: Sequence[View] = (),
) -> Coded:
    """Bake a trained scene, optimise it against the photographs, and encode it for a bundle, on the scene's device.

    Stages: tiles of the trained texels, or of the field; polish of texels and surfels (field only); reduction of tiles
    and view colours; rounding of the surfels (compact only); fine-tuning of the texels; coding; certificate.
    `photographs`: training views, with the corrections of training; `cameras`: theirs. `background`: [3]. `held_out`:
    views of which gains are stated. Raises ValueError: no surfel is left, an option is out of range or for a field
    alone, or the atlas would be too large."""
    options.check()
    of_fields = ("r_min", "r_max", "extent", "local_voxel")
    given = [name for name in of_fields if getattr(options, name) != getattr(BakeOptions, name)]
    if given and isinstance(scene.field, TexelField):
        raise ValueError(f"{listed(given)} are for a field: tiles that were trained get smaller by the tolerance")
    form = "compact" if refine.compact is not None else options.format
    options = replace(options, format=replace(options, format=form).texel_format)  # as bundle.json states it
    polish = refine.polish
    tune = refine.tune
    trained = trained_texels(scene, options)
    if scene.field is not None and not isinstance(scene.field, TexelField):
        trained = field_tiles(trained, scene.field, cameras, polish and polish.pixels_per_texel, progress)
    if polish is not None and trained.textured:
        trained = polish_scene(trained, photographs, background, polish, refine.train, progress, held_out)
    baked = prune_and_resample(trained, cameras, progress)
    if refine.compact is not None:
        baked = compacted(baked, photographs, background, refine.compact, progress, held_out)
    if tune is not None and baked.textured:
        coded = tune_atlas(baked, photographs, background, tune, progress, held_out)
    else:
        coded = baked.encoded(progress)
    return certified(coded, cameras)


def bake_field(
    scene: BakeableScene,
    cameras: Sequence[Camera] = (),
    options: BakeOptions | None = None,
    progress: Progress = no_progress,
) -> Coded:
    """Bake a scene as it is, without photographs."""
    return bake(scene, cameras, (), torch.zeros(3), options or BakeOptions(), RefineOptions(), progress)
