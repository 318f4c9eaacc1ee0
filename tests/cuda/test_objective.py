"""One function composes the losses of a training step, on every device and however its view is drawn."""

from dataclasses import dataclass, field
from typing import Any

import pytest
import torch
from torch import Tensor

from bitymi_ns.ops.backend import cuda_backend
from bitymi_ns.ops.training_view import ComparedView
from bitymi_ns.scene import Camera, Scene
from bitymi_ns.train import step
from bitymi_ns.train.config import LossConfig, TrainConfig
from bitymi_ns.train.divergence import LossWatch
from bitymi_ns.train.schedules import Schedule
from bitymi_ns.train.views import View
from tests.cuda.test_training_view import HEIGHT, WIDTH, scene_of
from tests.ops.golden import random_scene


@dataclass(frozen=True)
class Way:
    """A way to draw a view and to compute its losses."""

    terms: set[str]
    loss: dict[str, Any] = field(default_factory=dict)
    maps: bool = False  # the view has depth and normals
    compared: bool = False  # one CUDA function draws the view and computes the first losses
    drawn_alone: bool = False  # that function is not used


USUAL = {"photometric", "falloff"}
OVERDRAW = {"overdraw_weight": 0.01, "overdraw_start": 0}
WAYS = {
    "one function": Way(USUAL, compared=True),
    "one function without falloff": Way({"photometric"}, {"falloff_weight": 0.0}, compared=True),
    "picture": Way(USUAL, drawn_alone=True),
    "picture without falloff": Way({"photometric"}, {"falloff_weight": 0.0}, drawn_alone=True),
    "no SSIM": Way(USUAL, {"ssim_weight": 0.0}),
    "overdraw": Way(USUAL | {"overdraw"}, OVERDRAW),
    "maps": Way(USUAL | {"depth", "normal"}, maps=True),
    "all": Way(USUAL | {"overdraw", "depth", "normal"}, OVERDRAW, maps=True),
}


def losses(way: Way, device: torch.device) -> dict[str, Tensor]:
    """Compute the terms of the objective and the gradient of their sum."""
    case, g = random_scene(30, 5, WIDTH, HEIGHT), torch.Generator().manual_seed(7)
    scene = scene_of(case, "sv", "texels").to(device)
    camera = Camera(case.viewmat.double(), case.K.double(), WIDTH, HEIGHT).to(device)
    photograph, normal = (torch.rand(HEIGHT, WIDTH, 3, generator=g).double().to(device) for _ in range(2))
    gains = torch.tensor([1.2, 0.8, 1.1], dtype=torch.float64, device=device)
    view = View(camera, photograph, correction=gains)
    if way.maps:
        view = view._replace(depth=torch.full((HEIGHT, WIDTH), 4.0).double().to(device), normal=normal)
    schedule = Schedule(TrainConfig(loss=LossConfig(**way.loss), background="white"), 30_000)
    terms, output = step.view_losses(scene, view, schedule, 0, LossWatch())
    assert isinstance(output, ComparedView) == (way.compared and cuda_backend(device))
    torch.stack(list(terms.values())).sum().backward()
    gradients = {f"gradient of {name}": p.grad for name, p in scene.named_parameters() if p.grad is not None}
    return {name: value.detach().cpu() for name, value in (terms | gradients).items()}


@pytest.mark.parametrize("name", WAYS)
def test_every_term_is_that_of_the_cpu(name: str, both, monkeypatch: pytest.MonkeyPatch) -> None:
    way = WAYS[name]
    if way.drawn_alone:
        monkeypatch.setattr(Scene, "compare", lambda *_: None)
    got, want = both(lambda where: losses(way, where))
    assert got.keys() == want.keys() and {each for each in got if "gradient" not in each} == way.terms
    for each, value in want.items():
        assert value.any() and (got[each] - value).abs().max() <= 1e-9 * value.abs().max(), each


@pytest.mark.parametrize("name", WAYS)
def test_a_term_that_is_added_to_it_is_learned(
    name: str, device: torch.device, monkeypatch: pytest.MonkeyPatch
) -> None:
    way, compose, weight = WAYS[name], step.objective, torch.ones(1, dtype=torch.float64, device=device)
    if way.drawn_alone:
        monkeypatch.setattr(Scene, "compare", lambda *_: None)
    monkeypatch.setattr(step, "objective", lambda *given: {**compose(*given), "more": 3.0 * weight.sum()})
    assert losses(way, device)["more"] == 3.0
