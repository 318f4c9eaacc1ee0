"""How precisely the numbers of surfels are kept: as the picture needs it, measured by drawing it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy.typing as npt
import torch
from torch import Tensor

from bitymi_ns.bake.surfel_codes import PARAMETERS, REFERENCE, SurfelCodes, code_surfels, reordered, term_numbers
from bitymi_ns.progress import Progress, no_progress
from bitymi_ns.scene.baked import BakedScene
from bitymi_ns.train.views import View

LEAST_ERROR = 1e-7
"""Mean square error that is always allowed, of colours from 0 to 1: 70 dB."""
MOST_SHARE = 0.1
"""Of the error that rounding makes so that surfels fit into a number of bytes."""
WIDEST, NARROWEST = 4.0, 1.0 / 64
"""Steps are chosen between these, in reference steps; beyond, errors are not proportional to them."""


@dataclass
class PrecisionOptions:
    """How precise surfels are kept."""

    share: float = 0.006
    """How much their rounding may add to the mean square error of the pictures against the photographs, as a share of
    it: 0.006 are 0.026 dB before the texels are tuned."""
    views: int = 8
    """Training views that are drawn, spread over all."""
    rounds: int = 3
    """How often the steps are corrected by the error of all of them together."""

    most_bytes: int | None = None
    """Surfels take no more than this, less their residuals: the share grows until they fit, up to `MOST_SHARE`. None =
    it stays."""

    def check(self) -> None:
        """Refuses values that make no sense."""
        if not 0 < self.share < 1 or self.views < 1 or self.rounds < 1:
            raise ValueError("share must lie between 0 and 1, views and rounds must be at least 1")


@torch.no_grad()
def choose_precision(
    scene: BakedScene,
    sizes: npt.ArrayLike,
    views: Sequence[View],
    background: Tensor,
    options: PrecisionOptions | None = None,
    progress: Progress = no_progress,
) -> tuple[SurfelCodes, Tensor, float]:
    """Codes of the surfels with the fewest bits whose rounding changes the pictures by no more than the options say.

    A column whose step is s adds D s^2 to the mean square error of the pictures, and halving s takes a bit per number.
    So the error is spread over the columns in proportion to their numbers. D is measured for each by drawing the
    training views with that column rounded alone.

    Args:
        scene: with lean view colours, on the CPU, of N surfels.
        sizes: [N, 2] sides of the tiles, texels; (0, 0) = none.
        views: training views; without any the reference steps are taken.
        background: [3] colour behind the scene.
        options: see `PrecisionOptions`.
        progress: called after every column.

    Returns:
        the codes, the row that each surfel was [N] int64, and the mean square error that the rounding makes.
    """
    options = options or PrecisionOptions()
    options.check()
    assert scene.extent is not None
    every = max(1, math.ceil(len(views) / options.views))
    chosen = [views[i] for i in range(0, len(views), every)]
    targets = [view.target(background.cpu(), "cpu") for view in chosen]
    masks = [None if view.mask is None else view.mask.cpu() for view in chosen]
    drawn = [scene.render(view.camera.to("cpu"), background.cpu()).rgb for view in chosen]

    def error(other: BakedScene, than: Sequence[Tensor]) -> float:
        pictures = (other.render(view.camera.to("cpu"), background.cpu()).rgb for view in chosen)
        return _mean([_square(picture, each, mask) for picture, each, mask in zip(pictures, than, masks, strict=True)])

    def coded(steps: Mapping[str, float]) -> tuple[SurfelCodes, Tensor]:
        return code_surfels(scene.surfels, scene.view_color, sizes, scene.extent, steps)

    codes, order = coded(REFERENCE)
    if not chosen:
        return codes, order, math.nan
    from_photographs = _mean([_square(*each) for each in zip(drawn, targets, masks, strict=True)])
    allowed = max(LEAST_ERROR, options.share * from_photographs)
    plain = _permuted(scene, order)
    noise, numbers = {}, {}
    for done, name in enumerate(REFERENCE):
        column = codes.codes[name]
        numbers[name] = len(column) * (3 if name == "place" else column.shape[1])
        noise[name] = error(_with_column(plain, codes, name), drawn) / codes.steps[name] ** 2 if len(column) else 0.0
        progress("rounding the surfels", done + 1, len(REFERENCE) + options.rounds)
    spread = allowed / max(1, sum(count for name, count in numbers.items() if noise[name] > 0))
    found = math.nan
    for step in range(options.rounds):
        steps = {name: _step(name, spread * numbers[name], noise[name]) for name in REFERENCE}
        codes, order = coded(steps)
        found = error(rounded_scene(_permuted(scene, order), codes), drawn)
        progress("rounding the surfels", len(REFERENCE) + step + 1, len(REFERENCE) + options.rounds)
        if 0.8 * allowed <= found <= allowed or found == 0:
            break
        spread *= min(8.0, max(1 / 8, 0.9 * allowed / found))
    return codes, order, found


def rounded_scene(scene: BakedScene, codes: SurfelCodes) -> BakedScene:
    """A scene whose surfels, in the order of the codes, have the values of the codes; tiles are as they are."""
    assert scene.extent is not None
    tiled = codes.codes["size"][:, 0] > 0
    extent = torch.where(torch.from_numpy(tiled), codes.extent(float(scene.extent.max())), scene.extent)
    return replace(scene, surfels=codes.surfels(), extent=extent)


def _permuted(scene: BakedScene, order: Tensor) -> BakedScene:
    moved = {name: getattr(scene, name) for name in ("tiles", "extent", "mean_residual")}
    moved = {name: None if value is None else value[order].contiguous() for name, value in moved.items()}
    return replace(scene, surfels=reordered(scene.surfels, order), **moved)


def _with_column(scene: BakedScene, codes: SurfelCodes, column: str) -> BakedScene:
    """The scene with one column rounded."""
    rounded = rounded_scene(scene, codes)
    if column == "extent":
        return replace(scene, extent=rounded.extent)
    name, values = PARAMETERS.get(column, column), rounded.surfels
    if column in ("term_shape", "term_color"):
        name = "view_terms"
        at = term_numbers(codes.kind)[column == "term_shape"]
        terms = scene.surfels[name].clone()
        terms[:, at] = values[name][:, at]
        values = {name: terms}
    return replace(scene, surfels={**scene.surfels, name: values[name]})


def _step(name: str, error: float, noise: float) -> float:
    """The step that adds this error."""
    wanted = math.sqrt(error / noise) / REFERENCE[name] if noise > 0 else WIDEST
    return REFERENCE[name] * min(WIDEST, max(NARROWEST, wanted))


def _square(rgb: Tensor, target: Tensor, mask: Tensor | None) -> float:
    difference = (rgb.clamp(0.0, 1.0) - target.clamp(0.0, 1.0)).square()
    if mask is None:
        return float(difference.mean())
    return float(difference[mask.reshape(mask.shape[:2])].mean()) if bool(mask.any()) else 0.0


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values)
