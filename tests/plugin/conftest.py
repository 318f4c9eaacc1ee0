"""Small captures in nerfstudio's format."""

import shutil
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("nerfstudio")

from bitymi_ns.capture.types import CaptureError
from bitymi_ns.sample import generate
from tests.formats import colmap


@pytest.fixture(autouse=True)
def no_triangulation(monkeypatch: pytest.MonkeyPatch) -> None:
    """Start captures without points from random ones, as COLMAP would take seconds per test."""

    def triangulate(*given: Any) -> Path:
        raise CaptureError("not in this test")

    monkeypatch.setattr("bitymi_ns.capture.known_poses.triangulate", triangulate)


@pytest.fixture(scope="session")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A ray-traced room: 12 views of 48 x 36 pixels with 200 points. Not to be changed."""
    folder = tmp_path_factory.mktemp("captures") / "room"
    generate(folder, views=12, width=48, height=36, seed=0, points=200)
    return folder


@pytest.fixture
def capture(original: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(original, tmp_path / "room"))


@pytest.fixture
def project(capture: Path) -> Path:
    """The room as a COLMAP project, with a text model in sparse/0."""
    colmap(capture)
    return capture
