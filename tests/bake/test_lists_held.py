"""Fragment lists are freed before the next one is made, so memory is that of one view."""

import weakref
from collections.abc import Iterator

import pytest
import torch

from bitymi_ns.bake import BakeOptions, bake_field
from bitymi_ns.bake.tuning_views import TexelList, TuningViews
from bitymi_ns.ops import Fragments, trace_cpu
from bitymi_ns.ops import bands as bands_module
from bitymi_ns.ops import trace as whole_trace
from bitymi_ns.scene import scene as scene_module
from bitymi_ns.scene.visibility import visibility
from bitymi_ns.train.config import TrainConfig
from bitymi_ns.train.evaluate import evaluate
from bitymi_ns.train.score import multi_view_scores
from bitymi_ns.train.views import MemoryBudget, View
from tests.bake.test_tune import BACKGROUND, cameras
from tests.scene import bands

PHOTO = torch.full((40, 48, 3), 0.5)


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[int]]:
    """Record the lengths of lists, checking that no other list is alive."""
    alive: list[weakref.ref] = []
    lengths: list[int] = []

    def counted(*args, **kwargs) -> Fragments:
        assert not any(other() is not None for other in alive), "an earlier list is still held"
        fragments = whole_trace(*args, **kwargs)
        alive.append(weakref.ref(fragments.sigma))
        lengths.append(len(fragments))
        return fragments

    monkeypatch.setattr(bands_module, "trace", counted)
    monkeypatch.setattr(scene_module, "trace", counted)
    yield lengths
    assert len(lengths) > 1


@pytest.mark.parametrize("most", [3500, 1 << 25])
def test_of_a_bake(scene, made: list[int], most: int, monkeypatch: pytest.MonkeyPatch) -> None:
    large = scene(60)
    large.surfels["log_scales"] += 1.5
    baked = bake_field(large, options=BakeOptions(format="fp16", r_max=8))
    monkeypatch.setattr(trace_cpu, "MOST", most)
    views = cameras()[:3]
    visibility(large.surfels, views, 0.2)
    assert not made, "coverage is summed without lists"
    texels = TexelList(baked)
    for _ in TuningViews(texels, [View(camera, PHOTO) for camera in views], BACKGROUND, MemoryBudget(0)):
        pass
    assert (len(made) > 3) == (most == 3500)


def test_of_scores_and_evaluation(made: list[int]) -> None:
    scene, camera = bands.make(torch.device("cpu"), 0)
    scene.float()
    camera = type(camera)(camera.viewmat.float(), camera.K.float(), camera.width, camera.height)
    views = [View(camera, torch.full((camera.height, camera.width, 3), 0.5))] * 3
    multi_view_scores(scene, views, TrainConfig())
    evaluate(scene, views, TrainConfig())
    assert len(made) == 6
