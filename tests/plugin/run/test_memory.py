"""The estimate of a run's memory."""

import math
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import psutil
import pytest
import torch
from torch.multiprocessing.reductions import StorageWeakRef
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten

from bitymi_ns.bake import BakeOptions
from bitymi_ns.bake.pipeline import trained_texels
from bitymi_ns.bake.tuning_views import TexelList, TuningViews
from bitymi_ns.bundle.sizes import memory_limit
from bitymi_ns.ops.backend import emulated_cuda
from bitymi_ns.plugin.run import memory
from bitymi_ns.scene import Camera, Scene
from bitymi_ns.scene.config import SceneConfig
from bitymi_ns.scene.field import TexelField
from bitymi_ns.scene.visibility import visibility
from bitymi_ns.train import texels
from bitymi_ns.train.config import TexelConfig
from bitymi_ns.train.views import MemoryBudget, View
from tests.bake.conftest import make_surfels
from tests.required import skip_without
from tests.scene import bands
from tests.typed import Patch, Printed

CPU, Drawn = torch.device("cpu"), tuple[Scene, Camera]


@pytest.fixture
def scene() -> tuple[Scene, Camera]:
    return bands.make(CPU, 0)


def said(capsys: Printed) -> str:
    return " ".join(capsys.readouterr().out.split())


def gigabytes(text: str) -> float:
    """Return the stated figure, or the middle of two, whose ratio is checked."""
    low, high = re.search(r"will take (?:about |([0-9.]+) to )([0-9.]+) GB", text).groups()
    assert low is None or float(high) < 0.1 or float(high) / float(low) < 1.72
    return math.sqrt(float(low or high) * float(high))


@pytest.mark.parametrize("state", [memory.state_training, memory.state_export])
def test_a_line_says_what_is_taken(scene: Drawn, state: Any, monkeypatch: Patch, capsys: Printed) -> None:
    monkeypatch.setattr(psutil, "virtual_memory", lambda: SimpleNamespace(available=10**12))
    state(scene[0], [scene[1]] * 20, 0)
    text = said(capsys)
    assert "will take" in text and "20 training photographs of 24 x 150" in text and "available" not in text
    monkeypatch.setattr(psutil, "virtual_memory", lambda: SimpleNamespace(available=0))
    monkeypatch.setattr(memory, "PROGRAM", 1e15)
    state(scene[0], [scene[1]] * 20, 0)
    assert "GB that this machine has available" in said(capsys)
    monkeypatch.setattr(psutil, "virtual_memory", lambda: SimpleNamespace(available=10**16))
    monkeypatch.setattr("bitymi_ns.train.memory.memory_limit", lambda: 2e9)
    state(scene[0], [scene[1]] * 20, 0)
    assert "more than the 2.0 GB that this machine has available" in said(capsys)


class OnCard:
    """A scene with stub CUDA tensors, which can be copied to the CPU."""

    def __init__(self, scene: Scene) -> None:
        self.config, self.near, self.field, self._count = scene.config, scene.near, scene.field, len(scene)
        card = torch.device("cuda", 0)
        self.surfels = {
            name: SimpleNamespace(device=card, cpu=lambda value=value: value.detach(), shape=value.shape)
            for name, value in scene.surfels.items()
        }

    def __len__(self) -> int:
        return self._count


@pytest.mark.parametrize("state", [memory.state_training, memory.state_export])
def test_a_card_has_its_own_memory(scene: Drawn, state: Any, monkeypatch: Patch, capsys: Printed) -> None:
    monkeypatch.setattr(psutil, "virtual_memory", lambda: SimpleNamespace(available=0))  # host memory is irrelevant
    monkeypatch.setattr(memory, "photograph_budget", lambda device: 2**30)
    monkeypatch.setattr(memory, "PER_SURFEL" if state is memory.state_training else "PER_PIXEL", 1e8)
    needed = []
    for free in (10**12, 10**9):
        monkeypatch.setattr(memory, "free_memory", lambda device, free=free: free)
        state(OnCard(scene[0]), [scene[1]] * 20, 0)
        text = said(capsys)
        assert "GB of memory of the GPU for 20 training photographs" in text
        assert ("more than the 1.0 GB that the GPU has available" in text) == (free == 10**9)
        needed.append(gigabytes(text))
    assert needed[0] > 1 and needed[1] <= needed[0]  # views with more fragments than fit are drawn in bands


def test_lists_of_training_on_a_card_count(scene: Drawn, monkeypatch: Patch, capsys: Printed) -> None:
    monkeypatch.setattr(memory, "photograph_budget", lambda device: 0)
    monkeypatch.setattr(memory, "free_memory", lambda device: 10**12)
    monkeypatch.setattr(memory, "PER_GPU_FRAGMENT", 10**7)
    count = memory.most_fragments(scene[0], [scene[1]])

    def gigabytes_of(config: SceneConfig, lists: bool = False) -> float:
        one = OnCard(scene[0])
        one.config = config
        memory.state_training(one, [scene[1]], 0, lists=lists)  # type: ignore[arg-type]
        return gigabytes(said(capsys))

    plain = replace(scene[0].config, texture="none")
    assert gigabytes_of(plain) < 1
    listed = pytest.approx(1e-2 * count, abs=0.1)
    assert gigabytes_of(plain, lists=True) == listed
    assert gigabytes_of(replace(plain, texture="hash")) == listed
    assert gigabytes_of(replace(plain, max_fragments=10**6)) == listed
    monkeypatch.setattr(memory, "can_rasterize", lambda device: False)
    assert gigabytes_of(plain) == listed


def test_a_card_too_small_gets_advice_for_it(scene: Drawn, monkeypatch: Patch, capsys: Printed) -> None:
    monkeypatch.setattr(memory, "photograph_budget", lambda device: 0)
    monkeypatch.setattr(memory, "free_memory", lambda device: 0)
    memory.state_training(OnCard(scene[0]), [scene[1]], 1000)  # type: ignore[arg-type]
    text = said(capsys)
    assert "--max-surfels 500" in text and "--downscale-factor 2" in text and "max-fragments" not in text


def test_it_grows_with_fragments_not_with_views(scene: Drawn, monkeypatch: Patch, capsys: Printed) -> None:
    one, camera = scene
    with torch.no_grad():
        count = len(one.render(camera).fragments)
    assert memory.most_fragments(one, [camera] * 5) == int(memory.MARGIN * count)
    assert memory.most_fragments(one, [camera], 1000) == 1000
    monkeypatch.setattr(memory, "PER_FRAGMENT", 1e6)
    monkeypatch.setattr(memory, "FREED", 0)
    memory.state_training(one, [camera], 0)
    assert gigabytes(said(capsys)) == pytest.approx(0.8 + 1e-3 * memory.MARGIN * count, abs=0.1)
    monkeypatch.setattr(texels, "FEW", 0)
    options = TexelConfig(pixels_per_texel=2.0, rendered_pixels_per_texel=10.0)
    for to_come, views in ((1000, memory.VIEWS_OF_TEXELS / 2.0), (20, 2.0)):
        monkeypatch.setattr(memory, "PER_TEXEL", 0)
        memory.state_training(one, [camera], 0, options, to_come)
        monkeypatch.setattr(memory, "PER_TEXEL", 1e6)
        memory.state_training(one, [camera], 0, options, to_come)
        few, many = said(capsys).split("Training")[1:]
        most = max(memory.SMALLEST**2 * memory.KEPT * len(one), views * camera.width * camera.height)
        assert gigabytes(many) - gigabytes(few) == pytest.approx(1e-3 * most, rel=0.1)
    large = Camera(camera.viewmat, camera.K, 4000, 4000)  # photographs exceed the cache
    monkeypatch.setattr(memory, "most_fragments", lambda *_: 0)
    needed = []
    for views in (100, 1000):
        memory.state_training(one, [large] * views, 0)
        memory.state_export(one, [large] * views, 1e9)
        needed.append(said(capsys).split(" for ")[0])
    assert needed[0] == needed[1]


def test_an_export_grows_with_surfels_views_texels(scene: Drawn, monkeypatch: Patch, capsys: Printed) -> None:
    one, camera = scene

    def taken(*arguments: float, views: int = 1) -> float:
        memory.state_export(one, [camera] * views, *arguments)
        return gigabytes(said(capsys))

    assert taken(0, 1_000_000) - taken(0, 0) == pytest.approx(1e-3 * memory.PER_SURFEL, abs=0.11)
    kept = 2.0 - memory.PHOTOGRAPH_BYTES / 1e9
    assert taken(2e9, views=10) - taken(2e9, views=300_000) == pytest.approx(kept, abs=0.11)
    monkeypatch.setattr(memory, "PER_BAKED_TEXEL", 1e6)
    before = taken(0)
    one.field = TexelField.blank(len(one), 5000, one.surfels["means"].detach())
    assert taken(0) - before == pytest.approx(5.0, abs=0.11)


@pytest.mark.parametrize("compact", [False, True])
def test_an_export_holds_views_of_surfels(scene: Drawn, compact: bool, monkeypatch: Patch) -> None:
    monkeypatch.setattr(memory, "_state", lambda what, needed, *more: stated.append(math.sqrt(math.prod(needed))))
    stated: list[float] = []
    for views in (30_000, 40_000):  # photographs exceed the cache
        memory.state_export(scene[0], [scene[1]] * views, 0, compact=compact)
    assert stated[1] - stated[0] == pytest.approx(10_000 * 4 * len(scene[0]))
    options = TexelConfig(pixels_per_texel=2.0, rendered_pixels_per_texel=10.0)
    for views in (30_000, 40_000):
        memory.state_training(scene[0], [scene[1]] * views, 0, options, 1000)
    assert stated[3] - stated[2] == pytest.approx(10_000 * memory.KEPT * len(scene[0]))


class Peak(TorchDispatchMode):
    def __init__(self) -> None:
        super().__init__()
        self._live: dict[StorageWeakRef, int] = {}
        self.bytes = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        made = func(*args, **(kwargs or {}))
        for tensor in tree_flatten(made)[0]:
            if isinstance(tensor, torch.Tensor):
                self._live[StorageWeakRef(tensor.untyped_storage())] = tensor.untyped_storage().nbytes()
        self._live = {storage: size for storage, size in self._live.items() if not storage.expired()}
        self.bytes = max(self.bytes, sum(self._live.values()))
        return made


@pytest.mark.slow
def test_lists_of_an_export_take_what_is_stated_on_a_card(monkeypatch: Patch) -> None:
    try:
        from bitymi_ns import _emulated  # noqa: F401
    except ImportError:
        skip_without("emulated", "built without BITYMI_EMULATED_CUDA")
    count, size = 40, 64  # faint discs, each larger than the picture
    surfels = make_surfels(count)
    surfels["means"] = torch.stack([torch.zeros(count), torch.zeros(count), torch.linspace(3, 4, count)], dim=1)
    surfels["quats"] = torch.tensor([1.0, 0, 0, 0]).repeat(count, 1)
    surfels["log_scales"], surfels["opacity_logits"] = torch.full((count, 2), 2.0), torch.full((count,), -3.0)
    surfels["beta_raw"] = torch.zeros(count)
    camera = Camera(torch.eye(4), torch.tensor([[64.0, 0, 32], [0, 64.0, 32], [0, 0, 1]]), size, size)
    bound = 0.0471 * 0.953**16.5  # between the weights of two fragments, so that 43 % show a texel
    field = TexelField(torch.full((count, 2), 4), torch.full((count,), 3.0), torch.zeros(16 * count, 3))
    stands = SimpleNamespace(surfels=surfels, field=field, near=0.2, config=SimpleNamespace(weight_bound=bound))
    baked = trained_texels(stands, BakeOptions(format="fp16"))
    view = View(camera, torch.zeros(size, size, 3))
    monkeypatch.setattr("bitymi_ns.ops.coverage.PART", 1 << 12)  # large views have many parts
    taken = []
    with emulated_cuda(seed=1):
        for use in (
            lambda: TexelList(baked).coverage([view]),
            lambda: visibility(surfels, [camera], 0.2, bound),
            lambda: TuningViews(TexelList(baked), [view], torch.zeros(3), MemoryBudget(0))[0],
        ):
            with Peak() as peak:
                use()
            taken.append(peak.bytes / (count * size * size))
    assert max(taken[:2]) < memory.PER_PASSING_FRAGMENT < taken[2] < memory.PER_BAKED_FRAGMENT


@pytest.mark.parametrize(
    ("groups", "file", "limit"),
    [
        ("0::/a/b", "a/memory.max", 5e9),
        ("4:cpu:/a\n3:memory:/a/b", "memory/a/b/memory.limit_in_bytes", 5e9),
        ("0::/a/b", "a/b/other", float("inf")),
    ],
)
def test_the_limit_of_a_control_group_counts(tmp_path: Path, groups: str, file: str, limit: float) -> None:
    (tmp_path / file).parent.mkdir(parents=True)
    (tmp_path / file).write_text("5000000000\n")
    (tmp_path / "memory.max").write_text("max\n")
    (tmp_path / "cgroups").write_text(groups + "\n")
    assert memory_limit(tmp_path, tmp_path / "cgroups") == limit
    assert memory_limit(tmp_path, tmp_path / "none") == float("inf")
