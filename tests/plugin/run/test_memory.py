"""The statement of the memory that a run will take."""

from pathlib import Path
from types import SimpleNamespace

import psutil
import pytest
import torch

from bitymi_ns.plugin.run import memory
from bitymi_ns.scene import Camera, Scene
from bitymi_ns.train.config import TexelConfig
from tests.scene import bands

CPU = torch.device("cpu")


@pytest.fixture
def scene() -> tuple[Scene, Camera]:
    return bands.make(CPU, 0)


def said(capsys: pytest.CaptureFixture[str]) -> str:
    return " ".join(capsys.readouterr().out.split())


def gigabytes(text: str) -> float:
    return float(text.split(" GB")[0].split()[-1])


@pytest.mark.parametrize("what", ["training", "export"])
def test_one_line_says_what_will_be_taken(
    scene: tuple[Scene, Camera], what: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    state = {"training": memory.state_training, "export": memory.state_export}[what]
    monkeypatch.setattr(psutil, "virtual_memory", lambda: SimpleNamespace(available=10**12))
    state(scene[0], [scene[1]] * 20, 0)
    text = said(capsys)
    assert "will take about" in text and "20 training photographs of 24 x 150" in text and "available" not in text
    monkeypatch.setattr(psutil, "virtual_memory", lambda: SimpleNamespace(available=0))
    monkeypatch.setattr(memory, "PROGRAM", 1e15)
    state(scene[0], [scene[1]] * 20, 0)
    assert "GB that this machine has available" in said(capsys)


class OnCard:
    """Stands for a scene on a card: its tensors say so, and can be copied to the CPU."""

    def __init__(self, scene: Scene) -> None:
        self.config, self.near, self.field, self._count = scene.config, scene.near, scene.field, len(scene)
        card = torch.device("cuda", 0)
        self.surfels = {
            name: SimpleNamespace(device=card, cpu=lambda value=value: value.detach(), shape=value.shape)
            for name, value in scene.surfels.items()
        }

    def __len__(self) -> int:
        return self._count


@pytest.mark.parametrize("what", ["training", "export"])
def test_a_card_is_compared_with_its_own_memory(
    scene: tuple[Scene, Camera], what: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    state = {"training": memory.state_training, "export": memory.state_export}[what]
    monkeypatch.setattr(psutil, "virtual_memory", lambda: SimpleNamespace(available=0))  # the host's does not matter
    monkeypatch.setattr(memory, "photograph_budget", lambda device: 2**30)
    monkeypatch.setattr(memory, "PER_SURFEL" if what == "training" else "PER_PIXEL", 1e8)
    needed = []
    for free in (10**12, 10**9):
        monkeypatch.setattr(memory, "free_memory", lambda device, free=free: free)
        state(OnCard(scene[0]), [scene[1]] * 20, 0)  # type: ignore[operator]
        text = said(capsys)
        assert "GB of memory of the card for 20 training photographs" in text
        assert ("more than the 1.0 GB that the card has available" in text) == (free == 10**9)
        needed.append(gigabytes(text))
    assert needed[0] > 1 and needed[1] <= needed[0]  # views with more fragments than it holds are drawn in bands


@pytest.mark.parametrize(("compact", "bytes_each"), [(False, 2), (True, 6)])
def test_an_export_holds_what_every_view_shows_of_every_surfel(
    scene: tuple[Scene, Camera], compact: bool, bytes_each: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(memory, "_state", lambda what, needed, *more: stated.append(needed))
    stated: list[float] = []
    for views in (30_000, 40_000):  # whose photographs are more than are kept
        memory.state_export(scene[0], [scene[1]] * views, 0, compact=compact)
    assert stated[1] - stated[0] == 10_000 * bytes_each * len(scene[0])
    options = TexelConfig(pixels_per_texel=2.0, rendered_pixels_per_texel=10.0)
    for views in (30_000, 40_000):
        memory.state_training(scene[0], [scene[1]] * views, 0, options, 1000)
    assert stated[3] - stated[2] == 10_000 * len(scene[0])


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
    assert memory.memory_limit(tmp_path, tmp_path / "cgroups") == limit
    assert memory.memory_limit(tmp_path, tmp_path / "none") == float("inf")
