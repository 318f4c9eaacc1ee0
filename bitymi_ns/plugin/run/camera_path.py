"""Read and check camera paths of `ns-render camera-path`, and write them for nerfstudio."""

import atexit
import math
import shutil
import tempfile
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, BaseModel, Field, ValidationError

from bitymi_ns.files import write_errors_as
from bitymi_ns.ranges import first_problem
from bitymi_ns.safe_reading import read_json, reading
from ..console import InputError, fail, warn

MOST_PIXELS = 16_384  # along a side of a frame
SLACK = 1e-3  # tolerance of R R^T = I
HELP = "Record it in the viewer of the run or bundle, or write nerfstudio's format."


def _pose(value: list[Any]) -> list[float]:
    """Check a row-major camera-to-world matrix [4, 4]: rotation, position."""
    try:
        matrix = np.array(value, np.float64).reshape(4, 4)
    except (TypeError, ValueError, OverflowError):
        raise ValueError("must be 16 numbers, a matrix by rows") from None
    turn = matrix[:3, :3]
    if not (np.isfinite(matrix).all() and np.abs(turn @ turn.T - np.eye(3)).max() < SLACK and np.linalg.det(turn) > 0):
        raise ValueError("must be a rotation and a position: camera to world, x right, y up, z backward")
    return matrix.ravel().tolist()


_Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
_Coordinate = Annotated[float, Field(allow_inf_nan=False)]
_Share = Annotated[float, Field(ge=-1, le=2)]
_Side = Annotated[int, Field(ge=1, le=MOST_PIXELS)]


class _Frame(BaseModel):
    camera_to_world: Annotated[list[Any], AfterValidator(_pose)]
    fov: Annotated[float, Field(gt=0, lt=180)]
    principal_point: Annotated[list[_Share], Field(min_length=2, max_length=2)] = [0.5, 0.5]


class _Crop(BaseModel):
    crop_center: Annotated[list[_Coordinate], Field(min_length=3, max_length=3)]
    crop_scale: Annotated[list[_Positive], Field(min_length=3, max_length=3)]
    crop_rot: Annotated[list[_Coordinate], Field(min_length=3, max_length=3)] = [0.0, 0.0, 0.0]
    crop_bg_color: dict[str, float] = {"r": 0.0, "g": 0.0, "b": 0.0}  # not drawn


class CameraPath(BaseModel):
    """Camera path in nerfstudio's format, without its unused entries."""

    render_width: _Side
    render_height: _Side
    seconds: _Positive
    camera_path: list[_Frame]
    camera_type: str = "perspective"
    crop: _Crop | None = None

    @property
    def rate(self) -> float:
        """Frames per second."""
        return len(self.camera_path) / self.seconds

    def written(self) -> Path:
        """Write the path to a file that lasts as long as the process."""
        folder = Path(tempfile.gettempdir())
        with write_errors_as(folder, InputError):
            folder = Path(tempfile.mkdtemp(prefix="bitymi-path-"))
            atexit.register(shutil.rmtree, folder, ignore_errors=True)
            file = folder / "camera_path.json"
            file.write_text(self.model_dump_json(), "utf-8")
        return file


def read_camera_path(file: Path) -> CameraPath:
    """Read a camera path; warn if its fields of view look like radians."""
    with reading(f"the camera path {file}", InputError, f"{HELP} (--camera-path-filename)"):
        content = read_json(file)
    if isinstance(content, dict) and (content.get("seconds") == 0 or content.get("camera_path") == []):
        fail(f"the camera path {file} has no frames: add a second keyframe, and save it again.")
    try:
        path = CameraPath.model_validate(content)
    except ValidationError as error:
        where, what = first_problem(error)
        fail(f"the camera path {file} cannot be used: {where + ': ' if where else ''}{what}. {HELP}", error)
    if path.camera_type.lower() not in ("perspective", "pinhole"):
        fail(f"the camera path {file} is for {path.camera_type} cameras: save it again with perspective ones.")
    widest = max(frame.fov for frame in path.camera_path)
    if widest < math.pi:
        radians = f"If radians were meant, fov has to be {math.degrees(widest):.3g}."
        warn(f"The fields of view of {file} are at most {widest:.3g} degrees. {radians}")
    return path
