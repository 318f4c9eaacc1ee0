"""Training options. Step counts are for a run of 30,000 steps and scale with the length of the run."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from typing import Annotated, Literal

import tyro
from pydantic import Field

from bitymi_ns.ranges import MOST, Count, NonNegative, Positive, PositiveCount, PositiveShare, Share, Threshold

REFERENCE_STEPS = 30_000
ExposureKind = Literal["auto", "off", "gain", "affine"]  # colour corrections of the photographs
RefinePoses = Literal["off", "on"]  # pose refinement of the photographs
Background = Literal["auto", "black", "white", "random"]  # colours behind the scene


@dataclass
class LossConfig:
    """Losses of the objective."""

    ssim_weight: Share = 0.2  # Photometric loss = (1 - w) L1 + w (1 - SSIM).
    falloff_weight: NonNegative = 0.005
    """Weight lambda of the falloff loss; 0 = none (the paper's quality setting)."""
    falloff_gamma: NonNegative = 25.0
    """Decay gamma of the falloff and overdraw losses with the L1 error e over rgb: exp(-gamma e)."""
    overdraw_weight: NonNegative = 0.0
    """Weight of the loss on the number of fragments per pixel, which decays like the falloff loss; 0 = none."""
    overdraw_start: int = 12_000  # First step with the overdraw loss: earlier, it costs quality.
    overdraw_stop: int = 27_000  # First step without the overdraw loss, so that the image settles.
    overdraw_half: Positive = 0.005
    """Blending weight of a fragment that counts as half a fragment in the overdraw loss."""
    depth_weight: NonNegative = 0.01  # Weight of the depth loss, for captures with depth; 0 = none.
    normal_weight: NonNegative = 0.02  # Weight of the normal loss, for captures with normals; 0 = none.
    geometry_interval: PositiveCount = 4
    """Interval N of the steps with depth and normal losses, whose weights are multiplied by N there."""


@dataclass
class DensifyConfig:
    """FastGS multi-view densification and pruning."""

    start: int = 500  # First step of densification (exclusive).
    stop: int = 15_000  # Last step of densification (exclusive).
    interval: PositiveCount = 500  # Steps between densifications.
    views: PositiveCount = 10
    """Maximum number of training views rendered for the multi-view score."""
    error_threshold: Share = 0.1  # A pixel counts as bad when its min-max normalised error is above this.
    importance: Annotated[int, Field(ge=-1, le=MOST)] = 5
    """Surfels are densified when they cover more bad pixels per view than this."""
    grad_threshold: Threshold = 2e-4  # Clone when the mean gradient of the projected centre (NDC) is at least this.
    abs_grad_threshold: Threshold = 7e-4
    """Split when the mean absolute gradient of the projected centre (NDC) is at least this."""
    dense: Threshold = 0.001  # Surfels larger than this share of the scene extent are split, others cloned.
    prune_opacity: Share = 0.005  # Surfels below this opacity are candidates for pruning.
    prune_world: Threshold = 0.1  # Surfels larger than this share of the scene extent are candidates.
    prune_screen: Threshold = 20.0
    """Surfels with a larger radius on screen, in pixels, are candidates after the first opacity reset."""
    prune_budget: Share = 0.5  # Share of the candidates pruned at each densification, sampled at random.
    opacity_clamp: PositiveShare = 0.8  # Opacities are clamped to this at each densification.
    reset_interval: PositiveCount = 3000  # Steps between opacity resets (until `stop`).
    min_reset_interval: Count = 1500  # Minimum of `reset_interval`, in runs of any length.
    reset_opacity: PositiveShare = 0.01  # Largest opacity after a reset; higher in very short runs.
    final_prune_steps: tuple[int, ...] = (18_000, 21_000, 24_000, 27_000)  # Steps of the final prunes.
    final_prune_opacity: Share = 0.1  # Opacity below which final prunes may remove a surfel.
    final_prune_error: Share = 0.02
    """Squared error that a final prune may add to the training images, as a share of theirs."""
    prune_error: Share = 0.02
    """Squared error that the prune after the last densification may add to the training images, as a share of theirs,
    at most of that at 30 dB; the surfels that add least are removed. 0 = no such prune."""
    min_interval: Count = 100
    """Minimum of `interval` in runs of any length: surfels need time to settle."""
    pixels_per_surfel: NonNegative = 150.0
    """Densification stops at one surfel per this many pixels of all training photographs; 0 = no limit."""
    growth: NonNegative = 4.0
    """Growth to this many times the initial number of surfels is allowed despite `pixels_per_surfel`: a scene needs
    some to add surfels where its errors are."""
    max_surfels: Annotated[Count, tyro.conf.arg(aliases=("--max-surfels",))] = 0
    """Number of surfels that densification grows to, never exceeded, instead of `pixels_per_surfel`; 0 = the thresholds
    decide. The prunes after the last densification leave a quarter to two fifths fewer."""
    min_surfels: Count = 100  # Minimum number of surfels that a prune leaves.


@dataclass
class LearningRates:
    """Learning rates; pairs decay log-linearly from the first to the second over the run."""

    short_run_power: Annotated[float, Field(ge=0, le=10)] = 0.35
    """Runs of n < 30,000 steps multiply the rates of the surfels by (30,000 / n) to this power."""
    short_run_max: Positive = 4.0  # Largest such factor: at 7 the held-out error grows again.
    mean_pixels: tuple[Positive, Positive] = (0.07, 0.0007)
    """Positions, in pixels at the surfel, of the nearest view that contains it."""
    means: tyro.conf.Suppress[tuple[Positive, Positive] | None] = None
    """Positions, in scene extents, instead of `mean_pixels`, for the polish of a bake."""
    quats: NonNegative = 1e-3  # Rotations.
    log_scales: NonNegative = 5e-3  # Logarithms of the tangent scales.
    opacity_logits: NonNegative = 0.025  # Opacities, as logits.
    beta_raw: NonNegative = 5e-3  # Kernel exponents: beta = 4 sigmoid(beta_raw).
    view_color: tuple[Positive, Positive] = (2.5e-3, 5e-4)
    """View-dependent colour: sv_rgb, sh_dc, sb_base and sg_base."""
    view_shape: tuple[Positive, Positive] = (5e-3, 5e-4)
    """View-dependent colour: Voronoi sites and temperatures, lobes; higher SH bands: a twentieth of view_color."""
    field_table: tuple[Positive, Positive] = (1e-2, 1e-3)  # Hash table of the texture field.
    field_mlp: tuple[Positive, Positive] = (1e-2, 1e-3)  # MLP of the texture field.
    exposure: tuple[Positive, Positive] = (5e-3, 5e-4)
    """Colour corrections of the photographs: log gains and other matrix entries."""

    def times(self, factor: float) -> LearningRates:
        """Multiply all rates by a factor."""
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
    """The texel stage, the last part of a run whose texture is `texels`."""

    start: Count = 18_000
    """First step of the texel stage, which has no densification and no opacity reset, and a tile for every surfel at
    the resolution of the training views; 30,000 or more = no texel stage."""
    travel: NonNegative = 0.3
    """Distance, in colour units, that texels can move in the texel stage: if it has too few passes over the views for
    that, `rate` is raised, at most to this value."""
    alpha_rate: NonNegative = 30.0
    """Rate of the texels' alphas, relative to that of their colours; 0 = opaque texels."""
    surfel_rates: Positive = 0.4
    """Surfel rates in the texel stage, as a share of those of a run of the stage's length; cosine decay to 0."""
    mean_rates: Positive = 0.2
    """Position rates in the texel stage, likewise; as high as `surfel_rates` they would destroy the image."""
    pixels_per_texel: Positive = 0.25
    """Minimum number of pixels of a surfel (summed blending weight, in the view where it covers most) per texel."""
    rendered_pixels_per_texel: Positive = 32.0
    """Minimum number of pixels rendered in the texel stage per texel; 8 million texels are always allowed."""
    largest: Annotated[int, Field(ge=4, le=4096)] = 64  # Largest side of a tile, texels, a power of two.
    views: NonNegative = 0.25
    """Number of views on which tiles are measured, as a share of the steps of the texel stage; at least 32."""


@dataclass
class GuardConfig:
    """Rollback of diverged training."""

    rollbacks: Count = 5  # Maximum number of rollbacks; 0 = a loss that is not finite ends the run.
    rates: PositiveShare = 0.3  # Factor of all learning rates at each rollback.
    window: PositiveCount = 300  # Steps over which the loss is averaged.
    min_window: PositiveCount = 20  # Minimum number of steps of a window, in runs of any length.


@dataclass
class PoseConfig:
    """Pose refinement of the photographs."""

    start: Count = 3000  # First step in which poses move.
    stop: Count = 27_000  # First step in which poses are fixed again.
    pixels: Positive = 0.5
    """Length of the first step: image motion if all fragments agree on the direction, in pixels of the current
    resolution; cosine decay to 0."""


@dataclass
class TrainConfig:
    """Options of training."""

    loss: LossConfig = field(default_factory=LossConfig)
    densify: DensifyConfig = field(default_factory=DensifyConfig)
    lr: LearningRates = field(default_factory=LearningRates)
    guard: GuardConfig = field(default_factory=GuardConfig)
    texels: TexelConfig = field(default_factory=TexelConfig)
    freeze_after: Count = 5000  # From this step on, only every `freeze_every`-th step trains the texture field.
    freeze_every: PositiveCount = 10
    """Interval of the steps that train the texture field after `freeze_after`; 1 = every step."""
    freeze_min_updates: Count = 300
    """Minimum number of steps after `freeze_after` that train the field, for which short runs use a smaller interval;
    below 720 steps nothing is frozen."""
    field_warmup: Count = 500  # Steps over which the learning rate of the texture field rises.
    resolution_schedule: Count = 3000
    """Interval at which the image resolution doubles, from a lower one at the start; 0 = full size throughout. Longer
    in runs of fewer than 3,000 steps with a texel stage, which begins at full size."""
    small_photograph: PositiveCount = 10_000
    """Opaque, unmasked pixels per photograph up to which short runs do not lengthen `resolution_schedule`; n times as
    many lengthen it by a factor of at most sqrt(n)."""
    num_downscales: Annotated[int, Field(ge=0, le=16)] = 2  # Halvings of the image size at the start.
    init_opacity: Annotated[float, Field(gt=0, lt=1)] = 0.1  # Initial opacity of the surfels.
    dropout: Annotated[float, Field(ge=0, lt=1)] = 0.1
    """Largest probability with which a training view leaves a surfel out; 0 = none. Reduces overfitting."""
    dropout_passes: Positive = 50.0  # Passes over the photographs above which a run has dropout; all of it at twice.
    first_surfels: PositiveCount | None = None
    """Maximum number of initial surfels; excess points are dropped at random. Not given: in ns-train one per 1,000
    pixels that the run renders; else no limit."""
    background_points: NonNegative = 0.15
    """Maximum number of surfels added where photographs show no point, as a share of the others; 0 = none."""
    random_points: PositiveCount = 20_000
    """Number of random surfels in the scene box if the capture has no sparse points."""
    exposure: ExposureKind = "auto"
    """Learned colour correction of each photograph: gain = a factor per channel, affine = a 3 x 4 matrix, off = none,
    auto = gain if gains explain the differences of the photographs."""
    refine_poses: RefinePoses = "off"
    """Poses of the training photographs: on = refined, off = fixed."""
    poses: PoseConfig = field(default_factory=PoseConfig)
    background: Background = "auto"
    """Background colour in training, also behind images with alpha. auto = random in each step for images with alpha,
    so that transparent regions stay transparent; `alpha_color` for others."""
    alpha_color: Literal["black", "white"] = "black"
    """Background colour for evaluation and after training, with background auto and random. In ns-train the capture's,
    if it states one."""
    seed: int = 0  # Seed of every random choice in training.
