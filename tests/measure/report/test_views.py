"""Held-out views: selection and captions."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from bitymi_ns.measure.report.pictures import compare_views
from tests.measure.report.conftest import page_of


def write(folder: Path, name: str, errors: list[float], tint: float = 0.0) -> list[Path]:
    """Write views whose renders differ from grey photographs by constant errors."""
    paths = []
    (folder / name).mkdir(parents=True)
    for index, error in enumerate(errors):
        photo = np.full((6, 8, 3), 0.4 + tint + 0.01 * index)
        paths.append(folder / name / f"eval_img_{index:04d}.png")
        Image.fromarray((np.concatenate([photo, photo + error], 1) * 255).round().astype(np.uint8)).save(paths[-1])
    return paths


def test_worst_median_and_best_of_trained_scene_and_bundle_side_by_side(tmp_path: Path) -> None:
    trained = write(tmp_path, "trained", [0.1, 0.3, 0.2, 0.05, 0.15])
    baked = write(tmp_path, "baked", [0.1, 0.3, 0.2, 0.01, 0.15])
    notes: list[str] = []
    views = compare_views([*baked, *trained], notes)
    assert notes == []
    titles = ["Worst view of 5: number 1", "Median view of 5: number 4", "Best view of 5: number 3"]
    assert [view.title for view in views] == titles
    for view in views:
        photograph, *renders = [[picture.caption for picture in column] for column in view.columns]
        assert photograph == ["photograph"]
        assert [error for _, error in renders] == ["error of baked", "error of trained"]
        assert all((p.width, p.height) == (8, 6) for column in view.columns for p in column)
    # 8-bit errors of 12 and 2 steps
    best = [column[0].caption for column in views[2].columns]
    assert best == ["photograph", "baked: 42.11 dB", "trained: 26.55 dB"]
    html = page_of(views=views)
    assert html.count("<figure>") == 15 and html.count('<div class="views">') == 3


def test_renders_of_other_photographs_are_apart(tmp_path: Path) -> None:
    views = compare_views([*write(tmp_path, "a", [0.1, 0.2]), *write(tmp_path, "b", [0.1, 0.2], tint=0.1)], [])
    assert [view.title.split(":")[0] for view in views] == ["a", "a", "b", "b"]
    assert all(len(view.columns) == 3 for view in views)


@pytest.mark.parametrize("spoil", ["cut", "odd"])
def test_a_picture_that_cannot_be_used_is_noted(tmp_path: Path, spoil: str) -> None:
    paths = write(tmp_path, "renders", [0.1, 0.2, 0.3])
    if spoil == "cut":
        paths[0].write_bytes(paths[0].read_bytes()[:40])
    else:
        Image.new("RGB", (9, 6)).save(paths[0])
    notes: list[str] = []
    assert len(compare_views(paths, notes)) == 2 and len(notes) == 1 and str(paths[0]) in notes[0]
