"""Exposure and white balance of the training photographs: a learned colour correction per photograph.

A photograph maps the scene's colour c to gain c, with a gain per channel, or to matrix c + offset. Corrections are
relative to the mean photograph: after every step log gains and other entries are shifted to sum to zero over the
photographs, so that they do not tint the scene. They are not part of the scene: a free camera shows the mean exposure;
`Exposure.at` interpolates that of a held-out photograph.

Gains are initialised from the colours of the sparse points. In logarithms, observation = point + photograph, solved by
alternating medians (median polish), which are robust to highlights, occluders and wrong points. Points occluded by
others in a photograph are ignored there.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from bitymi_ns.capture.order import Neighbours
from bitymi_ns.ops.backend import dense, kernel
from bitymi_ns.scene.camera import Camera
from bitymi_ns.train.config import ExposureKind
from bitymi_ns.train.processes import ALONE, Processes
from bitymi_ns.train.views import OnDemand, View, as_float

LIMIT = 2.0  # largest log gain: 7.4 times as bright, about 6 stops in gamma-encoded colours
OTHER_LIMIT = 0.5  # largest other entry of an affine correction
EXPLAINED = 0.1
"""`auto` corrects photographs if gains explain more than this share of their disagreement at the points."""
EXIF_SPREAD = 0.03  # without enough points, `auto` corrects photographs if their EXIF gains deviate by this (0.1 stop)
PRIOR_POINTS = 20  # weight of the EXIF prior (mean exposure if unknown), in points
BETAS = (0.9, 0.99)  # Adam's betas: a photograph is used once per epoch, so averages must be short
EPS = 1e-8  # Adam's epsilon
ENCODING = 2.2  # gamma of encoded colours

# comparison at the points
POINTS = 6000  # maximum number of points compared
HIDING = 100_000  # maximum number of points that may occlude them
OBSERVATIONS = 1_200_000  # maximum of points times photographs
SWEEPS = 10  # passes of the median polish
DARKEST, BRIGHTEST = 0.03, 0.97  # range of channels used: beyond it noise, rounding and clipping dominate
FEWEST_PHOTOGRAPHS = 3  # minimum number of photographs that show a point
CELL = 2.0  # side of the cells of the occlusion test, in mean distances of the points in the image
HIDDEN = 0.05  # an occluding point is nearer by this share of its depth, or of twice the view's depth range if less
FEWEST_TESTED = 1000  # minimum number of observations to test gains on the other half of the points


class Exposure:
    """Colour corrections of a run.

    Attributes:
        table: [V, 3] log gains; for affine corrections [V, 12], the rows of [matrix | offset] with log gains on the
            diagonal. None: no corrections.
        decided: True once `start` was called or a state loaded.
        reason: why photographs are corrected or not; empty until decided.
    """

    def __init__(
        self, kind: ExposureKind, exif: Sequence[float] | None = None, files: Sequence[Path] | None = None
    ) -> None:
        """
        Args:
            exif: log2 exposure of each training view (`exif_stops`), NaN: unknown; None: unknown for every view.
            files: photograph of each training view; views of one photograph share its correction. None: one view per
                photograph, and `at` returns None.
        """
        self.kind: ExposureKind = kind
        self.table: Tensor | None = None
        self.decided = kind == "off"
        self.reason = ""
        self._exif = exif
        rows = {file: row for row, file in enumerate(dict.fromkeys(files or ()))}
        self._photographs = None if files is None else [rows[file] for file in files]
        self._neighbours = Neighbours(list(rows))
        # Adam's moments [V, ...] and number of steps; photographs that a step does not use keep their moments
        self._moments: tuple[Tensor, Tensor] | None = None
        self._steps = 0
        self._learning: list[tuple[int, Tensor]] = []

    def start(self, points: Tensor, views: Sequence[View], near: float) -> None:
        """Decide whether to correct photographs, and initialise the corrections.

        Args:
            points: [M, 3] points of the scene, best those of the capture.
            views: training photographs at full size.
            near: near plane, camera z.
        """
        self.decided = True
        agreement = estimate_gains(points, views, near)
        prior = self._pooled(seeds(self._exif, len(views)), torch.ones(len(views)))
        if self.kind == "auto":
            if math.isnan(agreement.explained):
                enabled = float(prior.std(0, correction=0).max()) > EXIF_SPREAD
                self.reason = "their EXIF exposures " + ("differ" if enabled else "do not differ, or are unknown")
            else:
                enabled = agreement.explained > EXPLAINED
                self.reason = f"gains explain {max(0.0, agreement.explained):.0%} of how far they differ at the points"
            if not enabled:
                return
        else:
            self.reason = "as asked for"
        points_seen = agreement.points.float()
        log_gains = self._pooled(agreement.log_gains, points_seen)
        seen = self._summed(points_seen[:, None])
        gains = (seen * log_gains + PRIOR_POINTS * prior) / (seen + PRIOR_POINTS)
        self._begin(gains.to(points.device), affine=self.kind == "affine")

    def _summed(self, values: Tensor) -> Tensor:
        """Sum values [V, C] of the views of each photograph."""
        if self._photographs is None:
            return values
        rows = torch.tensor(self._photographs)
        return values.new_zeros(self.count(len(values)), values.shape[1]).index_add_(0, rows, values)

    def _pooled(self, values: Tensor, weights: Tensor) -> Tensor:
        """Average values [V, C] over the views of each photograph with weights [V]; 0 if all weights are 0."""
        if self._photographs is None:
            return values
        weights = weights[:, None]
        return self._summed(values * weights) / self._summed(weights).clamp(min=1e-6)

    def count(self, views: int) -> int:
        """Count the photographs of `views` views."""
        return views if self._photographs is None else max(self._photographs, default=-1) + 1

    def _begin(self, log_gains: Tensor, affine: bool) -> None:
        first = log_gains.new_zeros(len(log_gains), 12 if affine else 3)
        first[:, _diagonal(first)] = log_gains
        self.table = settled(first)
        self._moments, self._steps = (torch.zeros_like(self.table), torch.zeros_like(self.table)), 0

    @property
    def sentence(self) -> str:
        """Message for the console: corrections and their reason; empty without corrections."""
        gains = self.log_gains
        if gains is None:
            return ""
        spread = f"{math.expm1(float(gains.std(correction=0))):.0%}"
        return f"The exposure of each photograph is learned, they differ by {spread}: {self.reason}."

    @property
    def log_gains(self) -> Tensor | None:
        """Log gains [V, 3]; None: no corrections."""
        return None if self.table is None else self.table[:, _diagonal(self.table)]

    def begin(self) -> None:
        """Discard corrections that `learning` returned in an unfinished step."""
        self._learning = []

    def of(self, number: int) -> Tensor | None:
        """Return the correction of a training view: [3] gains, or [3, 4] matrix and offset; None: no correction."""
        return None if self.table is None else _correction(self.table[self._row(number)])

    def learning(self, number: int, correction: Tensor | None) -> Tensor | None:
        """Return the correction of a training view for a step, from `of`, as a leaf that gets a gradient."""
        if correction is None or self.table is None:
            return correction
        leaf = correction.detach().requires_grad_()
        self._learning.append((self._row(number), leaf))
        return leaf

    def _row(self, number: int) -> int:
        return number if self._photographs is None else self._photographs[number]

    @torch.no_grad()
    def at(self, file: Path | None) -> Tensor | None:
        """Return the correction of a photograph of the capture, as `of` does: its own, or interpolated between training
        photographs (`Neighbours`) as log gains and other entries. None: mean exposure."""
        found = None if file is None else self._neighbours.of(file)
        if self.table is None or found is None:
            return None
        before, after, share = found
        return _correction(torch.lerp(self.table[before], self.table[after], share))

    @torch.no_grad()
    def step(self, rate: float, processes: Processes = ALONE) -> None:
        """Update the corrections that `learning` returned by their gradients.

        Args:
            rate: learning rate of log gains and other entries.
            processes: of the run, whose views the step averages over.
        """
        learning, self._learning = self._learning, []
        if self.table is None or self._moments is None:
            return
        rows = [(row, leaf.grad.flatten()) for row, leaf in learning if leaf.grad is not None]
        if processes.views > 1:
            rows = self._averaged(rows, processes)
        if not rows:
            return
        self._steps += 1
        mean, square = self._moments
        for number, (row, gradient) in enumerate(rows):
            kernel("learn_exposure", self.table)(
                table=self.table,
                mean=mean,
                square=square,
                gradient=dense(gradient, self.table),
                photographs=len(self.table),
                width=self.table.shape[1],
                number=row,
                settle=int(number + 1 == len(rows)),
                rate=rate,
                beta1=BETAS[0],
                beta2=BETAS[1],
                eps=EPS,
                step=self._steps,
                limit=LIMIT,
                other_limit=OTHER_LIMIT,
            )

    def _averaged(self, rows: Sequence[tuple[int, Tensor]], processes: Processes) -> list[tuple[int, Tensor]]:
        """Average gradients, by row of the table, over all views of the step."""
        assert self.table is not None
        sums = self.table.new_zeros(len(self.table), self.table.shape[1] + 1)  # and the number of views
        for row, gradient in rows:
            sums[row, :-1] += gradient
            sums[row, -1] += 1.0
        processes.sum(sums)
        seen = sums[:, -1].nonzero().flatten().tolist()
        return [(row, sums[row, :-1] / processes.views) for row in seen]

    def state_dict(self) -> dict[str, Any]:
        """Return the state for a resumed run: tensors, numbers and strings only."""
        return {
            "kind": self.kind,
            "decided": self.decided,
            "finding": self.reason,
            "table": None if self.table is None else self.table.clone(),
            "optimizer": self._optimizer_state(),
        }

    def _optimizer_state(self) -> dict[str, Any] | None:
        """Return Adam's state in the form of torch's optimisers."""
        if self._moments is None:
            return None
        mean, square = (moment.clone() for moment in self._moments)
        state = {0: {"step": self._steps, "exp_avg": mean, "exp_avg_sq": square}} if self._steps else {}
        return {"state": state, "param_groups": [{"lr": 0.0, "betas": BETAS, "eps": EPS, "params": [0]}]}

    def load_state_dict(
        self, state: Mapping[str, Any] | None, count: int, device: torch.device | str | None = None
    ) -> None:
        """Restore what `state_dict` returned. Ignores state saved with another option or number of photographs.

        Args:
            state: None: saved before corrections existed. Then, and after `off`, `auto` makes none.
            count: number of training views.
            device: of the corrections; None: that of `state`.
        """
        if state is None or (self.kind == "auto" and state["kind"] == "off"):  # corrections do not begin midway
            self.decided = self.kind in ("off", "auto")
            return
        table = state["table"]
        if state["kind"] != self.kind or (table is not None and len(table) != self.count(count)):
            return
        self.decided, self.reason = bool(state["decided"]), str(state["finding"])
        if table is None:
            self.table = self._moments = None
            return
        self._begin(table[:, _diagonal(table)].to(device or table.device), table.shape[1] > 3)
        assert self.table is not None and self._moments is not None
        self.table.copy_(table)
        saved = state["optimizer"]["state"].get(0)
        if saved is not None:
            self._steps = int(saved["step"])
            for moment, name in zip(self._moments, ("exp_avg", "exp_avg_sq"), strict=True):
                moment.copy_(saved[name].to_dense())


def restored(state: Mapping[str, Any] | None, views: int, files: Sequence[Path] | None = None) -> Exposure:
    """Restore the corrections of a finished run of `views` training views; none if their number differs."""
    exposure = Exposure("off" if state is None else state["kind"], files=files)
    exposure.load_state_dict(state, views)
    return exposure


def corrected(
    views: Sequence[View], state: Mapping[str, Any] | None, files: Sequence[Path] | None = None
) -> Sequence[View]:
    """Add the final corrections of a run to its training views.

    Args:
        views: of the run, at full size.
        state, files: of its `Exposure`; state None: no corrections.

    Raises:
        ValueError: the number of photographs differs from the run's.
    """
    if state is None or state["table"] is None:
        return views
    exposure = restored(state, len(views), files)
    if exposure.table is None:
        count = exposure.count(len(views))
        raise ValueError(
            f"training learned the exposure of {len(state['table'])} photographs, and now there are {count}: restore "
            "the capture, or leave the texels as they are baked (--finetune-steps 0)"
        )
    with torch.no_grad():
        found = [exposure.of(i) for i in range(len(views))]
    return OnDemand(len(views), lambda i: views[i]._replace(correction=found[i]))


def settled(table: Tensor) -> Tensor:
    """Project a table [V, 3] or [V, 12] to an admissible one: finite, columns of mean 0 and within their limits."""
    limit = table.new_full(table.shape[1:], OTHER_LIMIT)
    limit[_diagonal(table)] = LIMIT
    table = torch.maximum(torch.minimum(table.detach().nan_to_num(0.0), limit), -limit)
    table = table - table.mean(0)
    return table / (table.abs().amax(0) / limit).clamp(min=1.0)


def _correction(row: Tensor) -> Tensor:
    """Convert a row of the table to gains [3], or matrix and offset [3, 4]."""
    if row.numel() == 3:
        return row.exp()
    gains = torch.zeros(12, dtype=torch.bool, device=row.device)
    gains[_diagonal(row)] = True
    return torch.where(gains, torch.where(gains, row, 0.0).exp(), row).view(3, 4)


def _diagonal(table: Tensor) -> slice:
    """Select the columns of the log gains. A slice, because an index list would be copied to the GPU in every step."""
    return slice(None) if table.shape[-1] == 3 else slice(0, None, 5)


def seeds(stops: Sequence[float] | None, count: int) -> Tensor:
    """Compute initial log gains [V, 3] from EXIF exposures, for gamma-encoded colours; 0 if unknown.

    Args:
        stops: `exif_stops` of each photograph, NaN: unknown; None: unknown for all.
        count: number of photographs.
    """
    if stops is None:
        return torch.zeros(count, 3)
    light = torch.tensor(stops, dtype=torch.float64) * math.log(2.0)
    light = torch.where(light.isfinite(), light, math.nan) / ENCODING
    return settled((light - light.nanmean()).nan_to_num(0.0).float()[:, None].expand(-1, 3))


class ExposureGains(NamedTuple):
    """Gains of the photographs, and how well they explain the colour differences."""

    log_gains: Tensor  # [V, 3] float32 natural logarithm of each photograph's gain per channel; each channel has mean 0
    points: Tensor  # [V] int64, number of points used for each photograph
    # share by which gains reduce the median deviation of log colours from their point's median, measured on points not
    # used for the gains; NaN: too few points, or no deviation
    explained: float


@torch.no_grad()
def estimate_gains(points: Tensor, views: Sequence[View], near: float) -> ExposureGains:
    """Estimate the photographs' gains from their colours at the points.

    Args:
        points: [M, 3] world positions.
        views: V photographs at full size, each read once; masked and transparent pixels are ignored.
        near: near plane, camera z.
    """
    order = torch.randperm(len(points), generator=torch.Generator().manual_seed(0))[:HIDING]
    points = points.detach()[order.to(points.device)]
    count = min(len(points), POINTS, max(1, OBSERVATIONS // max(1, len(views))))
    logs = torch.full((len(views), count, 3), math.nan)
    for row, view in enumerate(views):
        logs[row] = _log_colors(view, points, count, near).cpu()
    logs = logs[:, logs.isfinite().all(-1).sum(0) >= FEWEST_PHOTOGRAPHS]
    count = logs.isfinite().all(-1).sum(1)
    half, other = logs[:, ::2], logs[:, 1::2]
    explained = math.nan
    if int(other.isfinite().sum()) >= FEWEST_TESTED and (before := _disagreement(other)) > 0.0:
        explained = 1.0 - _disagreement(other - _log_gains(half)[:, None]) / before
    return ExposureGains(_log_gains(logs), count, explained)


def _log_colors(view: View, points: Tensor, count: int, near: float) -> Tensor:
    """Read the log colours [count, 3] of a view at the first `count` points; NaN if occluded by any of the points,
    masked, transparent or out of range."""
    camera = view.camera.to(points.device)
    x, y, z, inside = camera.project(points, near)
    side = max(2.0, CELL * math.sqrt(camera.width * camera.height / max(1, int(inside.sum()))))
    columns, rows = math.ceil(camera.width / side), math.ceil(camera.height / side)
    cell = (y / side).long().clamp(0, rows - 1) * columns + (x / side).long().clamp(0, columns - 1)
    nearest = torch.full((rows * columns,), math.inf, device=z.device)
    nearest = nearest.scatter_reduce(0, cell[inside], z[inside], "amin").view(1, 1, rows, columns)
    around = -max_pool2d(-nearest, 3, stride=1, padding=1).flatten()
    depths = z[inside].sort().values if bool(inside.any()) else z.new_zeros(1)
    spread = depths[int(0.99 * (len(depths) - 1))] - depths[int(0.01 * (len(depths) - 1))]
    shown = inside & (z <= around[cell] + HIDDEN * torch.minimum(around[cell], 2.0 * spread))

    color = as_float(_pixels(view.image, camera, x[:count], y[:count]))
    shown = shown[:count].to(color.device)
    if color.shape[-1] == 4:
        shown = shown & (color[:, 3] > 0.99)
    if view.mask is not None:
        shown = shown & _pixels(view.mask, camera, x[:count], y[:count]).flatten().bool()
    color = color[:, :3]
    counts = shown[:, None] & (color > DARKEST) & (color < BRIGHTEST)
    return torch.where(counts, color.log(), math.nan)


def _pixels(image: Tensor, camera: Camera, x: Tensor, y: Tensor) -> Tensor:
    """Read pixels [C, ...] of an image [H, W, ...] at positions in a camera's image, whose size may differ."""
    at = (
        (along.nan_to_num(0.0) * size / full).long().clamp(0, size - 1).to(image.device)
        for along, size, full in zip((y, x), image.shape[:2], (camera.height, camera.width), strict=True)
    )
    return image[tuple(at)]


def _log_gains(logs: Tensor) -> Tensor:
    """Compute log gains [V, 3] by median polish, mean 0 per channel; 0 for photographs without points."""
    gains = torch.zeros(len(logs), 3)
    if logs.shape[1] == 0:
        return gains
    for _ in range(SWEEPS):
        colors = _median(logs - gains[:, None], 0)
        gains = _median(logs - colors, 1).nan_to_num(0.0)
        gains -= gains.mean(0)
    return gains


def _disagreement(logs: Tensor) -> float:
    """Compute the median deviation of the observations from their point's median."""
    apart = (logs - _median(logs, 0)).abs()
    return float(_median(apart[apart.isfinite()], 0))


def _median(values: Tensor, dim: int) -> Tensor:
    """Compute the median along a dimension without NaN, the mean of the middle two for even counts; NaN if empty.

    torch's lower median would overestimate differences between photographs for even counts."""
    if values.shape[dim] == 0:
        return torch.full_like(values.sum(dim), math.nan)
    return 0.5 * (values.nanmedian(dim).values - (-values).nanmedian(dim).values)
