"""The whole way from a trained scene and its photographs to what a bundle holds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from torch import Tensor

from bitymi_ns.bake.baked import Baked
from bitymi_ns.bake.certificate import certified
from bitymi_ns.bake.compact import Compact, compacted, with_coded_texels
from bitymi_ns.bake.field.bake import bake
from bitymi_ns.bake.field.polish import PolishOptions, polish_scene
from bitymi_ns.bake.inputs import device_of
from bitymi_ns.bake.pipeline import BakeableScene, reduced, trained_texels
from bitymi_ns.bake.tune import TuneOptions, tune_atlas
from bitymi_ns.bundle.bake_options import BakeOptions
from bitymi_ns.codec.texel_codes import TexelCodeOptions
from bitymi_ns.progress import Progress, no_progress
from bitymi_ns.scene.camera import Camera
from bitymi_ns.scene.field import TexelField
from bitymi_ns.train.config import TrainConfig
from bitymi_ns.train.views import View


@dataclass(frozen=True)
class Learning:
    """What learns from the photographs after the training.

    Attributes:
        polish: texels and surfels together; None = surfels stay as they were trained.
        tune: texels alone, after that; None = they stay as they are.
        train: options of the training, for the rates of the polish.
        compact: what makes the bundle compact, before the texels are tuned alone; None = it is not.
    """

    polish: PolishOptions | None = None
    tune: TuneOptions | None = None
    train: TrainConfig = field(default_factory=TrainConfig)
    compact: Compact | None = None


def baked_and_reduced(
    scene: BakeableScene,
    cameras: Sequence[Camera],
    photographs: Sequence[View],
    background: Tensor,
    options: BakeOptions,
    learning: Learning,
    progress: Progress = no_progress,
    held_out: Sequence[View] = (),
) -> Baked:
    """The first part of `bake_and_learn`, with its arguments: tiles and view colours as the options say, of what was
    learned in training, or of a field, polished or not."""
    polish = learning.polish
    has_learned = isinstance(scene.field, TexelField)
    if has_learned:
        baked = trained_texels(scene, options)
    else:
        baked = bake(scene, cameras, options, progress, None if polish is None else polish.pixels_per_texel)
    if polish is not None and baked.texels is not None:
        baked = polish_scene(
            baked, photographs, background, polish, learning.train, progress, held_out, device_of(cameras)
        )
    if polish is not None or has_learned:
        baked = reduced(baked, cameras, progress)
    return baked


def bake_and_learn(
    scene: BakeableScene,
    cameras: Sequence[Camera],
    photographs: Sequence[View],
    background: Tensor,
    options: BakeOptions,
    learning: Learning,
    progress: Progress = no_progress,
    held_out: Sequence[View] = (),
) -> Baked:
    """Bakes a scene, lets it learn, reduces and encodes it, and states how far what is stored is from what it learned.

    With a polish the order is: fine tiles, polish, reduction of tiles and view colours, fine-tuning. Without: reduced
    tiles and view colours, fine-tuning. A scene whose texels learned in training has its fine tiles already.

    Args:
        scene: a trained scene.
        cameras: of the training views, on the scene's device.
        photographs: the training views, with the corrections that training found.
        background: [3] colour behind the scene, on the CPU.
        options: what is kept.
        learning: see `Learning`.
        progress: called after every piece of work.
        held_out: views of which the gains are stated; they decide nothing.

    Raises:
        ValueError: no surfel is left, an option is out of range, or the atlas would be too large.
    """
    if learning.compact is not None:  # its texels are decoded to 8 bits: nothing has to be encoded to state their error
        options = replace(options, format="uint8")
    baked = baked_and_reduced(scene, cameras, photographs, background, options, learning, progress, held_out)
    coding = None
    if learning.compact is not None:
        baked, coding = compacted(baked, photographs, background, learning.compact, progress, device_of(cameras))
    return stored(baked, cameras, photographs, background, learning.tune, coding, progress, held_out)


def stored(
    baked: Baked,
    cameras: Sequence[Camera],
    photographs: Sequence[View],
    background: Tensor,
    tune: TuneOptions | None,
    coding: TexelCodeOptions | None = None,
    progress: Progress = no_progress,
    held_out: Sequence[View] = (),
) -> Baked:
    """The last part of `bake_and_learn`, with its arguments: texels are tuned and encoded, and their error is stated.

    Args:
        baked: of `baked_and_reduced`, or of that what `compact.compacted` made.
        coding: from there, how texels are coded.
    """
    if tune is not None and baked.texels is not None:
        baked = tune_atlas(baked, photographs, background, tune, progress, held_out, coding, device_of(cameras))
    if baked.codes is not None and baked.codes.texels is None:
        baked = with_coded_texels(baked, coding)
    return certified(baked.encoded(progress), [camera.to("cpu") for camera in cameras])
