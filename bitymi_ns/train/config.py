"""Training options. Every step count is stated for a run of 30,000 steps and scales with the length of the run."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

REFERENCE_STEPS = 30_000
"""The run length for which every step count below is given."""
ExposureKind = Literal["auto", "off", "gain", "affine"]
"""Colour corrections of the photographs."""
Background = Literal["auto", "black", "white", "random"]
"""Colours behind the scene."""


@dataclass
class LossConfig:
    """The objective: photometric loss, falloff and overdraw reduction."""

    ssim_weight: float = 0.2
    """Photometric loss = (1 - w) L1 + w (1 - SSIM)."""
    falloff_weight: float = 0.005
    """Weight lambda of the falloff loss; 0 turns it off (the paper's quality setting)."""
    falloff_gamma: float = 25.0
    """How sharply the falloff and overdraw losses fade with the photometric error: omega = exp(-gamma e)."""
    falloff_error: Literal["l1_sum", "mse"] = "l1_sum"
    """The error e in omega: L1 summed over rgb, or the mean squared error."""
    falloff_gradient: Literal["full", "beta_only"] = "full"
    """full: the falloff loss also moves the blending weights; beta_only: beta alone."""
    overdraw_weight: float = 0.0
    """Weight of the loss on the number of fragments per pixel, which fades with the error as the falloff loss does."""
    overdraw_start: int = 12_000
    """First step with the overdraw loss: before, it costs quality."""
    overdraw_stop: int = 27_000
    """Step from which the overdraw loss is off again, so that the picture settles."""
    overdraw_half: float = 0.005
    """Blending weight of a fragment that counts as half a fragment in the overdraw loss."""


@dataclass
class DensifyConfig:
    """FastGS multi-view densification and pruning."""

    start: int = 500
    """First step of densification (exclusive)."""
    stop: int = 15_000
    """Last step of densification (exclusive)."""
    interval: int = 500
    """Steps between densifications."""
    views: int = 10
    """Training views rendered for the multi-view score; with fewer training views, all of them."""
    error_threshold: float = 0.1
    """A pixel counts as bad when its min-max normalised error is above this."""
    importance: int = 5
    """Surfels are densified when their mean count of bad pixels per view is above this."""
    grad_threshold: float = 2e-4
    """Clone when the mean gradient of the projected centre (NDC) is at least this."""
    abs_grad_threshold: float = 7e-4
    """Split when the mean absolute gradient of the projected centre (NDC) is at least this."""
    dense: float = 0.001
    """Surfels larger than this share of the scene extent are split, smaller ones are cloned."""
    prune_opacity: float = 0.005
    """Surfels below this opacity are candidates for pruning."""
    prune_world: float = 0.1
    """Surfels larger than this share of the scene extent are candidates for pruning."""
    prune_screen: float = 20.0
    """Surfels with a larger radius on screen, in pixels, are candidates for pruning after the first opacity reset."""
    prune_budget: float = 0.5
    """Share of the candidates that is drawn for pruning at each densification."""
    opacity_clamp: float = 0.8
    """Opacities are clamped to this at each densification."""
    reset_interval: int = 3000
    """Steps between opacity resets (until `stop`)."""
    min_reset_interval: int = 1500
    """Fewest steps between opacity resets, however short the run."""
    reset_opacity: float = 0.01
    """Opacity after a reset, at most. Very short runs reset to a higher one."""
    final_prune_steps: tuple[int, ...] = (18_000, 21_000, 24_000, 27_000)
    """Steps of the final prunes."""
    final_prune_opacity: float = 0.1
    """Final prunes remove surfels below this opacity."""
    final_prune_score: float = 1.0
    """Final prunes remove surfels whose multi-view error score (0 to 1) is above this; 1 = none. FastGS's 0.9 removes
    those that cover most bad pixels, the largest of a background among them, when nothing can close the hole."""
    min_interval: int = 100
    """Fewest steps between densifications, however short the run: surfels need time to settle first."""
    pixels_per_surfel: float = 300.0
    """Densification stops at one surfel for so many pixels of all training photographs together; 0 = no such bound."""
    growth: float = 2.0
    """... but not before there are so many times the surfels that training started with, however few the pixels: a
    scene that cannot grow cannot put surfels where its errors are."""
    max_surfels: int = 0
    """Hard cap on the number of surfels; 0 = none."""
    min_surfels: int = 100
    """No prune leaves fewer surfels than this."""


@dataclass
class LearningRates:
    """Learning rates; pairs decay log-linearly from the first to the second over the run."""

    short_run_power: float = 0.35
    """Runs of n < 30,000 steps multiply the rates of the surfels, not of the field, by (30,000 / n) to this power."""
    short_run_max: float = 4.0
    """The largest such factor: at 7 times the rates the held-out error grows again."""
    means: tuple[float, float] = (1.6e-4, 1.6e-6)
    """Positions, times the scene extent."""
    quats: float = 1e-3
    """Rotations."""
    log_scales: float = 5e-3
    """Logarithms of the tangent scales."""
    opacity_logits: float = 0.025
    """Opacities, as logits."""
    beta_raw: float = 5e-3
    """Kernel exponents: beta = 4 sigmoid(beta_raw)."""
    view_color: tuple[float, float] = (2.5e-3, 5e-4)
    """View-dependent colour: sv_rgb, sh_dc, sb_base and sg_base."""
    view_shape: tuple[float, float] = (5e-3, 5e-4)
    """View-dependent colour: Voronoi sites and temperatures, lobes; higher SH bands use a twentieth of view_color."""
    field_table: tuple[float, float] = (1e-2, 1e-3)
    """Hash table of the texture field."""
    field_mlp: tuple[float, float] = (1e-2, 1e-3)
    """MLP of the texture field."""
    exposure: tuple[float, float] = (5e-3, 5e-4)
    """Colour corrections of the photographs: logarithms of gains, and what else they have."""

    def times(self, factor: float) -> LearningRates:
        """The rates times a factor; the rules for short runs stay as they are."""
        rates = {name: value for name, value in vars(self).items() if not name.startswith("short_run")}
        scaled = {k: tuple(factor * x for x in v) if isinstance(v, tuple) else factor * v for k, v in rates.items()}
        return replace(self, **scaled)


@dataclass
class AdamConfig:
    """Adam's constants."""

    eps: float = 1e-15
    """Added to the root of the second moment."""
    betas: tuple[float, float] = (0.9, 0.999)
    """Decay of the running averages, of the surfels' parameters."""
    field_betas: tuple[float, float] = (0.9, 0.99)
    """The same of the texture field, which forgets faster: its gradients are sparse and large early on."""


@dataclass
class TexelSteps:
    """How far texels move, in training and after it."""

    rate: float = 0.05
    """How far a texel moves in a pass over the views at the start, at most, in colour units; falls to 0 as a cosine."""
    prior: float = 0.3
    """How much seeing it takes to move a texel, in pixels: one seen with the summed weight m moves at m / (m + prior)
    of the rate, one never seen not at all."""


@dataclass
class TexelConfig(TexelSteps):
    """Texels that learn in the last part of a run, where the texture of the scene is `texels`."""

    start: int = 18_000
    """First step of that part. Nothing is densified any more, no opacity is reset, and every surfel has a tile as fine
    as the training views see it; 30,000 or more = there is no such part."""
    travel: float = 0.3
    """How far a texel can move in all of that part, colour units: where it passes over the views few times, `rate` is
    raised so that texels get there, up to this."""
    surfel_rates: float = 0.4
    """Rates of the surfels in that part, as a share of those of a run as long as it; they fall to 0 as a cosine."""
    pixels_per_texel: float = 0.25
    """A tile has at most a texel for so many pixels that its surfel makes up of the view that shows most of it."""
    looked_pixels_per_texel: float = 32.0
    """Where there would be more than 8 million texels, tiles together have at most one for so many pixels that the
    steps of that part look at: more take memory that they are not worth."""
    largest: int = 64
    """Largest side of a tile, texels, a power of two."""
    views: float = 0.25
    """Views that are looked through to find what the tiles need, as a share of the steps of that part; 32 at least."""


@dataclass
class GuardConfig:
    """What happens when training diverges."""

    rollbacks: int = 5
    """How often a run may go back to its last good state; 0 = a loss that is not finite ends it."""
    rates: float = 0.3
    """Factor of all learning rates when it does; its square, cube, ... when that was not enough."""
    window: int = 300
    """Steps over which the loss is judged."""
    min_window: int = 20
    """Fewest steps of a window, however short the run."""


@dataclass
class TrainConfig:
    """How a scene is trained."""

    loss: LossConfig = field(default_factory=LossConfig)
    densify: DensifyConfig = field(default_factory=DensifyConfig)
    lr: LearningRates = field(default_factory=LearningRates)
    guard: GuardConfig = field(default_factory=GuardConfig)
    texels: TexelConfig = field(default_factory=TexelConfig)
    freeze_after: int = 5000
    """From this step on the texture field learns on one step in `freeze_every` only."""
    freeze_every: int = 10
    """How rarely the texture field learns after `freeze_after`; 1 = on every step."""
    freeze_min_updates: int = 300
    """Short runs freeze less, so that the field still learns on about this many steps after `freeze_after`."""
    field_warmup: int = 500
    """Steps over which the learning rate of the texture field rises to its full value."""
    resolution_schedule: int = 3000
    """Training starts at a lower image resolution and doubles it every this many steps; 0 = full size throughout. Where
    texels learn in the last part, runs of fewer than 3,000 steps wait longer, at most until then."""
    small_photograph: int = 10_000
    """Pixels of a photograph, of those that show something, with which they do not wait longer; with n times as many,
    by at most sqrt(n)."""
    num_downscales: int = 2
    """How many times the image size is halved at the start."""
    init_opacity: float = 0.1
    """Opacity of the first surfels."""
    first_surfels: int | None = None
    """Most surfels that training starts with; excess points are dropped at random. Not given: in ns-train one for every
    1,000 pixels that the run looks at, because a surfel costs time in every step, and short runs on small pictures
    cannot place more; else all points."""
    random_points: int = 20_000
    """Surfels placed at random in the scene box when the capture has no sparse points."""
    exposure: ExposureKind = "off"
    """Exposure and white balance of each photograph: gain = a learned factor per channel, affine = a learned 3 x 4
    matrix, off = all photographs are taken as they are, auto = gain where the photographs disagree by gains."""
    background: Background = "auto"
    """Colour behind the scene while training; images with alpha are composed over it. auto = another one in every step,
    as random does, for images with alpha, so that nothing is learned but what they show; alpha_color for others."""
    alpha_color: Literal["black", "white"] = "black"
    """Colour behind images with alpha where views are judged and after training, with background auto and random. In
    ns-train that of the capture, where it states one."""
    seed: int = 0
    """Seed of every random choice in training."""
