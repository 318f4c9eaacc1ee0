"""Exposure and white balance of the training photographs: a learned colour correction per photograph.

A photograph maps the scene's colour c to gain * c, with a gain per channel, or to matrix @ c + offset. Log gains and
other entries sum to zero over the photographs, so that they do not tint the scene: a free camera shows the mean.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from bitymi_ns.capture.order import Neighbours
from bitymi_ns.ops.backend import dense, kernel
from .config import ExposureKind
from .gains import estimate_gains
from .processes import ALONE, Processes
from .views import OnDemand, View

LIMIT = 2.0  # largest log gain: 7.4 times as bright, about 6 stops in gamma-encoded colours
OTHER_LIMIT = 0.5  # largest other entry of an affine correction
EXPLAINED = 0.1
"""`auto` corrects photographs if gains explain more of their disagreement at the points (`gains`)."""
EXIF_SPREAD = 0.03  # without enough points, `auto` corrects if EXIF gains deviate by this (0.1 stop)
PRIOR_POINTS = 20  # weight of the EXIF prior (mean exposure if unknown), in points
BETAS = (0.9, 0.99)  # of Adam: averages are short, as a photograph is used once per epoch
EPS = 1e-8  # of Adam
ENCODING = 2.2  # gamma of encoded colours


class Exposure:
    """Colour corrections of a run.

    Attributes:
        table: [V, 3] log gains of V photographs; affine: [V, 12], rows of [matrix | offset], log gains on the diagonal.
            None: no corrections.
        decided: True once `start` was called or a state loaded.
        reason: why photographs are corrected or not; empty until decided.
    """

    def __init__(
        self, kind: ExposureKind, exif: Sequence[float] | None = None, files: Sequence[Path] | None = None
    ) -> None:
        """
        Args:
            exif, files: as in `TrainingData`; views of one photograph share its correction. Without files `at` returns
                None.
        """
        self.kind: ExposureKind = kind
        self.table: Tensor | None = None
        self.decided = kind == "off"
        self.reason = ""
        self._exif = exif
        rows = {file: row for row, file in enumerate(dict.fromkeys(files or ()))}
        self._photographs = None if files is None else [rows[file] for file in files]
        self._neighbours = Neighbours(list(rows))
        # Adam's moments [2, V, ...] and number of steps; photographs that a step does not use keep their moments
        self._moments: Tensor | None = None
        self._steps = 0
        self._learning: list[tuple[int, Tensor]] = []

    def start(self, points: Tensor, views: Sequence[View], near: float) -> None:
        """Decide whether to correct photographs, and initialise the corrections. Arguments as of `estimate_gains`."""
        self.decided = True
        agreement = estimate_gains(points, views, near)
        prior = self._pooled(exif_gains(self._exif, len(views)), torch.ones(len(views)))
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
        gains = gains.to(points.device)
        table = gains.new_zeros(len(gains), 12 if self.kind == "affine" else 3)
        table[:, _diagonal(table)] = gains
        self.table = settled(table)
        self._moments = table.new_zeros(2, *table.shape)
        self._steps = 0

    def _summed(self, values: Tensor) -> Tensor:
        """Sum values [V, C] of the views of each photograph."""
        if self._photographs is None:
            return values
        rows = torch.tensor(self._photographs)
        return values.new_zeros(self.count(len(values)), values.shape[1]).index_add_(0, rows, values)

    def _pooled(self, values: Tensor, weights: Tensor) -> Tensor:
        """Average values [V, C] over the views of each photograph with weights [V]; 0 where they are 0."""
        if self._photographs is None:
            return values
        weights = weights[:, None]
        return self._summed(values * weights) / self._summed(weights).clamp(min=1e-6)

    def count(self, views: int) -> int:
        """Count the photographs of `views` views."""
        return views if self._photographs is None else max(self._photographs, default=-1) + 1

    @property
    def sentence(self) -> str:
        """Describe the corrections and their reason; empty without corrections."""
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
        photographs (`Neighbours`). None: mean exposure."""
        neighbours = None if file is None else self._neighbours.of(file)
        if self.table is None or neighbours is None:
            return None
        before, after, weight = neighbours
        return _correction(torch.lerp(self.table[before], self.table[after], weight))

    @torch.no_grad()
    def step(self, rate: float, processes: Processes = ALONE) -> None:
        """Update the corrections that `learning` returned by their gradients, averaged over all views of the step."""
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
        """Return the state for a resumed run, Adam's in the form of torch's optimisers."""
        adam = None
        if self._moments is not None:
            mean, square = (moment.clone() for moment in self._moments)
            moments = {0: {"step": self._steps, "exp_avg": mean, "exp_avg_sq": square}} if self._steps else {}
            adam = {"state": moments, "param_groups": [{"lr": 0.0, "betas": BETAS, "eps": EPS, "params": [0]}]}
        return {
            "kind": self.kind,
            "decided": self.decided,
            "finding": self.reason,
            "table": None if self.table is None else self.table.clone(),
            "optimizer": adam,
        }

    def load_state_dict(
        self, state: Mapping[str, Any] | None, views: int | None = None, device: torch.device | str | None = None
    ) -> None:
        """Restore what `state_dict` returned; ignores state saved with another option or number of photographs.
        `state`: None: saved before corrections existed. Then, and after `off`, `auto` makes none. `views`: number of
        training views; None: as then. `device`: None: that of `state`."""
        if state is None or (self.kind == "auto" and state["kind"] == "off"):  # corrections do not begin midway
            self.decided = self.kind in ("off", "auto")
            return
        table = state["table"]
        if state["kind"] != self.kind or (table is not None and views is not None and len(table) != self.count(views)):
            return
        self.decided, self.reason = bool(state["decided"]), str(state["finding"])
        if table is None:
            self.table = self._moments = None
            return
        self.table = table = table.to(device or table.device, copy=True)
        moments, self._steps = table.new_zeros(2, *table.shape), 0
        if saved := state["optimizer"]["state"].get(0):
            moments.copy_(torch.stack([saved[name].to_dense() for name in ("exp_avg", "exp_avg_sq")]))
            self._steps = int(saved["step"])
        self._moments = moments


def restored(state: Mapping[str, Any] | None, views: int, files: Sequence[Path] | None = None) -> Exposure:
    """Restore the corrections of a finished run; none if it had another number than `views` of training views."""
    exposure = Exposure("off" if state is None else state["kind"], files=files)
    exposure.load_state_dict(state, views)
    return exposure


def corrected(
    views: Sequence[View], state: Mapping[str, Any] | None, files: Sequence[Path] | None = None
) -> Sequence[View]:
    """Add the final corrections of a run to its training views at full size. `state`, `files`: of its `Exposure`.
    Raises ValueError: the number of photographs differs from the run's."""
    if state is None or state["table"] is None:
        return views
    exposure = restored(state, len(views), files)
    if exposure.table is None:
        count = exposure.count(len(views))
        raise ValueError(
            f"training learned the exposure of {len(state['table'])} photographs, and now there are {count}: restore "
            "the capture, or do not tune the texels (--finetune-steps 0)"
        )
    with torch.no_grad():
        corrections = [exposure.of(i) for i in range(len(views))]
    return OnDemand(len(views), lambda i: views[i]._replace(correction=corrections[i]))


def settled(table: Tensor) -> Tensor:
    """Project a table to an admissible one: finite, columns of mean 0 and within their limits."""
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
    """Select the columns of the log gains: by a slice, as an index list is copied to the GPU in every step."""
    return slice(None) if table.shape[-1] == 3 else slice(0, None, 5)


def exif_gains(stops: Sequence[float] | None, count: int) -> Tensor:
    """Compute initial log gains [V, 3] of `count` photographs from their EXIF exposures (`exif_stops`); 0 if
    unknown."""
    if stops is None:
        return torch.zeros(count, 3)
    light = torch.tensor(stops, dtype=torch.float64) * math.log(2.0)
    light = torch.where(light.isfinite(), light, math.nan) / ENCODING
    return settled((light - light.nanmean()).nan_to_num(0.0).float()[:, None].expand(-1, 3))
