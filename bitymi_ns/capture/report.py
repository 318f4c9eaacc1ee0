"""Report on structure from motion: errors, photographs left out and why, plot of cameras and points."""

from __future__ import annotations

import io
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bitymi_ns.files import write_file
from bitymi_ns.trust import finite_numbers, printable

if TYPE_CHECKING:  # slow to import
    import pycolmap

VALUES, PAGE, PICTURE = "report.json", "report.md", "cameras.png"
FILES = (VALUES, PAGE, PICTURE, "frame.json")  # of a report; frame.py writes the last one
MOST_POINTS = 20_000  # most points in the plot, drawn at random


def write_report(folder: Path, values: Mapping[str, object], model: pycolmap.Reconstruction) -> None:
    """Write the report without frame.json: `values`, a page, and a plot of a model with z up."""
    from matplotlib import style

    write_file(folder / VALUES, (json.dumps(values, indent=2, ensure_ascii=False) + "\n").encode())
    write_file(folder / PAGE, _page(values).encode())
    with style.context("default"):  # a matplotlibrc in the current folder may ask for LaTeX
        _draw(folder / PICTURE, model, values.get("metres_per_unit") is not None)


def overview(values: Mapping[str, Any]) -> dict[str, str]:
    """Format statistics of report.json; a dash stands for what is no number."""
    numbers = {key: values[key] for key in finite_numbers(values)}  # integers stay integers
    stages = finite_numbers(values["seconds"]) if isinstance(values["seconds"], dict) else {}
    seconds = [f"{stage} {value:.1f}" for stage, value in stages.items()]

    def text(key: str, form: str) -> str:
        return form.format(numbers[key]) if key in numbers else "–"

    metres = "metres_per_unit" in numbers
    up = values.get("up") or ("gps" if metres else "cameras")  # earlier reports state none
    world = {"gps": "z up by GPS", "gravity": "z up by gravity"}.get(str(up), "z up by the cameras")
    error = f" (median error {numbers['gps_error']:.1f} m)" if "gps_error" in numbers else ""
    return {
        "Photographs with a pose": f"{text('registered', '{:,}')} of {text('given', '{:,}')}",
        "Mean reprojection error, pixels": text("reprojection_error", "{:.3f}"),
        "Mean track length, photographs per point": text("track_length", "{:.2f}"),
        "Points": text("points", "{:,}"),
        "Median parallax, degrees": text("parallax_degrees", "{:.1f}"),
        "Matches that contradict the poses": text("contradicted", "{:.1%}"),
        "Up, scale": f"{world}, metres by GPS{error}" if metres else f"{world}, scale not known",
        "Seconds": ", ".join(seconds),
    }


def _page(values: Mapping[str, Any]) -> str:
    cameras = [(c["model"], ", ".join(f"{p:.5g}" for p in c["params"]), c["prior"]) for c in values["cameras"]]
    parts = [
        "# Camera poses",
        f"Source: {_cell(values['source'])}",
        _table(("", ""), overview(values).items()),
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
