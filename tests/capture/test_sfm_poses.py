"""Photographs without poses: arguments of pose estimation."""

from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from bitymi_ns.capture import sfm_poses
from bitymi_ns.capture.recognise import recognise
from bitymi_ns.capture.types import CaptureError, SfmSettings


@pytest.mark.parametrize(
    ("photographs", "data", "given", "masks"),
    [
        ("bed/shots", "bed", None, "bed/masks"),  # not a usual name, but below the given folder
        ("bed/images", "bed/images", None, "bed/masks"),
        ("bed/images", "bed", Path("mine"), "bed/mine"),
        ("bed", "bed", None, "bed/masks"),
        ("bed/all/fox", "bed/all/fox", None, None),
    ],
)
def test_poses_are_found_with_the_masks_of_the_training(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    photographs: str,
    data: str,
    given: Path | None,
    masks: str | None,
) -> None:
    asked: list[Any] = []

    def find_masks(names: Any, base: Path, folder: Path | None, stated: bool) -> None:
        asked.append(folder)
        raise CaptureError("not now")

    monkeypatch.setattr("bitymi_ns.capture.poses.find_masks", find_masks)
    for folder in (photographs, "bed/masks", "bed/mine", "bed/all/masks"):
        (tmp_path / folder).mkdir(parents=True, exist_ok=True)
    for name in "abc":
        Image.new("RGB", (8, 6)).save(tmp_path / photographs / f"{name}.png")
    found = recognise(tmp_path / data, "photographs")
    with pytest.raises(CaptureError, match="not now"):
        sfm_poses.find_sfm_source(found, given, SfmSettings())
    assert asked == [None if masks is None else tmp_path / masks]
