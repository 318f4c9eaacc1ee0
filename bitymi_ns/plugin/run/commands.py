"""The nerfstudio command that loads one of our scenes: which it is, whether it can work on them, and where the capture
is that it needs."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import Any

from bitymi_ns.plugin.errors import fail

DATA = "BITYMI_DATA"
"""Environment variable: where a capture is now; most of nerfstudio's commands that read a run have no option for it."""
MOVED = f"If it was moved, say where it is now: `{DATA}=/where/it/is` before the command."
_MESH = "For a textured mesh or Gaussian splats of a bundle run `bitymi extras`."
REFUSED = {
    "SpiralRender": (
        "ns-render spiral knows nerfstudio's own data managers alone. Use `ns-render interpolate` between the "
        "capture's cameras, or `ns-render camera-path` on a path made in the viewer."
    ),
    "ExportPointCloud": f"ns-export pointcloud needs rays, and surfels are drawn as whole pictures. {_MESH}",
    "ExportTSDFMesh": f"ns-export tsdf needs rays, and surfels are drawn as whole pictures. {_MESH}",
    "ExportPoissonMesh": f"ns-export poisson needs rays, and surfels are drawn as whole pictures. {_MESH}",
    "ExportMarchingCubesMesh": f"ns-export marching-cubes needs a field of distances, which surfels have not. {_MESH}",
    "ExportGaussianSplat": f"ns-export gaussian-splat is for splatfacto. {_MESH}",
}
"""What cannot work on a scene of surfels, by the class of nerfstudio's script, and what does."""
SCRIPTS = ("nerfstudio.scripts.", "__main__")


def _callers() -> Iterator[FrameType]:
    frame: FrameType | None = sys._getframe(1)
    while frame is not None:
        yield frame
        frame = frame.f_back


def folder_being_evaluated() -> Path | None:
    """The folder of the config.yml that nerfstudio's eval_setup is loading, which it does not pass on; else None."""
    for frame in _callers():
        if frame.f_code.co_name == "eval_setup" and isinstance(frame.f_locals.get("config_path"), Path):
            return frame.f_locals["config_path"].absolute().parent
    return None


def refuse_others() -> None:
    """Stop where the command that loads a scene cannot work on it, before it is loaded."""
    for frame in _callers():
        owner = type(frame.f_locals.get("self"))
        if owner.__name__ in REFUSED and owner.__module__.startswith(SCRIPTS):
            fail(REFUSED[owner.__name__])


def moved_capture(datamanager: Any) -> None:
    """Read the capture where `DATA` says it is now, if it says anything."""
    given = os.environ.get(DATA)
    if not given:
        return
    place = Path(os.path.expanduser(given)).absolute()
    if not place.exists():
        fail(f"{DATA} says that the capture is {place}, which does not exist. Correct it.")
    datamanager.data = place
    datamanager.dataparser.data = place


def how_to_say_where() -> str:
    """How to tell the running command where its capture is."""
    return "Give its folder with --data." if folder_being_evaluated() is None else MOVED
