"""The picture of a report."""

from pathlib import Path
from types import SimpleNamespace

import matplotlib
import numpy as np
import pytest
from PIL import Image

from bitymi_ns.capture.report import PICTURE, write_report


def test_it_is_not_drawn_as_the_current_folder_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(matplotlib.rcParams, "text.usetex", True)  # as a matplotlibrc may ask for
    image = SimpleNamespace(
        has_pose=True, projection_center=lambda: np.zeros(3), viewing_direction=lambda: np.array([0.0, 1.0, 0.0])
    )
    model = SimpleNamespace(points3D={}, images={1: image})
    numbers = dict.fromkeys(("registered", "given", "reprojection_error", "track_length", "points"), 1)
    values = {**numbers, "source": "", "parallax_degrees": 1.0, "cameras": []}
    write_report(tmp_path, values | {name: {} for name in ("left_out", "notes", "seconds")}, model)
    with Image.open(tmp_path / PICTURE) as picture:
        assert picture.size == (1200, 600)
