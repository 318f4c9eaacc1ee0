"""What is kept of earlier results, and what goes."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest
from PIL import Image

from bitymi_ns import files
from bitymi_ns.capture import SfmOptions, find_poses
from bitymi_ns.capture.cache import read_from


@pytest.fixture
def kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Path]:
    """Finds poses with these options, without looking for any; returns the folder of the work."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    works: list[Path] = []
    monkeypatch.setattr("bitymi_ns.capture.poses._find", lambda *arguments: works.append(arguments[-2]))

    def find(folder: Path, **options: int) -> Path:
        find_poses(folder, SfmOptions(**options))
        return works[-1]

    return find


@pytest.fixture
def photographs(tmp_path: Path) -> Path:
    folder = tmp_path / "photographs"
    folder.mkdir()
    for i in range(3):
        Image.new("L", (64, 48), 50 * i).save(folder / f"{i}.png")
    return folder


def touch(photographs: Path, seconds: int) -> None:
    os.utime(photographs / "0.png", (seconds, seconds))


def test_results_of_photographs_as_they_were_are_removed(photographs: Path, kept: Callable[..., Path]) -> None:
    first, other = kept(photographs), kept(photographs, max_features=1000)
    assert first.is_dir() and other.is_dir() and first != other, "both may have been trained on"
    touch(photographs, 10)
    assert kept(photographs).is_dir() and not first.exists() and not other.exists()


def test_results_of_something_else_stay(photographs: Path, kept: Callable[..., Path], tmp_path: Path) -> None:
    videos = [photographs / name for name in ("a.mp4", "b.mp4")]
    for video in videos:
        video.write_bytes(b"frames")
    of_photographs, *of_videos = [kept(each) for each in (photographs, *videos)]
    unnamed = photographs / ".bitymi/poses-0123456789abcdef"
    unnamed.mkdir()
    touch(photographs, 10)
    kept(photographs)
    assert not of_photographs.exists() and unnamed.is_dir() and all(work.is_dir() for work in of_videos)


def test_what_is_read_from_stays(photographs: Path, kept: Callable[..., Path]) -> None:
    first = kept(photographs)
    read_from(first)
    touch(photographs, 10)
    second = kept(photographs)
    assert first.is_dir()
    (mark,) = first.glob(".in-use-*")
    files.release(mark)
    mark.touch()  # as a killed process leaves it
    touch(photographs, 20)
    kept(photographs)
    assert not first.exists() and not second.exists()
