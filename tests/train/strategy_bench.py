"""A test bench for the strategy: surfels in a row with given scores."""

import math
from types import SimpleNamespace

import torch

from bitymi_ns.scene.config import SceneConfig
from bitymi_ns.scene.scene import Scene
from bitymi_ns.train import strategy as module
from bitymi_ns.train.config import DensifyConfig, TrainConfig
from bitymi_ns.train.init import surfels_from_points
from bitymi_ns.train.optimizers import make_optimizers
from bitymi_ns.train.schedules import Schedule
from bitymi_ns.train.score import Scores
from bitymi_ns.train.strategy import Strategy

LARGE, SMALL = math.log(0.01), math.log(0.0001)  # against dense * extent = 0.001


class Bench:
    """A scene of n opaque surfels in a row, optimisers with momentum, and given scores."""

    def __init__(self, monkeypatch, n=40, **densify):
        xyz = torch.stack([torch.arange(float(n)), torch.zeros(n), torch.zeros(n)], -1)
        surfels, _ = surfels_from_points(xyz, torch.rand(n, 3), torch.zeros(0, 3), TrainConfig(), SceneConfig())
        surfels["opacity_logits"].fill_(1.0)
        surfels["log_scales"].fill_(SMALL)
        self.scene = Scene(SceneConfig(), surfels, None)
        self.optimizers = make_optimizers(self.scene)
        for name, optimizer in self.optimizers.items():
            self.scene.surfels[name].grad = torch.ones_like(self.scene.surfels[name])
            optimizer.step()  # rate 0: moments only
        densify = {"min_surfels": 1, **densify}
        self.config = TrainConfig(densify=DensifyConfig(**densify))
        self.strategy = Strategy(self.scene, self.optimizers, Schedule(self.config, 30_000))
        self.importance = torch.zeros(n, dtype=torch.int64)
        self.prune = torch.zeros(n)
        self.asked = []
        self.added, self.present = torch.full((n,), 1e3, dtype=torch.float64), torch.tensor(1e3, dtype=torch.float64)
        monkeypatch.setattr(module, "multi_view_scores", self._scores)
        monkeypatch.setattr(module, "removal_errors", lambda *_: (self.added[self._rows()], self.present))

    def _rows(self):
        # rows are identified by x, so scores stay with their surfels after pruning
        return self.scene.surfels["means"][:, 0].detach().nan_to_num(0).round().long()

    def _scores(self, scene, views, config, processes):
        return Scores(self.importance[self._rows()], self.prune[self._rows()])

    def views(self, k, generator):
        self.asked.append(k)
        return []

    def see(self, grad=0.0, absgrad=0.0, radius=5.0, visible=None):
        """Accumulate a view of 200 x 100 pixels; gradients [n] or numbers in NDC along x."""
        n = len(self.scene)
        ndc = [torch.as_tensor(g, dtype=torch.float32).expand(n) for g in (grad, absgrad)]
        pixels = [torch.stack([g / 100.0, torch.zeros(n)], -1) for g in ndc]
        projection = SimpleNamespace(
            visible=torch.ones(n, dtype=torch.bool) if visible is None else visible,
            mean2d_grad=pixels[0],
            mean2d_absgrad=pixels[1],
            radii=torch.as_tensor(radius, dtype=torch.float32).expand(n)[:, None].expand(n, 2),
            camera=SimpleNamespace(width=200, height=100),
        )
        self.strategy.accumulate(projection)

    def step(self, at):
        return self.strategy.step(at, self.views)

    def set(self, name, rows, value):
        with torch.no_grad():
            self.scene.surfels[name][rows] = value

    @property
    def x(self):
        return [round(x) for x in self.scene.surfels["means"][:, 0].tolist()]
