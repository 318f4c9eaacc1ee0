"""Cached results: kept, and removed."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from bitymi_ns import locks
from bitymi_ns.capture.cache import keep_work_folder
from bitymi_ns.capture.known_poses import triangulate
from bitymi_ns.capture.poses import find_poses
from bitymi_ns.capture.sfm import process
from bitymi_ns.capture.sfm.job import Job
from bitymi_ns.capture.types import CaptureError, ColmapCamera, Photograph, SfmOptions


@pytest.fixture
def kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Path]:
    """Find poses with these options by a stub; returns the working folder."""
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
    keep_work_folder(first)
    touch(photographs, 10)
    second = kept(photographs)
    assert first.is_dir()
    (mark,) = first.glob(".in-use-*")
    locks.release(mark)
    mark.touch()  # as a killed process leaves it
    touch(photographs, 20)
    kept(photographs)
    assert not first.exists() and not second.exists()


@pytest.fixture
def triangulated(photographs: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Path]:
    """Triangulate points by a stub; returns the working folder."""
    runs: list[Job] = []
    monkeypatch.setattr(process, "run", lambda job, *told: runs.append(job))

    def find(**masks: Path) -> Path:
        camera = ColmapCamera("PINHOLE", 64, 48, (64.0, 64.0, 32.0, 24.0))
        files = sorted(photographs.glob("*.png"))
        views = [Photograph(file, camera, np.eye(4), "", **masks) for file in files]
        before = len(runs)
        model = triangulate(photographs, views)
        find.anew = len(runs) > before  # type: ignore[attr-defined]
        return model.parent

    return find


def test_points_of_photographs_as_they_were_are_removed_and_poses_stay(
    photographs: Path, kept: Callable[..., Path], triangulated: Any
) -> None:
    poses, first = kept(photographs), triangulated()
    assert first.name.startswith("points-") and triangulated.anew
    assert triangulated() == first and not triangulated.anew
    touch(photographs, 10)
    second = triangulated()
    assert second.is_dir() and not first.exists() and poses.is_dir()
    kept(photographs)
    assert not poses.exists() and second.is_dir()


@pytest.mark.parametrize("place", ["", "beside"])
def test_points_in_a_folder_of_others_are_not_read(
    place: str, photographs: Path, kept: Callable[..., Path], triangulated: Any, tmp_path: Path
) -> None:
    work = triangulated()
    if place:
        work.parent.rename(tmp_path / "theirs")
        work.parent.symlink_to(tmp_path / "theirs")
    else:
        work.chmod(0o777)
    assert triangulated().is_relative_to(tmp_path / "cache") and triangulated.anew


def test_masks_of_points_are_not_written_through_links(
    photographs: Path, kept: Callable[..., Path], triangulated: Any, tmp_path: Path
) -> None:
    mask, victim = tmp_path / "mask.png", tmp_path / "precious"
    Image.new("L", (64, 48), 255).save(mask)
    victim.write_text("precious")
    work = triangulated(mask=mask)
    (work / "points").unlink()
    (work / "masks").mkdir()
    (work / "masks/000000.png.png").symlink_to(victim)
    assert triangulated(mask=mask) == work and triangulated.anew and victim.read_text() == "precious"


def test_photographs_that_are_none_give_no_points(photographs: Path, triangulated: Any) -> None:
    with pytest.raises(CaptureError, match=r"precious.png cannot be read"):
        mask = photographs.parent / "precious.png"
        Image.new("RGB", (64, 48)).save(mask, "EPS")
        triangulated(mask=mask)
