"""Check of the camera paths that `ns-render camera-path` reads, before the scene is loaded."""

import json
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, BaseModel, Field, ValidationError

from bitymi_ns.plugin.console import fail, warn
from bitymi_ns.ranges import first_problem

MOST_PIXELS = 16_384  # along a side of a frame
SLACK = 1e-3  # of a rotation that was stored with rounding
HELP = "Record it in the viewer of the run or bundle, or write nerfstudio's format."


def _pose(value: list[Any]) -> list[Any]:
    """The 16 numbers of a matrix [4, 4] by rows: a rotation and a position."""
    try:
        matrix = np.array(value, np.float64).reshape(4, 4)
    except (TypeError, ValueError):
        raise ValueError("must be 16 numbers, a matrix by rows") from None
    turn = matrix[:3, :3]
    if not (np.isfinite(matrix).all() and np.abs(turn @ turn.T - np.eye(3)).max() < SLACK and np.linalg.det(turn) > 0):
        raise ValueError("must be a rotation and a position: camera to world, x right, y up, z backward")
    return value


_Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
_Share = Annotated[float, Field(ge=-1, le=2)]
_Side = Annotated[int, Field(ge=1, le=MOST_PIXELS)]


class _Frame(BaseModel):
    camera_to_world: Annotated[list[Any], AfterValidator(_pose)]
    fov: Annotated[float, Field(gt=0, lt=180)]
    principal_point: Annotated[list[_Share], Field(min_length=2, max_length=2)] = [0.5, 0.5]


class _Path(BaseModel):
    render_width: _Side
    render_height: _Side
    seconds: _Positive
    camera_path: Annotated[list[_Frame], Field(min_length=1)]
    camera_type: str = "perspective"
    crop: Any = None


def check_camera_path(file: Path) -> float:
    """Stop where a file is no camera path that can be rendered; warn of what is ignored.

    Returns:
        frames per second.

    Raises:
        InputError: naming the file, the field and what is wrong with it.
    """
    try:
        found = json.loads(file.read_text("utf-8"))
        path = _Path.model_validate(found)
    except OSError as error:
        fail(f"the camera path {file} cannot be read: {error.strerror} (--camera-path-filename).", error)
    except ValidationError as error:
        where, what = first_problem(error)
        fail(f"the camera path {file} cannot be used: {where + ': ' if where else ''}{what}. {HELP}", error)
    except ValueError as error:
        fail(f"the camera path {file} is no JSON in UTF-8 ({error}). {HELP}", error)
    if path.camera_type.lower() not in ("perspective", "pinhole"):
        fail(
            f"the camera path {file} is for cameras of type {path.camera_type}: only perspective cameras can be "
            "rendered. Choose perspective in the viewer's render tab and save the path again."
        )
    if path.crop is not None:
        warn("Crop boxes are not supported: the whole scene is rendered.")
    return len(path.camera_path) / path.seconds
