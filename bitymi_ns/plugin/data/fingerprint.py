"""What a run remembers of the photographs that it was trained on, so that it does not go on with others unnoticed."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import Any

from bitymi_ns.plugin.console import warn
from bitymi_ns.plugin.data.dataset import BitymiDataset

STEP = 1e-4
"""Step in which poses are compared, in the units of the scene."""


def capture_print(dataset: BitymiDataset) -> dict[str, Any]:
    """Number, names and cameras of the training views, the latter two as digests; numbers and text only."""
    cameras = dataset.cameras
    names = "\n".join(path.name for path in dataset.image_filenames)
    return {
        "views": len(dataset),
        "names": hashlib.sha256(names.encode("utf8", "surrogateescape")).hexdigest(),
        "poses": hashlib.sha256((cameras.camera_to_worlds / STEP).round().cpu().numpy().tobytes()).hexdigest(),
    }


def warn_of_another(before: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Say what differs between the captures of a run and of the run that goes on from it."""
    if before["views"] != now["views"]:
        what = f"it had {before['views']} training photographs, this one has {now['views']}"
    elif before["names"] != now["names"]:
        what = "its training photographs have other names"
    elif before["poses"] != now["poses"]:
        what = "its cameras stand elsewhere"
    else:
        return
    warn(
        f"The run that is continued was trained on another capture: {what}. Photographs that are held out now may have "
        "been trained on, and what was learned of another scene stays in the picture. Train anew where that matters."
    )
