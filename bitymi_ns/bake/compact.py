"""Rate-distortion choice of the codes of a compact bundle, by one lambda for everything."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from bitymi_ns.bundle.poster import most_bytes as poster_bytes
from bitymi_ns.bundle.statistics import Rounding, ViewColorError
from bitymi_ns.codec import streams
from bitymi_ns.codec.pages import joined, tile_means
from bitymi_ns.codec.surfel_codes import code_surfels
from bitymi_ns.codec.texel_codes import TexelCoder, TexelCodes, residual_codes
from bitymi_ns.progress import Progress, no_progress
from bitymi_ns.train.views import View
from .precision import PER_BIT, Pictures, column_noise
from .stages import Reduced, Rounded, laid_out, with_means
from .tiles import Tiles
from .tuning_views import TexelList

START = 8.0 / 255**2  # first lambda of the search: squared error per bit, colours from 0 to 1
MAX_LAMBDA = 4.0 / 255**2
"""Largest lambda where `Compact.share` decides: large errors that texels cannot correct, as of exposure, do not hide
rounding, and texels learn little with steps above the 4.2 of 255 that this lambda gives."""
TEXEL_SHARE = 0.5  # lambda of the texels, which are tuned later, as a share of that of all else
ENOUGH = 0.002
"""Added error, as a share of the bake's (0.009 dB), below which a given size is not used up."""
LEAST_ERROR = 1e-7  # mean square error that is always allowed: 70 dB
MANIFEST_BYTES = 28_000  # upper estimate of bundle.json and config.yml
ALTERNATIVES = {0.5: 12.0, 2.0: 1.0 / 32}
"""Relative bytes of the precisions that are stated beside, and first factors of lambda to try."""
_SEARCH, _TRIES = 7, 4
_CLOSE = 1.1  # largest ratio of the bytes of an alternative to those wanted, or inverse


@dataclass(frozen=True)
class Compact:
    """Size and precision of a compact bundle.

    `share`: added error before the texels are tuned, as a share of the mean square error against the training
    photographs; less where lambda would exceed `MAX_LAMBDA`. Instead decide, where given, `most_bytes` of surfels and
    texels, not used up where the added error is below `ENOUGH`, or `psnr`, dB, of the smallest bundle before the texels
    are tuned. `views`: number of training views that are drawn."""

    share: float = 0.1
    most_bytes: int | None = None
    psnr: float | None = None
    views: int = 8

    def fitting(self, megabytes: float, beside: int) -> "Compact":
        """Limit all files to `megabytes` (10^6 bytes), of which those beside surfels, texels, poster, bundle.json and
        config.yml take `beside` bytes. Raises ValueError: it is out of range, or leaves nothing for the scene."""
        if not 0.01 <= megabytes <= 1e5:
            raise ValueError(f"a bundle takes from 0.01 to 100,000 MB, not {megabytes}")
        size = int(1e6 * megabytes)
        beside += MANIFEST_BYTES + poster_bytes(size)
        if size <= beside:
            raise ValueError(f"a bundle of {megabytes:g} MB leaves no bytes for the scene: other files take {beside:,}")
        return replace(self, most_bytes=size - beside)


@dataclass(frozen=True)
class RatePoint:
    """A point of the rate-distortion curve."""

    lmbda: float  # squared error per bit
    baked: Rounded  # with texels as they were
    texels: TexelCodes | None  # None without texels
    error: float  # mean square error against the photographs
    psnr: float  # dB

    @cached_property
    def bytes(self) -> int:
        if self.texels is not None:
            return self.baked.codes.nbytes() + self.texels.nbytes()
        return self.baked.codes.nbytes() + streams.bytes_of([residual_codes(self.baked.texels)])


class Coder:
    """Measurements of a bake that give every point of its rate-distortion curve."""

    def __init__(
        self,
        baked: Reduced,
        views: Sequence[View],
        background: Tensor,
        options: Compact,
        progress: Progress = no_progress,
        held_out: Sequence[View] = (),
    ) -> None:
        """Measure `baked` in the training views; without any the reference steps are taken. Alternatives are stated on
        the `held_out` views, or without any on the training views. `background`: [3]."""
        self._baked = baked
        self._pictures = Pictures(views, background, options.views, baked.device)
        self._held_out = Pictures(held_out, background, options.views, baked.device)
        scene = baked.unquantised()
        self._sizes = baked.sizes.long()
        drawn = self._pictures.of(scene)
        self.error, self.psnr = self._pictures.square(drawn), self._pictures.psnr(drawn)
        self._numbers = self._pictures.numbers / max(1, self._pictures.views) * len(views)
        reduced = replace(scene, surfels={**scene.surfels, **self._view_colors(START)})
        self._noise = column_noise(reduced, self._sizes, baked.extent, self._pictures, progress)
        self._residual = tile_means(baked.texels, baked.sizes)[:, :3]
        self._tiles = None
        self._coverage = baked.texels.new_zeros(len(baked.texels), 2)
        if baked.textured:
            texels = TexelList(baked)
            self._tiles = texels.tiles
            self._coverage = texels.coverage(views, progress).cpu()

    @property
    def measured(self) -> bool:
        return self._pictures.views > 0

    def allowed(self, share: float) -> float:
        """Compute the allowed mean square error."""
        return self.error + max(LEAST_ERROR, share * self.error)

    def _view_colors(self, lmbda: float) -> dict[str, Tensor]:
        return self._baked.colors.at(lmbda) if self._baked.colors is not None and self.measured else {}

    @torch.no_grad()
    def at(self, lmbda: float, held_out: bool = False) -> RatePoint:
        """Round and code everything at a lambda: squared error per bit, summed over pixels and channels of all views.
        `held_out`: error and PSNR are of the held-out views, if there are any."""
        baked = self._baked
        pictures = self._held_out if held_out and self._held_out.views else self._pictures
        surfels = {**baked.scene.surfels, **self._view_colors(lmbda)}
        steps = self._noise.steps(lmbda / self._numbers if self.measured else 0.0)
        codes, order = code_surfels(surfels, baked.scene.view_color, self._sizes, baked.extent, steps)
        step = min(1000.0, max(0.01, 255 * math.sqrt(TEXEL_SHARE * 12 * lmbda / PER_BIT)))
        listed = decoded = means = self._residual[order]
        coverage, coded = self._coverage, None
        if self._tiles is not None:
            moved = self._tiles.rows_of(order.to(baked.device)).cpu()
            texels = baked.texels[moved, :3]
            coverage = coverage[moved]
            coder = TexelCoder(self._sizes[order], coverage[:, 1], step)
            alphas = None if baked.alpha is None else coder.code_alpha(baked.alpha.values[moved])
            coded, listed = coder.code(texels), joined(texels, alphas)
            decoded = joined(coded.texels(coder.blocks), alphas)
            means = coded.means
        scene = replace(baked.scene, surfels=codes.surfels())
        rounded = baked.become(
            Rounded,
            rows=baked.rows[order],
            in_front=baked.in_front[order],
            codes=codes,
            step=step,
            alpha_codes=None if baked.alpha is None else coded,
            coverage=coverage,
            **laid_out(scene, Tiles(self._sizes[order], codes.extent(baked.options.extent), listed), baked.options),
        )
        shown = replace(rounded, texels=decoded, scene=with_means(rounded.scene, means))
        drawn = pictures.of(shown.unquantised())
        return RatePoint(lmbda, rounded, coded, pictures.square(drawn), pictures.psnr(drawn))


def compacted(
    baked: Reduced,
    views: Sequence[View],
    background: Tensor,
    options: Compact | None = None,
    progress: Progress = no_progress,
    held_out: Sequence[View] = (),
) -> Rounded:
    """Round the surfels of a bake for a compact bundle, in Morton order, and choose the coding of the texels. Arguments
    as of `Coder`. Raises ValueError: the target cannot be reached."""
    options = options or Compact()
    coder = Coder(baked, views, background, options, progress, held_out)
    if options.most_bytes is not None:
        enough = coder.allowed(ENOUGH) if coder.measured else -math.inf
        most = 0.97 * options.most_bytes
        more, less = _search(
            coder, lambda point: 0.0 if point.bytes > most or point.error <= enough else math.inf, progress
        )
        chosen = more if more.bytes <= most else less
        if chosen.bytes > options.most_bytes:
            raise ValueError(
                f"{options.most_bytes:,} bytes are too few for {len(chosen.baked.rows):,} surfels, which take at least "
                f"{chosen.bytes:,} with their texels: ask for more, or train with fewer surfels"
            )
    elif not coder.measured:
        chosen = coder.at(START)
    elif options.psnr is not None:
        if coder.psnr < options.psnr:
            raise ValueError(
                f"the bake shows the training photographs at {coder.psnr:.2f} dB, {options.psnr:g} dB cannot be "
                "reached: ask for less, or train for longer"
            )
        lost = max(1e-6, coder.psnr - options.psnr)
        chosen, _ = _search(coder, lambda point: (coder.psnr - point.psnr) / lost, progress)
    else:
        added = coder.allowed(options.share) - coder.error
        chosen, _ = _search(coder, lambda point: (point.error - coder.error) / added, progress, most=MAX_LAMBDA)
    rounded = chosen.baked
    if options.most_bytes is not None:
        rounded = replace(rounded, most_bytes=options.most_bytes - rounded.codes.nbytes(), fill=chosen.error > enough)
    mse = max(0.0, chosen.error - coder.error) if coder.measured else None
    rounding = Rounding(mse=mse, steps=dict(rounded.codes.steps), alternatives=_alternatives(coder, chosen))
    return rounded.stating(rounding=rounding, view_color=_thinned(rounded))


def _alternatives(coder: Coder, chosen: RatePoint) -> list[tuple[float, float | None]] | None:
    """Measure relative bytes and PSNR at about half and twice the bytes; None without views."""
    if not coder.measured:
        return None
    alternatives = []
    base = coder.at(chosen.lmbda, held_out=True).psnr
    for wanted, factor in ALTERNATIVES.items():
        tried = [(0.0, 0.0)]  # logarithms of lambda and bytes over the chosen ones
        step = math.log(factor)
        for _ in range(_TRIES):
            point = coder.at(math.exp(step) * chosen.lmbda, held_out=True)
            tried.append((step, math.log(point.bytes / chosen.bytes)))
            if abs(tried[-1][1] - math.log(wanted)) < math.log(_CLOSE):
                break
            (a, low), (b, high) = sorted(tried, key=lambda pair: abs(pair[1] - math.log(wanted)))[:2]
            if low == high:
                break
            step = max(-12.0, min(12.0, a + (math.log(wanted) - low) * (b - a) / (high - low)))
        alternatives.append((point.bytes / chosen.bytes, point.psnr - base))
    return alternatives


def _search(
    coder: Coder, excess: Callable[[RatePoint], float], progress: Progress, most: float = math.inf
) -> tuple[RatePoint, RatePoint]:
    """Bisect lambda up to `most`, until the excess is 0.9 to 1: the last passing point (at
    most 1) and the first failing one, or the nearest tried."""
    low, high, points = None, None, {}
    lmbda = min(START, most)
    for step in range(_SEARCH):
        points[lmbda] = coder.at(lmbda)
        progress("choosing the precision", step + 1, _SEARCH)
        ratio = excess(points[lmbda])
        low, high = (lmbda, high) if ratio <= 1 else (low, lmbda)
        points = {tried: points[tried] for tried in {low, high, min(points), max(points)} - {None}}  # frees memory
        if low == most or 0.9 <= ratio <= 1:
            break
        least = low or lmbda / 8
        largest = high or min(most, lmbda * 8)
        # the excess is about proportional to lambda
        guess = 0.95 * lmbda / ratio if 0 < ratio < math.inf else 0.0
        if not 1.05 * least < guess < largest / 1.05:
            guess = math.sqrt(least * largest) if low and high else least if low is None else largest
        lmbda = guess
    progress("choosing the precision", _SEARCH, _SEARCH)
    return points[min(points) if low is None else low], points[max(points) if high is None else high]


def _thinned(baked: Rounded) -> ViewColorError | None:
    """Update the statistics of the view colours to the terms that are left, except the error."""
    stated, surfels = baked.statistics.view_color, baked.scene.surfels
    if stated is None:
        return None
    terms = surfels["view_terms"]
    return stated.replace(
        sites=stated.sites.replace(after=len(baked.rows) + len(terms)),
        one_color=int((surfels["view_span"][:, 1] == 0).sum()),
        bytes=stated.bytes and stated.bytes.replace(after=4 * (4 * len(baked.rows) + terms.numel())),
    )
