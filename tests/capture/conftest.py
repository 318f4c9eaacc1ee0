"""Photographs of the sample room along an arc, with large overlap."""

import logging
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from bitymi_ns.sample.capture import RoomView, camera_path, render
from bitymi_ns.sample.room import Room

SIZE = (288, 216)
COUNT = 8


@pytest.fixture(scope="session")
def views() -> list[RoomView]:
    return camera_path(60, *SIZE, seed=0)[:COUNT]


@pytest.fixture(scope="session")
def pictures(views: list[RoomView]) -> list[np.ndarray]:
    room = Room(0)
    return [render(room, view, supersample=2) for view in views]


@pytest.fixture(scope="session")
def arc(tmp_path_factory: pytest.TempPathFactory, pictures: list[np.ndarray]) -> Path:
    """The folder of photographs, not to be changed."""
    folder = tmp_path_factory.mktemp("arc")
    for i, picture in enumerate(pictures):
        Image.fromarray(picture).save(folder / f"photo_{i + 1}.png")
    return folder


@pytest.fixture
def copied(arc: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], Path]:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))

    def copy(name: str) -> Path:
        folder = tmp_path / name
        shutil.copytree(arc, folder, ignore=shutil.ignore_patterns(".*"))
        return folder

    return copy


@pytest.fixture
def reported() -> Iterator[list[str]]:
    """Collect the messages of the capture reader."""
    messages: list[str] = []
    handler, logger = logging.Handler(), logging.getLogger("bitymi_ns.capture")
    handler.emit = lambda record: messages.append(record.getMessage())  # type: ignore[method-assign]
    logger.addHandler(handler)
    yield messages
    logger.removeHandler(handler)
