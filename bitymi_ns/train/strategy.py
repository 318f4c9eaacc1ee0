"""FastGS densification and pruning by multi-view scores, with the thresholds of `config.DensifyConfig`; rules and their
differences from the published ones: docs/training.md, Strategy and schedules."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor
from torch.nn.functional import one_hot
from torch.optim import Optimizer

from bitymi_ns.ops.backend import cuda_backend, dense, kernel
from bitymi_ns.ops.constants import ALPHA_MIN
from bitymi_ns.ops.parameters import Tensors
from bitymi_ns.scene.field import TexelField
from .config import TrainConfig
from .divergence import TrainingDiverged, describe_broken
from .init import tangents
from .memory import PER_SURFEL, PER_TEXEL, room_to_grow, view_bytes
from .optimizers import ResizeHook, cap_opacity, replace_rows
from .processes import ALONE, Processes
from .schedules import Schedule
from .score import multi_view_scores, removal_errors
from .texels import SMALLEST
from .views import View

if TYPE_CHECKING:
    from bitymi_ns.ops.project import Projection
    from bitymi_ns.scene.scene import Scene

DrawViews = Callable[[int, torch.Generator], Sequence[View]]
"""(k, CPU generator) -> at most k different training views."""

SPLIT_LONG, SPLIT_WIDE = 0.6, 0.7
"""Scales of the halves of a split surfel, along its long axis and across it, relative to its own."""
SPLIT_APART = 0.7  # distance of the halves' centres from the surfel's, in scales of its long axis
SPLIT_OPACITY = 0.9  # opacity of the halves, likewise: they overlap where it is most opaque
NO_BAD_PIXEL = 0.1  # added to counts of bad pixels when parents are sampled: surfels without any have a chance
STATISTICS = ("grad_sum", "abs_grad_sum", "visible_count", "max_radius")


class Strategy:
    """Statistics of the projected centres, and the densification and pruning based on them.

    Attributes:
        statistics: [4, N] since the last densification, named by `STATISTICS`: sum over views of the gradient norm of
            the projected centre, NDC, and of the absolute gradient (AbsGS); number of views in which the surfel was
            visible; largest half extent on screen, pixels.
        generator: of all random choices, on the CPU.
        most: number of surfels at which densification stops; 0: no limit.
        most_by_memory: the same, if memory has set it; else 0.
    """

    def __init__(
        self,
        scene: Scene,
        optimizers: Mapping[str, Optimizer],
        schedule: Schedule,
        on_resize: ResizeHook | None = None,
        image_pixels: int = 0,
        first_surfels: int = 0,
        processes: Processes = ALONE,
    ) -> None:
        """
        Args:
            scene: its surfel parameters are replaced when their number changes.
            optimizers: by surfel parameter name.
            image_pixels: total over all training images at full size; 0: no limit on surfels.
            first_surfels: initial number of surfels.
        """
        self.scene = scene
        self.optimizers = optimizers
        self.processes = processes
        self.on_resize = on_resize
        self.schedule, self.config = schedule, schedule.config
        self.most = self._most = most_surfels(self.config, image_pixels, first_surfels)
        self.most_by_memory = 0
        # opacity below which a surfel may be replaced: fainter than at the start, and faint enough for a final prune
        self._replaceable = min(self.config.densify.final_prune_opacity, 0.5 * self.config.init_opacity)
        self.generator = torch.Generator().manual_seed(self.config.seed)
        self.statistics = torch.zeros(len(STATISTICS), 0)

    def state_dict(self) -> dict[str, Any]:
        """Return the state for a resumed run."""
        rows = zip(STATISTICS, self.statistics.clone(), strict=True)
        return {**dict(rows), "generator": self.generator.get_state(), "most_by_memory": self.most_by_memory}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        self.statistics = torch.stack([state[name].detach().float() for name in STATISTICS])
        self.generator.set_state(state["generator"].cpu().to(torch.uint8))
        self.most_by_memory = int(state.get("most_by_memory", 0))  # checkpoints of earlier versions have none
        self.most = self.most_by_memory or self._most

    def accumulate(self, *projections: Projection) -> None:
        """Add the statistics of a step's views, over all processes, after the backward passes."""
        if self.processes.views == 1:
            self._accumulate_view(*projections)
            return
        before = self.statistics
        self.statistics = torch.zeros(len(STATISTICS), 0)
        for projection in projections:
            self._accumulate_view(projection)
        self.processes.sum(self.statistics[:3])
        self.processes.maximum(self.statistics[3])
        if before.shape[1] > 0:
            before = before.to(self.statistics.device)
            self.statistics[:3] += before[:3]
            self.statistics[3] = torch.maximum(before[3], self.statistics[3])

    @torch.no_grad()
    def _accumulate_view(self, projection: Projection) -> None:
        n, device = len(projection.radii), projection.radii.device
        if self.statistics.shape[1] == 0:
            self.statistics = torch.zeros(len(STATISTICS), n, device=device)
        if self.statistics.shape[1] != n:
            raise ValueError(f"the strategy follows {self.statistics.shape[1]} surfels, but {n} were rendered")
        self.statistics = self.statistics.to(device)
        grad_sum, abs_grad_sum, visible_count, max_radius = self.statistics
        height, width = projection.camera.height, projection.camera.width
        gradients = (projection.mean2d_grad, projection.mean2d_absgrad)
        if cuda_backend(device):
            grad, absgrad = (None if gradient is None else dense(gradient, projection.radii) for gradient in gradients)
            rows = dict(zip(STATISTICS, self.statistics, strict=True))
            size = {"width": width, "height": height}
            kernel("accumulate_statistics", projection.radii)(
                radii=projection.radii, grad=grad, absgrad=absgrad, **size, **rows
            )
            return
        visible = projection.visible
        for total, gradient in zip((grad_sum, abs_grad_sum), gradients, strict=True):
            if gradient is not None:  # None if there was no fragment
                ndc = (0.5 * width * gradient[:, 0], 0.5 * height * gradient[:, 1])
                size = torch.hypot(*ndc).nan_to_num(0.0, 0.0, 0.0)
                total += torch.where(visible, size, 0.0)
        visible_count += visible
        radius = projection.radii.amax(-1).float()
        torch.where(visible, torch.maximum(max_radius, radius), max_radius, out=max_radius)

    def step(self, step: int, views: DrawViews) -> dict[str, float]:
        """Densify, reset opacities and prune as scheduled after the optimiser update of `step`. `views`: samples the
        views for the scores. Returns counts by action; empty if nothing was due."""
        report: dict[str, float] = {}
        if 0 < self.config.densify.max_surfels < len(self.scene):  # a loaded scene may exceed the limit
            report |= self._drop_dead()
        if step in self.schedule.densify_steps:
            report |= self._densify(step, views)
        if step in self.schedule.reset_steps:
            highest = self.schedule.reset_opacity()
            report["opacity_reset"] = cap_opacity(self.scene.surfels, self.optimizers, highest, forget_all=True)
        if step in self.schedule.error_prune_steps:
            report |= self._error_prune(views)
        if step in self.schedule.final_prune_steps:
            report |= self._final_prune(views)
        if report:
            report["surfels"] = len(self.scene)
        return report

    # ---- densification

    @torch.no_grad()
    def _densify(self, step: int, views: DrawViews) -> dict[str, float]:
        config, surfels = self.config.densify, self.scene.surfels
        report = self._drop_dead()
        scores = multi_view_scores(self.scene, views(config.views, self.generator), self.config, self.processes)
        n, device = len(self.scene), surfels["means"].device
        statistics = self.statistics
        if statistics.shape[1] != n:  # no view since the last densification
            statistics = torch.zeros(len(STATISTICS), n, device=device)
        grad_sum, abs_grad_sum, visible_count, max_radius = statistics
        seen = visible_count.clamp(min=1)
        size = surfels["log_scales"].amax(-1).exp()
        large = size > config.dense * self.schedule.extent
        wanted = scores.importance > config.importance
        clone = wanted & ~large & (grad_sum / seen >= config.grad_threshold)
        split = wanted & large & (abs_grad_sum / seen >= config.abs_grad_threshold)
        replaced = torch.zeros_like(clone)
        count = int((clone | split).sum())
        report |= self._heed_memory(step, n, count, device)
        if self.most > 0:
            room = max(0, self.most - n)
            gradient = abs_grad_sum / seen
            if config.max_surfels > 0:
                room //= sum(step <= later for later in self.schedule.densify_steps)
                # shortly after an opacity reset all opacities are low
                if not self.schedule.recovering(step):
                    faint = ~(clone | split) & (surfels["opacity_logits"].sigmoid() < self._replaceable)
                    replaced = _lowest(faint, count - room, surfels["opacity_logits"])
                weights = gradient.double() * (scores.importance + NO_BAD_PIXEL) * ~replaced
                chosen = torch.zeros_like(clone)
                chosen[self._draw(weights, room + int(replaced.sum()))] = True
                clone, split = chosen & ~large, chosen & large
                report |= {"replaced": int(replaced.sum())}
            else:
                chosen = _lowest(clone | split, room, -scores.importance, -gradient)
                clone, split = clone & chosen, split & chosen
                report |= {"held_back": count - int(chosen.sum())}
        clones, splits = clone.nonzero().flatten(), split.nonzero().flatten()
        stay = (~split).nonzero().flatten()
        children = self._halves(surfels, splits)
        new = {name: torch.cat([p.detach()[clones], children[name]]) for name, p in surfels.items()}

        # the budget counts old and new candidates; only old ones are sampled
        old_candidate, new_candidate = self._prunable(surfels), self._prunable(new)
        if step > self.schedule.reset_every:  # the first opacity reset is over
            old_candidate |= max_radius > config.prune_screen
        budget = math.floor(config.prune_budget * int(old_candidate[stay].sum() + new_candidate.sum()))
        drawn = self._draw(1.0 / (1e-6 + 1.0 - scores.prune[stay].double()), budget)
        pruned = torch.zeros(n, dtype=torch.bool, device=device)
        pruned[stay[drawn]] = True
        pruned = pruned & old_candidate | replaced
        pruned = self._keep_minimum(pruned, surfels["opacity_logits"], n + len(clones) + len(splits), among=~split)
        keep = (~pruned & ~split).nonzero().flatten()

        if len(keep) != n or len(clones) + len(splits) > 0:
            replace_rows(surfels, self.optimizers, keep, new, self.on_resize)
        self.statistics = torch.zeros(len(STATISTICS), len(self.scene), device=device)
        cap_opacity(surfels, self.optimizers, config.opacity_clamp)
        return report | {"cloned": len(clones), "split": len(splits), "pruned": int(pruned.sum())}

    def _heed_memory(self, step: int, n: int, wanted: int, device: torch.device) -> dict[str, float]:
        """End growth for good if `wanted` more surfels than n, with their smallest tiles, might not fit beside a view
        at full size."""
        to_come = (1.0 - self.schedule.resolution_factor(step) ** 2) * view_bytes(self.schedule.pixels)
        surfel_bytes = PER_SURFEL + PER_TEXEL * SMALLEST**2
        fitting = n + max(0, int((room_to_grow(device, self.processes) - to_come) / surfel_bytes))
        if fitting >= n + wanted or 0 < self.most <= fitting:
            return {}
        self.most = self.most_by_memory = fitting
        return {"most_by_memory": fitting}

    def _halves(self, surfels: Tensors, rows: Tensor) -> dict[str, Tensor]:
        """Split surfels into halves along their long axes, which together look about the same."""
        halves = {name: p.detach()[rows].repeat_interleave(2, dim=0) for name, p in surfels.items()}
        long = one_hot(halves["log_scales"].argmax(-1), 2).to(halves["log_scales"])  # [2S, 2]
        side = long.new_tensor([1.0, -1.0]).repeat(len(rows))[:, None]
        axis = (tangents(halves["quats"]) * long[:, None]).sum(-1)  # [2S, 3]
        reach = halves["log_scales"].amax(-1, keepdim=True).exp()
        halves["means"] = halves["means"] + SPLIT_APART * side * reach * axis
        halves["log_scales"] = halves["log_scales"] + long * math.log(SPLIT_LONG) + (1.0 - long) * math.log(SPLIT_WIDE)
        halves["opacity_logits"] = (SPLIT_OPACITY * halves["opacity_logits"].sigmoid()).logit()
        return halves

    # ---- pruning

    def _prunable(self, surfels: Tensors) -> Tensor:
        config = self.config.densify
        candidate = surfels["opacity_logits"].sigmoid() < config.prune_opacity
        return candidate | (surfels["log_scales"].amax(-1).exp() > config.prune_world * self.schedule.extent)

    @torch.no_grad()
    def _error_prune(self, views: DrawViews) -> dict[str, float]:
        report = self._drop_dead()
        every = torch.ones(len(self.scene), dtype=torch.bool, device=self.scene.surfels["means"].device)
        drawn = views(self.schedule.error_views, self.generator)
        return report | self._prune_least(every, self.config.densify.prune_error, drawn)

    @torch.no_grad()
    def _final_prune(self, views: DrawViews) -> dict[str, float]:
        """Remove faint surfels, except those that matter, as many do after an opacity reset."""
        report, config = self._drop_dead(), self.config.densify
        faint = self.scene.surfels["opacity_logits"].sigmoid() < config.final_prune_opacity
        drawn = views(self.schedule.final_views, self.generator)
        return report | self._prune_least(faint, config.final_prune_error, drawn)

    def _prune_least(self, among: Tensor, relative_error: float, views: Sequence[View]) -> dict[str, float]:
        """Remove the surfels `among` [N] bool that change the views least, together by at most `relative_error` of
        their squared error (`removal_errors`), as far as `min_surfels` allows."""
        seed = int(torch.randint(1 << 31, (), generator=self.generator))
        added, error = removal_errors(self.scene, views, self.config, seed, self.processes)
        rows = among.nonzero().flatten()
        rows = rows[added[rows].argsort(stable=True)]
        pruned = torch.zeros_like(among)
        pruned[rows] = added[rows].cumsum(0) <= relative_error * error
        pruned &= added > 0  # unsampled views may show the others
        pruned = self._keep_minimum(pruned, self.scene.surfels["opacity_logits"], len(self.scene))
        self.remove(pruned)
        return {"pruned": int(pruned.sum())}

    def _drop_dead(self) -> dict[str, float]:
        """Remove surfels that are not finite or can never be visible again, and the faintest beyond `max_surfels`."""
        scene, surfels = self.scene, self.scene.surfels
        if scene.field is not None and not all(bool(p.isfinite().all()) for p in scene.field.parameters()):
            raise TrainingDiverged(f"the texture field is broken: {describe_broken(scene.field)}")
        finite = finite_rows(scene)
        if not bool(finite.any()):
            raise TrainingDiverged(f"no surfel is left whose parameters are all finite: {describe_broken(scene)}")
        logits = surfels["opacity_logits"]
        # no fragment, hence no gradient: they would stay invisible
        invisible = finite & (logits.sigmoid() <= ALPHA_MIN)
        if self.config.densify.max_surfels > 0:
            over = int(finite.sum() - invisible.sum()) - self.config.densify.max_surfels
            invisible |= _lowest(finite & ~invisible, over, logits)
        pruned = ~finite | self._keep_minimum(invisible, logits, int(finite.sum()), among=finite)
        self.remove(pruned)
        return {"not_finite": int((~finite).sum()), "invisible": int((pruned & finite).sum())}

    def _keep_minimum(self, pruned: Tensor, opacity_logits: Tensor, count: int, among: Tensor | None = None) -> Tensor:
        """Restrict `pruned` [N] bool to `among` [N] bool, and clear its most opaque rows as far as needed to leave
        `min_surfels` of `count`."""
        if among is not None:
            pruned = pruned & among
        lowest = max(1, self.config.densify.min_surfels)
        if self.config.densify.max_surfels > 0:
            lowest = min(lowest, self.config.densify.max_surfels)
        missing = lowest - (count - int(pruned.sum()))
        return pruned & ~_lowest(pruned, missing, -opacity_logits)

    def _draw(self, weights: Tensor, k: int) -> Tensor:
        """Sample at most k rows in proportion to weights, without replacement: those of the smallest Exp(1) / weight,
        as torch.multinomial is limited to 2^24 rows."""
        k = min(k, int((weights > 0).sum()))
        race = torch.empty(len(weights), dtype=torch.float64).exponential_(generator=self.generator).to(weights.device)
        return (race / weights).topk(k, largest=False).indices

    @torch.no_grad()
    def remove(self, pruned: Tensor) -> None:
        """Remove the surfels `pruned` [N] bool, with their texels and statistics."""
        if not bool(pruned.any()):
            return
        keep = (~pruned).nonzero().flatten()
        replace_rows(self.scene.surfels, self.optimizers, keep, on_resize=self.on_resize)
        if isinstance(self.scene.field, TexelField):
            self.scene.field.keep(keep)
        if self.statistics.shape[1] == len(pruned):
            self.statistics = self.statistics.index_select(1, keep.to(self.statistics.device))


def most_surfels(config: TrainConfig, image_pixels: int, first_surfels: int = 0) -> int:
    """Compute the number of surfels at which densification stops; 0: no limit. `image_pixels`, `first_surfels`: as in
    `Strategy`."""
    densify = config.densify
    if densify.max_surfels > 0 or densify.pixels_per_surfel == 0 or image_pixels == 0:
        return densify.max_surfels
    return max(int(image_pixels / densify.pixels_per_surfel), int(densify.growth * first_surfels))


def finite_rows(scene: Scene) -> Tensor:
    """Find the surfels, [N] bool, whose parameters are all finite."""
    finite = torch.ones(len(scene), dtype=torch.bool, device=scene.surfels["means"].device)
    for p in scene.surfels.values():
        finite &= p.detach().reshape(len(p), -1).isfinite().all(-1)
    return finite


def _lowest(among: Tensor, k: int, *values: Tensor) -> Tensor:
    """Select the `k` rows among [N] bool with the lowest first `values` [N], equal ones by the next ones: [N] bool."""
    rows = among.nonzero().flatten()
    for keys in reversed(values):
        rows = rows[keys.detach()[rows].argsort(stable=True)]
    chosen = torch.zeros_like(among)
    chosen[rows[: max(0, k)]] = True
    return chosen
