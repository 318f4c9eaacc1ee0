"""Results of this package and of nerfstudio, whose pictures are no photographs wherever they lie."""

import os
import re
from pathlib import Path

from bitymi_ns.reading import open_regular

RENDERED = b"rendered by bitymi-ns"
"""Comment in the pictures and films that ns-render writes of our scenes: frames are called as photographs are."""
BUNDLE, RUN = "pictures of a bundle", "pictures of a training run"
FILES = {
    "bundle.json": (b'"bitymi-bundle"', BUNDLE),
    "config.yml": (b"!!python/object", RUN),
    "pictures.json": (b'"bitymi_pictures"', "pictures of `bitymi bench pictures`"),
    "transforms_eval.json": (b'[\n    {\n        "file_path"', "pictures beside cameras of ns-export"),
}
"""Files that mark a folder as a result: what stands in them, and what the pictures of the folder are."""
HEAD = 1 << 20  # bytes of a file in which its mark stands
_RENDERS = "renders of ns-render"
_SPLITS = {"train", "val", "test", "train+test"}
_MAPS = {"accumulation", "beta", "overdraw", "expected_depth"}
"""Folders that ns-render writes beside `rgb`, and captures do not have; and all that begin with raw- or gt-."""


def result_in(folder: Path) -> str:
    """Say of what result the pictures in a folder are, by the files in it; empty = of none."""
    try:
        names = sorted(os.listdir(folder))
    except OSError:  # it may not be read, and need not be
        return ""
    for name, (mark, what) in FILES.items():
        if name in names and _holds(folder / name, mark):
            return what
    if folder.name in _SPLITS and any(name in _MAPS or name.startswith(("raw-", "gt-")) for name in names):
        return _RENDERS
    pictures = [name for name in names if name.endswith((".jpg", ".png"))]
    if not pictures:
        return ""
    if re.fullmatch(r"eval_img_\d{4,}\.png", pictures[-1]) and all(name.startswith("eval_") for name in pictures):
        return "renders of ns-eval"
    return _RENDERS if _holds(folder / pictures[0], RENDERED, 1 << 10) else ""


def is_capture(folder: Path) -> bool:
    """Test for a capture as ns-process-data and `bitymi sfm` write it, with copies of the photographs."""
    return _holds(folder / "transforms.json", b'"transform_matrix"')


def refusal(folder: Path) -> str:
    """Say why a folder cannot be trained on, and what to do, where it is a bundle or a run; empty = it may be."""
    what = result_in(folder) if folder.is_dir() else ""
    if what == BUNDLE:
        return (
            f"{folder} is a bundle, not a capture: give the folder of its photographs. `bitymi view {folder}` shows "
            "the bundle."
        )
    if what == RUN:
        return (
            f"{folder} is a training run, not a capture: give the folder of its photographs, and --load-dir "
            f"{folder}/nerfstudio_models to go on with the run."
        )
    return ""


def is_rendered_film(path: Path) -> bool:
    """Test for a film that ns-render wrote of a scene of ours."""
    return _holds(path, RENDERED)


def _holds(path: Path, mark: bytes, most: int = HEAD) -> bool:
    try:
        with open_regular(path) as file:
            return mark in file.read(most)
    except OSError:
        return False
