"""From a bake to what a compact bundle keeps of it: one price of a bit decides how precise everything is."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from bitymi_ns.bake.baked import Baked
from bitymi_ns.bake.early_stopping import FEWEST_VIEWS, set_aside
from bitymi_ns.bake.precision import PER_BIT, Pictures, column_noise
from bitymi_ns.bake.texel_list import TexelList
from bitymi_ns.bake.tiles import Tiles
from bitymi_ns.bake.view_color_rate import color_choices
from bitymi_ns.bundle.statistics import Rounding, ViewColorError
from bitymi_ns.codec.packing import pack
from bitymi_ns.codec.pages import listed_texels, paged_texels
from bitymi_ns.codec.surfel_codes import code_surfels
from bitymi_ns.codec.texel_codes import (
    RESIDUAL_STEP,
    SceneCodes,
    TexelCodeOptions,
    TexelCoder,
    TexelCodes,
    residual_codes,
)
from bitymi_ns.progress import Progress, no_progress
from bitymi_ns.scene.baked import BakedScene
from bitymi_ns.train.views import View

START = 8.0 / 255**2
"""Price that is looked at first: squared error that a bit is worth, colours from 0 to 1."""
MOST_PRICE = 4.0 / 255**2
"""The price is no larger where a share of the error decides: much of a large error is what no texel mends, such as of
exposure, and does not hide that of rounding; and texels learn little behind steps above the 4.2 of 255 that this is."""
TEXEL_SHARE = 0.5
"""Of the error that a bit is worth elsewhere, what it is worth in texels, which are tuned after it."""
ENOUGH = 0.002
"""Share of the error (0.009 dB) that may be added even where a size is asked for: finer is not worth bytes."""
LEAST_ERROR = 1e-7
"""Mean square error that is always allowed, of colours from 0 to 1: 70 dB."""
_SEARCH = 7
_CPU = torch.device("cpu")
_FAST = 9


@dataclass(frozen=True)
class Compact:
    """How small and how exact a compact bundle is.

    Attributes:
        share: how much it may add to the mean square error of the pictures against the training photographs, as a share
            of it, before the texels are tuned; less where the price would be above `MOST_PRICE`.
        most_bytes: as small as it takes for surfels and texels to be no more than this, or smaller where more would add
            no more than `ENOUGH` of the error; None = `share` decides.
        psnr: as small as it may be for the training photographs to be shown at so many dB, before the texels are tuned;
            None = `share` decides.
        views: training views that are drawn, spread over all.
        held_in_every: as in `tune.TuneOptions`: views that are set aside do not weigh texels.
    """

    share: float = 0.03
    most_bytes: int | None = None
    psnr: float | None = None
    views: int = 8
    held_in_every: int = 8

    def check(self) -> None:
        """Refuses values that make no sense."""
        if not 0 < self.share < 1 or self.views < 1:
            raise ValueError(f"the share of the error must lie between 0 and 1, not at {self.share}")
        if self.most_bytes is not None and self.psnr is not None:
            raise ValueError("bytes and PSNR cannot be asked for together")


@dataclass(frozen=True)
class Priced:
    """What a price gives.

    Attributes:
        baked: with the surfels that are kept, and their codes; its texels are as they were.
        coding: of the texels.
        shown: the scene as it is drawn then, its texels coded.
        bytes: of surfels and texels, about.
        error: mean square error against the training photographs.
        psnr: of them, dB.
    """

    baked: Baked
    coding: TexelCodeOptions
    shown: BakedScene
    bytes: int
    error: float
    psnr: float


class Coder:
    """Everything that is measured once."""

    def __init__(
        self,
        baked: Baked,
        views: Sequence[View],
        background: Tensor,
        options: Compact,
        progress: Progress = no_progress,
        device: torch.device = _CPU,
    ) -> None:
        """
        Args:
            baked: with lean view colours, on the CPU.
            views: training views; without any the reference steps are taken.
            background: [3] colour behind the scene.
            options: see `Compact`.
            progress: called on the way.
            device: where views are drawn and weighed.
        """
        options.check()
        self._baked, self._pictures = baked, Pictures(views, background, options.views, device)
        scene = baked.unquantised()
        self._sizes = torch.from_numpy(baked.packing.tiles[:, 3:]).long()
        drawn = self._pictures.of(scene)
        self.error, self.psnr = self._pictures.square(drawn), self._pictures.psnr(drawn)
        rows = set_aside(len(views), options.held_in_every)[1] if len(views) >= FEWEST_VIEWS else range(len(views))
        learned = [views[row] for row in rows]
        self._numbers = self._pictures.numbers / max(1, self._pictures.views) * len(learned)
        self._colors = color_choices(scene, [view.camera.to(device) for view in learned], progress)
        reduced = replace(scene, surfels={**scene.surfels, **self._colors.at(START)})
        self._noise = column_noise(reduced, self._sizes, self._pictures, progress)
        self._tiles = self._texels = self._weights = None
        if baked.texels is not None:
            texels = TexelList(baked, device)
            self._tiles, self._texels = texels.tiles, texels.values.cpu()
            self._weights = texels.coverage(learned, progress, squared=True).cpu()

    @property
    def measured(self) -> bool:
        """Whether there are views to measure with."""
        return self._pictures.views > 0

    def allowed(self, share: float) -> float:
        """The mean square error against the photographs, where so much of that of the bake may be added."""
        return self.error + max(LEAST_ERROR, share * self.error)

    @torch.no_grad()
    def at(self, price: float) -> Priced:
        """What is kept where a bit is worth `price`: squared error, colours from 0 to 1, summed over the pixels and
        channels of all views."""
        baked = self._baked
        surfels = dict(baked.scene.surfels)
        if self.measured:
            surfels |= self._colors.at(price)
        steps = self._noise.steps(price / self._numbers if self.measured else 0.0)
        codes, order = code_surfels(surfels, baked.scene.view_color, self._sizes, baked.extent, steps)
        packing = pack(codes.sizes, baked.options.page_width, baked.options.page_rows)
        residual = baked.mean_residual[order]
        texels = pages = None
        if self._texels is not None:
            moved = self._tiles.rows_of(order.to(self._tiles.size.device)).cpu()
            texels, weights = self._texels[moved], self._weights[moved]
            pages = paged_texels(texels, packing)
        kept = SceneCodes(
            codes, None, residual_codes(residual), RESIDUAL_STEP, baked.options.page_width, baked.options.page_rows
        )
        in_front = None if baked.in_front is None else baked.in_front[order]
        rounded = replace(baked, rows=baked.rows[order], codes=kept, in_front=in_front).with_surfels(codes.surfels())
        rounded = rounded.with_tiles(Tiles(packing, pages, codes.extent(baked.options.extent), residual))
        coding = TexelCodeOptions(step=min(1000.0, max(0.01, 255 * math.sqrt(TEXEL_SHARE * 12 * price / PER_BIT))))
        size, shown = kept.surfels.nbytes(), rounded
        if texels is not None:
            coded = TexelCoder(self._sizes[order], weights, coding).code(texels)
            size, shown = size + coded.nbytes(_FAST), _with_texels(rounded, coded)
        scene = shown.unquantised()
        pictures = self._pictures.of(scene)
        return Priced(rounded, coding, scene, size, self._pictures.square(pictures), self._pictures.psnr(pictures))


def compacted(
    baked: Baked,
    views: Sequence[View],
    background: Tensor,
    options: Compact | None = None,
    progress: Progress = no_progress,
    device: torch.device = _CPU,
) -> tuple[Baked, TexelCodeOptions]:
    """A bake whose surfels have the values that a compact bundle keeps, in its order, and how its texels are to be
    coded: by `tune.tune_atlas` or `with_coded_texels`.

    Args:
        baked: with lean view colours, on the CPU.
        views: training views; without any the reference steps are taken.
        background: [3] colour behind the scene.
        options: see `Compact`.
        progress: called on the way.
        device: where views are drawn and weighed.

    Raises:
        ValueError: an option is out of range, or what is asked for cannot be had.
    """
    options = options or Compact()
    return chosen(Coder(baked, views, background, options, progress, device), options, progress)


def chosen(coder: Coder, options: Compact, progress: Progress = no_progress) -> tuple[Baked, TexelCodeOptions]:
    """What `compacted` returns, of what is measured already.

    Args:
        coder: measured with options that differ at most in what decides the price.
        options: see `Compact`.
        progress: called on the way.

    Raises:
        ValueError: as `compacted` does.
    """
    if options.most_bytes is not None:
        enough = coder.allowed(ENOUGH) if coder.measured else -math.inf
        most = 0.97 * options.most_bytes
        more, less = _search(coder, lambda priced: priced.bytes > most or priced.error <= enough, progress)
        found = more if more.bytes <= most else less
        if found.baked.codes.surfels.nbytes() + LEAST_TEXEL_BYTES > options.most_bytes:
            raise ValueError(
                f"{options.most_bytes:,} bytes are too few for {len(found.baked.rows):,} surfels, which take "
                f"{found.baked.codes.surfels.nbytes():,}: ask for more, or train with fewer surfels"
            )
    elif not coder.measured:
        found = coder.at(START)
    elif options.psnr is not None:
        if coder.psnr < options.psnr:
            raise ValueError(
                f"the bake shows the training photographs at {coder.psnr:.2f} dB, so {options.psnr:g} dB cannot be "
                "had: ask for less, or train for longer"
            )
        found, _ = _search(coder, lambda priced: priced.psnr >= options.psnr, progress)
    else:
        allowed = coder.allowed(options.share)
        found, _ = _search(coder, lambda priced: priced.error <= allowed, progress, most=MOST_PRICE)
    baked, coding = kept_at(coder, found)
    if options.most_bytes is not None:
        assert baked.codes is not None
        coding = replace(coding, most_bytes=options.most_bytes - baked.codes.surfels.nbytes())
    return baked, coding


def kept_at(coder: Coder, priced: Priced) -> tuple[Baked, TexelCodeOptions]:
    """The bake at a price, which states what it costs, and how its texels are to be coded."""
    rounded = priced.baked
    assert rounded.codes is not None
    mse = priced.error - coder.error if coder.measured else None
    rounding = Rounding(mse=mse if mse is None else max(0.0, mse), steps=dict(rounded.codes.surfels.steps))
    statistics = rounded.statistics.but(rounding=rounding, error=None, certificate=None, view_color=_thinned(rounded))
    return replace(rounded, statistics=statistics), priced.coding


LEAST_TEXEL_BYTES = 1000


def _search(
    coder: Coder, more: Callable[[Priced], bool], progress: Progress, most: float = math.inf
) -> tuple[Priced, Priced]:
    """The largest price up to `most` of which `more` holds, and the smallest of which it does not, a tenth apart. Where
    there is none of a kind, the nearest that was looked at stands for it."""
    low, high, found = None, None, {}
    price = min(START, most)
    for step in range(_SEARCH):
        found[price] = coder.at(price)
        progress("choosing the precision", step + 1, _SEARCH)
        if more(found[price]):
            low = price
        else:
            high = price
        if low == most:
            break
        if low is None or high is None:
            price = min(most, price * 8) if high is None else price / 8
        else:
            price = math.sqrt(low * high)
    progress("choosing the precision", _SEARCH, _SEARCH)
    return found[min(found) if low is None else low], found[max(found) if high is None else high]


def with_coded_texels(baked: Baked, options: TexelCodeOptions | None = None) -> Baked:
    """A bake with rounded surfels whose texels, all of which count the same, are coded as well."""
    assert baked.codes is not None
    if baked.texels is None:
        return baked
    texels = listed_texels(baked.texels, baked.packing, baked.mean_residual)
    options = options or TexelCodeOptions()
    coder = TexelCoder(torch.from_numpy(baked.packing.tiles[:, 3:]), torch.ones(len(texels)), options)
    coded = coder.code(texels) if options.most_bytes is None else coder.fit(texels, options.most_bytes)
    return baked.with_texel_codes(coded, texels)


def _thinned(baked: Baked) -> ViewColorError | None:
    """What is stated of the view colours, with the terms that are left; its error stays that of their reduction."""
    stated, surfels = baked.statistics.view_color, baked.scene.surfels
    if stated is None:
        return None
    terms = surfels["view_terms"]
    return stated.but(
        sites=stated.sites.but(after=len(baked.rows) + len(terms)),
        one_color=int((surfels["view_span"][:, 1] == 0).sum()),
        bytes=stated.bytes and stated.bytes.but(after=4 * (4 * len(baked.rows) + terms.numel())),
    )


def _with_texels(baked: Baked, coded: TexelCodes) -> Baked:
    """The bake as it is drawn with coded texels."""
    return replace(baked, texels=paged_texels(coded.texels(), baked.packing)).with_mean_residual(coded.constants)
