"""Photographs beyond the memory limit are read again: same pixels, bounded number in memory."""

import weakref
from pathlib import Path
from typing import Any

import pytest
import torch

from bitymi_ns.plugin.console import InputError
from bitymi_ns.plugin.data import dataset as module
from bitymi_ns.plugin.data.datamanager import BitymiDataManager
from bitymi_ns.plugin.data.dataset import RECENT, BitymiDataset
from bitymi_ns.sample import generate
from tests.captures import edit, load_any
from tests.typed import Patch

WIDTH, HEIGHT = 48, 36
PICTURE = WIDTH * HEIGHT * 3
TRAIN, HELD_OUT = 35, 5


@pytest.fixture(scope="module")
def many(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """40 photographs. Not to be changed."""
    folder = tmp_path_factory.mktemp("captures") / "many"
    generate(folder, views=TRAIN + HELD_OUT, width=WIDTH, height=HEIGHT, seed=0, points=50)
    return folder


@pytest.fixture
def alive(monkeypatch: Patch) -> Any:
    """Count the pictures read and those still alive."""
    pictures: weakref.WeakSet = weakref.WeakSet()
    reads: list[int] = []
    read = BitymiDataset.get_data

    def counted(self: BitymiDataset, image_idx: int, *args: Any, **kwargs: Any) -> dict[str, Any]:
        data = read(self, image_idx, *args, **kwargs)
        pictures.add(data["image"])
        reads.append(image_idx)
        return data

    monkeypatch.setattr(BitymiDataset, "get_data", counted)
    return pictures, reads


def look_at_all(manager: BitymiDataManager, pictures: Any) -> int:
    """Visit all views as training and evaluation do; returns the most pictures alive at once."""
    most = 0
    for step in range(2 * TRAIN):
        _, batch = manager.train_view(manager.train_index(step))
        assert batch["image"].shape == (HEIGHT, WIDTH, 3)
        most = max(most, len(pictures))
    for _, batch in manager.fixed_indices_eval_dataloader:
        assert batch["image"].dtype == torch.uint8
        most = max(most, len(pictures))
    manager.get_train_rays_per_batch()
    return most


def test_only_so_many_pictures_are_held(many: Path, alive: Any, monkeypatch: Patch) -> None:
    monkeypatch.setattr(module, "PHOTOGRAPH_BYTES", 6 * PICTURE)
    pictures, _ = alive
    # the cache, the latest of both sets, and the caller's
    assert look_at_all(load_any(many), pictures) <= 6 + 2 * RECENT + 1


def test_a_small_capture_is_read_once(many: Path, alive: Any) -> None:
    pictures, reads = alive
    assert look_at_all(load_any(many), pictures) == len(reads) == TRAIN + HELD_OUT


@pytest.mark.slow
@pytest.mark.parametrize("distortion", [{}, {"k1": 0.05, "p1": 0.01}])
def test_pixels_and_cameras_are_the_same(
    many: Path, distortion: dict[str, float], tmp_path: Path, monkeypatch: Patch
) -> None:
    capture = tmp_path / "many"
    capture.symlink_to(many) if not distortion else generate(capture, views=12, width=WIDTH, height=HEIGHT, points=50)
    if distortion:
        edit(capture, lambda meta: meta.update(distortion))
    kept = load_any(capture)
    monkeypatch.setattr(module, "PHOTOGRAPH_BYTES", 0)
    read = load_any(capture)
    for split in ("cached_train", "cached_eval"):
        for a, b in zip(getattr(kept, split), getattr(read, split), strict=True):
            assert a["image_idx"] == b["image_idx"] and torch.equal(a["image"], b["image"])
    for index in range(len(kept.train_dataset)):
        one, other = kept.train_view(index)[0], read.train_view(index)[0]
        assert torch.equal(one.get_intrinsics_matrices(), other.get_intrinsics_matrices())
        assert (int(one.width), int(one.height)) == (int(other.width), int(other.height))
        assert read.train_view(index)[1]["image"].shape[:2] == (int(other.height), int(other.width))
    assert read.train_dataset.cameras.distortion_params is None


def test_one_step_reads_its_photograph_once(many: Path, alive: Any, monkeypatch: Patch) -> None:
    monkeypatch.setattr(module, "PHOTOGRAPH_BYTES", 0)
    manager = load_any(many)
    _ = manager.cached_train
    _, reads = alive
    before = len(reads)
    for _ in range(3):
        manager.train_view(7)
    assert len(reads) == before + 1


def test_a_photograph_that_cannot_be_read_is_noticed_at_the_start(capture: Path, monkeypatch: Patch) -> None:
    monkeypatch.setattr(module, "PHOTOGRAPH_BYTES", 0)
    path = sorted((capture / "images").iterdir())[3]
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(InputError, match="cannot be read"):
        _ = load_any(capture).cached_train
