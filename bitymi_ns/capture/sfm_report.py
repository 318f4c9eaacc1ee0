"""Report on structure from motion: errors, photographs left out and why, plot of cameras and points."""

from __future__ import annotations

import io
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bitymi_ns.files import write_file
from bitymi_ns.trust import printable

if TYPE_CHECKING:  # slow to import
    import pycolmap

VALUES, PAGE, PICTURE = "report.json", "report.md", "cameras.png"
FILES = (VALUES, PAGE, PICTURE, "frame.json")  # of a report; frame.py writes the last one
MOST_POINTS = 20_000  # most points in the plot, drawn at random


def write_report(folder: Path, values: Mapping[str, Any], model: pycolmap.Reconstruction) -> None:
    """Write the report without frame.json: `values`, a page, and a plot of a model with z up."""
    from matplotlib import style

    write_file(folder / VALUES, (json.dumps(values, indent=2, ensure_ascii=False) + "\n").encode())
    write_file(folder / PAGE, _page(values).encode())
    with style.context("default"):  # a matplotlibrc in the current folder may ask for LaTeX
        _draw(folder / PICTURE, model, values["metres_per_unit"] is not None)


def _page(values: Mapping[str, Any]) -> str:
    world = {"gps": "z up by GPS", "gravity": "z up by gravity", "cameras": "z up by the cameras"}[values["up"]]
    error, scale = values["gps_error"], "scale not known"
    if values["metres_per_unit"] is not None:
        scale = "metres by GPS" if error is None else f"metres by GPS (median error {error:.1f} m)"
    statistics = {
        "Photographs with a pose": f"{values['registered']:,} of {values['given']:,}",
        "Mean reprojection error, pixels": f"{values['reprojection_error']:.3f}",
        "Mean track length, photographs per point": f"{values['track_length']:.2f}",
        "Points": f"{values['points']:,}",
        "Median parallax, degrees": f"{values['parallax_degrees']:.1f}",
        "Matches that contradict the poses": f"{values['contradicted']:.1%}",
        "Up, scale": f"{world}, {scale}",
        "Seconds": ", ".join(f"{stage} {value:.1f}" for stage, value in values["seconds"].items()),
    }
    cameras = [(c["model"], ", ".join(f"{p:.5g}" for p in c["params"]), c["prior"]) for c in values["cameras"]]
    parts = [
        "# Camera poses",
        f"Source: {_cell(values['source'])}",
        _table(("", ""), statistics.items()),
        f"![cameras and points, from above and from the side]({PICTURE})",
    ]
    if values["left_out"]:
        parts += ["## Left out", _table(("photograph", "why"), values["left_out"].items())]
    if values["notes"]:
        parts += ["## Notes", _table(("photograph", ""), values["notes"].items())]
    parts += ["## Cameras", _table(("model", "parameters", "focal length known from EXIF"), cameras)]
    return "\n\n".join(parts) + "\n"


def _table(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    lines = [[_cell(cell) for cell in row] for row in (header, *rows)]
    lines.insert(1, ["---"] * len(header))
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _cell(text: object) -> str:
    return printable(str(text)).replace("|", "\\|").replace("\n", " ")


def _draw(path: Path, model: pycolmap.Reconstruction, metres: bool) -> None:
    """Draw cameras and points from above (x, y) and from the side (x, z)."""
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
        axes.set(ylim=(middle[up] - reach, middle[up] + reach), xlabel="x (m)" if metres else "x", ylabel="yz"[up - 1])
    figure.tight_layout()
    data = io.BytesIO()
    figure.savefig(data, format="png")
    write_file(path, data.getvalue())
