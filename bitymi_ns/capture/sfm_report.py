"""Report on structure from motion: report.json with errors and photographs left out, a plot of cameras and points."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bitymi_ns.files import write_file

if TYPE_CHECKING:  # slow to import
    import pycolmap

VALUES, PICTURE = "report.json", "cameras.png"
FILES = (VALUES, PICTURE, "frame.json")  # of a report; frame.py writes the last one
MOST_POINTS = 20_000  # most points in the plot, drawn at random


def write_report(folder: Path, values: Mapping[str, Any], model: pycolmap.Reconstruction) -> None:
    """Write `values`, and a plot of a model with z up."""
    from matplotlib import style

    write_file(folder / VALUES, (json.dumps(values, indent=2, ensure_ascii=False) + "\n").encode())
    with style.context("default"):  # a matplotlibrc in the current folder may ask for LaTeX
        write_file(folder / PICTURE, _plot(model, "x (m)" if values["metres_per_unit"] is not None else "x"))


def _plot(model: pycolmap.Reconstruction, x_label: str) -> bytes:
    """Draw cameras and points from above (x, y) and from the side (x, z), as PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    points = np.array([point.xyz for point in model.points3D.values()]).reshape(-1, 3)
    colors = np.array([point.color for point in model.points3D.values()], float).reshape(-1, 3) / 255
    placed = [image for image in model.images.values() if image.has_pose]
    centers = np.array([image.projection_center() for image in placed])
    views = np.array([image.viewing_direction() for image in placed])
    if len(points) > MOST_POINTS:
        some = np.random.default_rng(0).choice(len(points), MOST_POINTS, replace=False)
        points, colors = points[some], colors[some]
    middle = np.median(np.vstack([points, centers]), axis=0)
    far = [np.abs(centers - middle).max()]
    if len(points):  # all cameras and 90 % of the points
        far.append(np.quantile(np.abs(points - middle).max(axis=1), 0.9))
    reach = 1.1 * float(max(far)) or 1.0
    figure = Figure(figsize=(12, 6), dpi=100)
    FigureCanvasAgg(figure)
    for column, (up, title) in enumerate(((1, "from above"), (2, "from the side"))):
        axes = figure.add_subplot(1, 2, column + 1)
        axes.scatter(points[:, 0], points[:, up], s=1, c=colors, linewidths=0)
        axes.quiver(centers[:, 0], centers[:, up], views[:, 0], views[:, up], color="crimson", angles="xy", width=0.002)
        axes.scatter(centers[:, 0], centers[:, up], s=8, c="crimson")
        axes.set(aspect="equal", title=title, xlim=(middle[0] - reach, middle[0] + reach))
        axes.set(ylim=(middle[up] - reach, middle[up] + reach), xlabel=x_label, ylabel="yz"[up - 1])
    figure.tight_layout()
    data = io.BytesIO()
    figure.savefig(data, format="png")
    return data.getvalue()
