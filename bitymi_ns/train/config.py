"""Training options. Every step count is stated for a run of 30,000 steps and scales with the length of the run."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from typing import Annotated, Literal

import tyro
from pydantic import Field

from bitymi_ns.ranges import MOST, Count, NonNegative, Positive, PositiveCount, PositiveShare, Share, Threshold

REFERENCE_STEPS = 30_000  # run length that every step count below is stated for
ExposureKind = Literal["auto", "off", "gain", "affine"]  # colour corrections of the photographs
RefinePoses = Literal["off", "on"]  # whether poses of the photographs are refined
Background = Literal["auto", "black", "white", "random"]  # colours behind the scene


@dataclass
class LossConfig:
    """The objective: photometric loss, falloff and overdraw reduction."""

    ssim_weight: Share = 0.2  # Photometric loss = (1 - w) L1 + w (1 - SSIM).
    falloff_weight: NonNegative = 0.005
    """Weight lambda of the falloff loss; 0 turns it off (the paper's quality setting)."""
    falloff_gamma: NonNegative = 25.0
    """Decay of the falloff and overdraw losses with the photometric error e, L1 summed over rgb: exp(-gamma e)."""
    overdraw_weight: NonNegative = 0.0
    """Weight of the loss on the number of fragments per pixel, which fades with the error as the falloff loss does."""
    overdraw_start: int = 12_000  # First step with the overdraw loss: before, it costs quality.
    overdraw_stop: int = 27_000  # Step from which the overdraw loss is off again, so that the picture settles.
    overdraw_half: Positive = 0.005
    """Blending weight of a fragment that counts as half a fragment in the overdraw loss."""
    depth_weight: NonNegative = 0.01  # Weight of the depth loss, for captures with depth; 0 turns it off.
    normal_weight: NonNegative = 0.02  # Weight of the normal loss, for captures with normals; 0 turns it off.
    geometry_interval: PositiveCount = 4
    """Steps between those with the depth and the normal loss, which weigh so many times as much there."""


@dataclass
class DensifyConfig:
    """FastGS multi-view densification and pruning."""

    start: int = 500  # First step of densification (exclusive).
    stop: int = 15_000  # Last step of densification (exclusive).
    interval: PositiveCount = 500  # Steps between densifications.
    views: PositiveCount = 10
    """Training views rendered for the multi-view score; with fewer training views, all of them."""
    error_threshold: Share = 0.1  # A pixel counts as bad when its min-max normalised error is above this.
    importance: Annotated[int, Field(ge=-1, le=MOST)] = 5
    """Surfels are densified when their mean count of bad pixels per view is above this."""
    grad_threshold: Threshold = 2e-4  # Clone when the mean gradient of the projected centre (NDC) is at least this.
    abs_grad_threshold: Threshold = 7e-4
    """Split when the mean absolute gradient of the projected centre (NDC) is at least this."""
    dense: Threshold = 0.001  # Surfels larger than this share of the scene extent are split, smaller ones are cloned.
    prune_opacity: Share = 0.005  # Surfels below this opacity are candidates for pruning.
    prune_world: Threshold = 0.1  # Surfels larger than this share of the scene extent are candidates for pruning.
    prune_screen: Threshold = 20.0
    """Surfels with a larger radius on screen, in pixels, are candidates for pruning after the first opacity reset."""
    prune_budget: Share = 0.5  # Share of the candidates that is drawn for pruning at each densification.
    opacity_clamp: PositiveShare = 0.8  # Opacities are clamped to this at each densification.
    reset_interval: PositiveCount = 3000  # Steps between opacity resets (until `stop`).
    min_reset_interval: Count = 1500  # Fewest steps between opacity resets, however short the run.
    reset_opacity: PositiveShare = 0.01  # Opacity after a reset, at most. Very short runs reset to a higher one.
    final_prune_steps: tuple[int, ...] = (18_000, 21_000, 24_000, 27_000)  # Steps of the final prunes.
    final_prune_opacity: Share = 0.1  # Final prunes remove surfels below this opacity,
    final_prune_error: Share = 0.02
    """... those that change the training pictures least, together by at most this share of their squared error."""
    prune_error: Share = 0.02
    """After the last densification, surfels that hardly matter are removed: those whose removal changes the training
    pictures least, together by at most this share of the pictures' squared error (or of that of pictures at 30 dB,
    where it is larger); 0 = none."""
    min_interval: Count = 100
    """Fewest steps between densifications, however short the run: surfels need time to settle first."""
    pixels_per_surfel: NonNegative = 150.0
    """Densification stops at one surfel for so many pixels of all training photographs together; 0 = no such bound."""
    growth: NonNegative = 4.0
    """... but not before there are so many times the surfels that training started with, however few the pixels: a
    scene that cannot grow cannot put surfels where its errors are."""
    max_surfels: Annotated[Count, tyro.conf.arg(aliases=("--max-surfels",))] = 0
    """Surfels that densification grows to, and most at any time; 0 = as many as the thresholds ask for. Replaces
    `pixels_per_surfel`. Prunes may leave fewer."""
    min_surfels: Count = 100  # No prune leaves fewer surfels than this.


@dataclass
class LearningRates:
    """Learning rates; pairs decay log-linearly from the first to the second over the run."""

    short_run_power: Annotated[float, Field(ge=0, le=10)] = 0.35
    """Runs of n < 30,000 steps multiply the rates of the surfels, not of the field, by (30,000 / n) to this power."""
    short_run_max: Positive = 4.0  # The largest such factor: at 7 times the rates the held-out error grows again.
    mean_pixels: tuple[Positive, Positive] = (0.07, 0.0007)
    """Positions, in pixels of the photographs: the side of a pixel at the surfel, in the nearest view that holds it."""
    means: tyro.conf.Suppress[tuple[Positive, Positive] | None] = None
    """Positions, times the scene extent, as in runs recorded before steps were in pixels: replaces `mean_pixels`."""
    quats: NonNegative = 1e-3  # Rotations.
    log_scales: NonNegative = 5e-3  # Logarithms of the tangent scales.
    opacity_logits: NonNegative = 0.025  # Opacities, as logits.
    beta_raw: NonNegative = 5e-3  # Kernel exponents: beta = 4 sigmoid(beta_raw).
    view_color: tuple[Positive, Positive] = (2.5e-3, 5e-4)
    """View-dependent colour: sv_rgb, sh_dc, sb_base and sg_base."""
    view_shape: tuple[Positive, Positive] = (5e-3, 5e-4)
    """View-dependent colour: Voronoi sites and temperatures, lobes; higher SH bands use a twentieth of view_color."""
    field_table: tuple[Positive, Positive] = (1e-2, 1e-3)  # Hash table of the texture field.
    field_mlp: tuple[Positive, Positive] = (1e-2, 1e-3)  # MLP of the texture field.
    exposure: tuple[Positive, Positive] = (5e-3, 5e-4)
    """Colour corrections of the photographs: logarithms of gains, and what else they have."""

    def times(self, factor: float) -> LearningRates:
        """The rates times a factor; the rules for short runs stay as they are."""
        rates = {name: value for name, value in asdict(self).items() if value and not name.startswith("short_run")}
        scaled = {k: tuple(factor * x for x in v) if isinstance(v, tuple) else factor * v for k, v in rates.items()}
        return replace(self, **scaled)


@dataclass
class TexelSteps:
    """Step sizes of texels."""

    rate: NonNegative = 0.05
    """Largest step of a texel per pass over the views, in colour units; falls to 0 as a cosine."""
    prior: Positive = 0.3
    """Coverage prior m0 in pixels: a texel of summed blending weight m moves at m / (m + m0) of the rate."""


@dataclass
class TexelConfig(TexelSteps):
    """Texels that learn in the last part of a run, where the texture of the scene is `texels`."""

    start: Count = 18_000
    """First step of that part. Nothing is densified any more, no opacity is reset, and every surfel has a tile as fine
    as the training views see it; 30,000 or more = there is no such part."""
    travel: NonNegative = 0.3
    """Largest distance that a texel can move in that part, colour units: where it passes over the views few times,
    `rate` is raised so that texels get there, up to this."""
    alpha_rate: NonNegative = 30.0
    """Rate of the texels' alphas, which cut silhouettes out of surfels, as a multiple of that of their colours; 0 =
    opaque texels."""
    surfel_rates: Positive = 0.4
    """Rates of the surfels in that part, as a share of those of a run as long as it; they fall to 0 as a cosine."""
    mean_rates: Positive = 0.2
    """Rates of the positions in that part, likewise: at `surfel_rates` what is drawn already would come apart."""
    pixels_per_texel: Positive = 0.25
    """A tile has at most one texel per this many pixels of its surfel (summed blending weight), in the view that shows
    most of it."""
    rendered_pixels_per_texel: Positive = 32.0
    """Limit on the texels of all tiles: one per this many pixels rendered in that part, but not below 8 million. Saves
    memory."""
    largest: Annotated[int, Field(ge=4, le=4096)] = 64  # Largest side of a tile, texels, a power of two.
    views: NonNegative = 0.25
    """Views that tile sizes and coverage are measured on, as a share of the steps of that part; at least 32."""


@dataclass
class GuardConfig:
    """Rollback of diverged training."""

    rollbacks: Count = 5  # Most rollbacks to the last good state; 0 = a loss that is not finite ends the run.
    rates: PositiveShare = 0.3
    """All learning rates are multiplied by this at a rollback; by its square, cube, ... at further ones without a good
    window between."""
    window: PositiveCount = 300  # Steps over which the loss is judged.
    min_window: PositiveCount = 20  # Fewest steps of a window, however short the run.


@dataclass
class PoseConfig:
    """Refinement of the photographs' poses, where it is on."""

    start: Count = 3000  # First step in which poses move.
    stop: Count = 27_000  # From this step on they stay, so that the texels settle.
    pixels: Positive = 0.5
    """How far the first step moves a picture where all of it agrees on the direction, in pixels of the resolution of
    the moment; falls to 0 as a cosine."""


@dataclass
class TrainConfig:
    """Options of training."""

    loss: LossConfig = field(default_factory=LossConfig)
    densify: DensifyConfig = field(default_factory=DensifyConfig)
    lr: LearningRates = field(default_factory=LearningRates)
    guard: GuardConfig = field(default_factory=GuardConfig)
    texels: TexelConfig = field(default_factory=TexelConfig)
    freeze_after: Count = 5000  # From this step on the texture field learns on one step in `freeze_every` only.
    freeze_every: PositiveCount = 10
    """Stride of the steps on which the texture field learns after `freeze_after`; 1 = every step."""
    freeze_min_updates: Count = 300
    """Short runs freeze less, so that the field still learns on about this many steps after `freeze_after`."""
    field_warmup: Count = 500  # Steps over which the learning rate of the texture field rises to its full value.
    resolution_schedule: Count = 3000
    """Training starts at a lower image resolution and doubles it every this many steps; 0 = full size throughout. Where
    texels learn in the last part, runs of fewer than 3,000 steps use a longer interval, but reach full size by then."""
    small_photograph: PositiveCount = 10_000
    """Photographs with at most this many pixels that show something do not stretch that interval; n times as many
    stretch it by at most sqrt(n)."""
    num_downscales: Annotated[int, Field(ge=0, le=16)] = 2  # Halvings of the image size at the start.
    init_opacity: Annotated[float, Field(gt=0, lt=1)] = 0.1  # Opacity of the first surfels.
    first_surfels: PositiveCount | None = None
    """Most surfels that training starts with; excess points are dropped at random. Not given: in ns-train one for every
    1,000 pixels that the run renders; else all points."""
    background_points: NonNegative = 0.15
    """Most further first surfels where parts of the photographs show no point, as a share of the others; 0 = none."""
    random_points: PositiveCount = 20_000
    """Surfels placed at random in the scene box when the capture has no sparse points."""
    exposure: ExposureKind = "off"
    """Exposure and white balance of each photograph: gain = a learned factor per channel, affine = a learned 3 x 4
    matrix, off = all photographs are taken as they are, auto = gain where the photographs disagree by gains."""
    refine_poses: RefinePoses = "off"
    """Poses of the training photographs: on = refined beside the scene, off = as they are given."""
    poses: PoseConfig = field(default_factory=PoseConfig)
    background: Background = "auto"
    """Colour behind the scene while training; images with alpha are composed over it. auto = another one in every step,
    as random does, for images with alpha, so that nothing is learned but what they show; alpha_color for others."""
    alpha_color: Literal["black", "white"] = "black"
    """Colour behind images with alpha where views are judged and after training, with background auto and random. In
    ns-train that of the capture, where it states one."""
    seed: int = 0  # Seed of every random choice in training.
