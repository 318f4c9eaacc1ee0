"""Small captures in nerfstudio's format."""

import shutil
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("nerfstudio")

from bitymi_ns.capture.types import CaptureError
from tests.formats import colmap


@pytest.fixture(autouse=True)
def no_triangulation(monkeypatch: pytest.MonkeyPatch) -> None:
    """Start captures without points from random ones, as COLMAP would take seconds per test."""

    def triangulate(*given: Any) -> Path:
        raise CaptureError("not in this test")

    monkeypatch.setattr("bitymi_ns.capture.known_poses.triangulate", triangulate)


@pytest.fixture
def no_hang() -> Iterator[None]:
    def stop(*_: Any) -> None:
        pytest.fail("it waits for ever")  # not an Exception, which readers turn into a message

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(60)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@pytest.fixture
def capture(room: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(room, tmp_path / "room"))


@pytest.fixture
def project(capture: Path) -> Path:
    """The room as a COLMAP project, with a text model in sparse/0."""
    colmap(capture)
    return capture
