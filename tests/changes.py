"""Changes of a capture's files, which damage them or make no difference."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from tests.captures import edit, edit_frames

Change = Callable[[Path], Any]
"""Damages a file of a capture, or its folder."""


def entries(**values: Any) -> Change:
    """Set entries of a JSON file."""
    return lambda path: edit(path, lambda meta: meta.update(values))


def entry(change: Callable[[dict[str, Any]], Any]) -> Change:
    """Change a JSON file."""
    return lambda path: edit(path, change)


def pose(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    """Change the 3 x 3 part of the fourth pose."""

    def apply(meta: dict[str, Any]) -> None:
        matrix = meta["frames"][3]["transform_matrix"]
        for row, new in zip(matrix, change(np.array(matrix)[:3, :3]).tolist(), strict=False):
            row[:3] = new

    return entry(apply)


def content(data: bytes | str) -> Change:
    """Replace a file."""
    return lambda path: path.write_bytes(data if isinstance(data, bytes) else data.encode())


def text(old: str, new: str) -> Change:
    """Replace text wherever it stands."""

    def apply(path: Path) -> None:
        whole = path.read_text("utf8")
        assert old in whole
        path.write_text(whole.replace(old, new), "utf8")

    return apply


def matrices(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    """Change all poses."""

    def apply(one: dict[str, Any]) -> None:
        one["transform_matrix"] = change(np.array(one["transform_matrix"])).tolist()

    return lambda path: edit_frames(path, apply)


def beside(name: str, change: Change) -> Change:
    """Change another file of the folder."""
    return lambda path: change(path.parent / name)


def given(change: Change | None = None, **options: Any) -> Change:
    """Read the capture with options, changed or not."""
    return lambda path: (change and change(path), options)[1]


def room_of(place: Path) -> Path:
    """Return the folder of a capture's file or model."""
    return place.parents[1] if place.is_dir() else place.parent


def cloud(name: str) -> Change:
    """Move the point cloud to `points/cloud.ply`, and name it so."""

    def apply(path: Path) -> None:
        (path.parent / "points").mkdir()
        (path.parent / "sparse_pc.ply").rename(path.parent / "points/cloud.ply")
        edit(path, lambda meta: meta.update(ply_file_path=name))

    return apply


SPOILT: dict[str, Change] = {
    "pipe": os.mkfifo,
    "folder": os.mkdir,
    "dangling": lambda path: path.symlink_to(path.with_name("nothing")),
    "binary": content(b"\xff\xfe\x00\x80" * 9),
    "deep": content("[" * 100_000),
}
"""Changes that put another thing in a file's place."""
