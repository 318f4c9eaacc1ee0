"""The data manager on good and bad captures."""

import errno
import os
from pathlib import Path
from types import SimpleNamespace

import psutil
import pytest
import torch
from PIL import Image

from bitymi_ns import load_capture
from bitymi_ns.capture.types import CaptureError
from bitymi_ns.plugin.data import dataset
from bitymi_ns.plugin.data.capture_checks import reporting_input_errors
from bitymi_ns.plugin.data.datamanager import BitymiDataManagerConfig
from bitymi_ns.plugin.data.dataparser import BitymiDataParserConfig
from bitymi_ns.plugin.run.model import train_config_for
from bitymi_ns.train.config import TrainConfig
from tests.captures import expect, images_of, load
from tests.stand_in_card import CARD
from tests.typed import Patch


def test_the_order_of_views_depends_on_seed_and_step_alone(capture: Path) -> None:
    manager, other = load(capture), load(capture)
    order = [manager.train_index(step) for step in range(25)]
    assert order[10:20] == [other.train_index(step) for step in range(10, 20)]  # as after a resume
    assert sorted(order[:10]) == list(range(10)) == sorted(order[10:20])
    assert order[:10] != order[10:20]
    other.config.train_cameras_sampling_seed += 1
    assert order != [other.train_index(step) for step in range(25)]


def test_a_batch_does_not_share_its_dictionary_with_the_cache(capture: Path) -> None:
    manager = load(capture)
    manager.train_view(0)[1]["image"] = None
    assert manager.cached_train[0]["image"] is not None


def test_photographs_of_a_run_on_a_card_stay_in_memory_of_the_host(capture: Path, monkeypatch: Patch) -> None:
    monkeypatch.setattr(dataset, "PHOTOGRAPH_BYTES", 0)
    monkeypatch.setattr(psutil, "virtual_memory", lambda: SimpleNamespace(available=40_000))
    manager = load(capture)
    assert not manager.cached_train._kept
    shared, manager = load(capture, CARD), load(capture, CARD)
    for views, cached in ((manager.train_views, manager.cached_train), (manager.eval_views, manager.cached_eval)):
        view = views[0]
        assert view.image.device.type == "cpu" and view.image.dtype == torch.uint8
        assert view.camera.K.device == CARD and cached[0]["image"].device.type == "cpu"
    assert len(manager.cached_train._kept) == 20_000 // (36 * 48 * 3)
    shared.world_size = 2  # processes
    assert len(shared.cached_train._kept) == 10_000 // (36 * 48 * 3)


def add_alpha(paths: list[Path], alpha: int) -> None:
    """Add an alpha channel to photographs, 255 except for one pixel."""
    for path in paths:
        image = Image.open(path).convert("RGBA")
        image.putpixel((0, 0), (0, 0, 0, alpha))
        image.save(path)


def test_alpha_is_kept_for_the_model(capture: Path) -> None:
    add_alpha(images_of(capture), 0)
    manager = load(capture)
    assert manager.train_dataset.facts.has_alpha is True
    assert manager.train_dataset.facts.transparent is True
    assert manager.cached_train[0]["image"].shape[-1] == 4
    assert manager.train_dataset[0]["image"].shape[-1] == 3  # for viewer and ns-render


def test_an_alpha_channel_without_a_transparent_pixel_is_none(capture: Path) -> None:
    add_alpha(images_of(capture), 255)
    manager = load(capture)
    assert manager.train_dataset.facts.transparent is False
    assert manager.cached_train[0]["image"].shape[-1] == 3
    add_alpha(images_of(capture)[1:], 0)
    assert load(capture).train_dataset.facts.transparent is True


def test_the_color_behind_transparent_photographs() -> None:
    """The stated color replaces any fixed one, as in runs of earlier versions."""
    white = torch.ones(3)
    for given, transparent, wanted in (
        ("auto", True, "auto"), ("auto", False, "white"), ("random", True, "random"), ("black", True, "white")
    ):  # fmt: skip
        made = train_config_for(TrainConfig(background=given), white, transparent)  # type: ignore[arg-type]
        assert (made.background, made.alpha_color) == (wanted, "white")
    assert train_config_for(TrainConfig(background="white"), None, True).background == "white"
    assert train_config_for(TrainConfig(), None, True).background == "auto"
    assert train_config_for(TrainConfig(), None, False).background == "black"


def test_a_file_without_permission_is_named(capture: Path, monkeypatch: Patch) -> None:
    def denied(*_: object) -> None:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(capture / "images"))

    monkeypatch.setattr(BitymiDataManagerConfig, "setup", denied)
    monkeypatch.setattr("bitymi_ns.capture.read.recognise", denied)
    line = f"{capture / 'images'} cannot be read or written: you have no permission for it"
    with expect(line), reporting_input_errors(BitymiDataManagerConfig(data=capture)):
        BitymiDataManagerConfig(data=capture).setup()
    with pytest.raises(CaptureError, match=line):
        load_capture(capture)
    with expect(line):
        BitymiDataParserConfig(data=capture).setup().get_dataparser_outputs("train")
