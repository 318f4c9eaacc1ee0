"""World frame of a model: z up by gravity, GPS or the cameras; metres by GPS."""

import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, TypeAdapter
from scipy.spatial.transform import Rotation

from bitymi_ns.files import write_file
from bitymi_ns.safe_reading import read_json
from . import pycolmap
from .types import warn

GPS_ERROR = 5.0  # of phones, metres
LEAST_SPREAD = 4 * GPS_ERROR  # of positions that determine the scale, metres
AGREEMENTS = (1.0, 2.5, GPS_ERROR, 2 * GPS_ERROR)  # metres within which positions may agree
SAME_SHAPE = 0.5  # largest error of an alignment, relative to the spread
FILE = "frame.json"  # beside the report
UP = (0.0, 0.0, 1.0)  # up in the world frame
SAME_UP = np.cos(np.radians(10.0))  # cosine of the largest angle between equal ups
STEEPEST = np.cos(np.radians(45.0))  # cosine of the largest angle between GPS's up and gravity that counts


@dataclass(frozen=True)
class WorldFrame:
    up: Literal["gps", "gravity", "cameras"]  # source of up (+z)
    metres_per_unit: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None  # 1 by GPS; None = unknown
    gps_origin: tuple[float, float, float] | None
    """Latitude, longitude (degrees) and altitude (metres) of the origin, with x east and y north."""
    gps_error: float | None  # median distance of cameras from GPS positions that agree, metres
    gps_positions: int  # photographs with a position
    transform: list[list[float]]  # [3, 4] from COLMAP's world, with scale
    gps_agreeing: int = 0  # photographs whose positions agree


def write_frame(folder: Path, frame: WorldFrame) -> None:
    write_file(folder / FILE, (json.dumps(asdict(frame), indent=2) + "\n").encode())


def read_frame(folder: Path) -> WorldFrame | None:
    """Read frame.json; None = none, or another program's."""
    with suppress(OSError, ValueError):
        return TypeAdapter(WorldFrame).validate_python(read_json(folder / FILE))
    return None


def gps_line(folder: Path) -> str:
    """Describe GPS's part in frame.json of a folder; empty = none."""
    frame = read_frame(folder)
    if frame is None or frame.gps_error is None:
        return ""
    agree = f"{frame.gps_agreeing} of {frame.gps_positions} photographs with a position agree"
    return f"GPS makes the world, in metres: {agree}, with a median error of {frame.gps_error:.1f} m."


def local_positions(
    gps: Mapping[str, tuple[float, float, float]],
) -> tuple[dict[str, list[float]], tuple[float, float, float] | None]:
    """Convert GPS positions (degrees, metres) to east, north and up in metres at their middle; also return that."""
    if not gps:
        return {}, None
    values = np.array(list(gps.values()))
    if np.ptp(values[:, 1]) > 180:  # on both sides of the antimeridian
        values[:, 1] %= 360
    middle = np.median(values, axis=0)
    local = pycolmap.GPSTransform().ellipsoid_to_enu(values, *middle)
    middle[1] -= 360 * (middle[1] > 180)
    return dict(zip(gps, local.tolist(), strict=True)), tuple(middle.tolist())


def move_to_world(
    model: pycolmap.Reconstruction,
    gps: Mapping[str, tuple[float, float, float]],
    ups: Mapping[str, tuple[float, float, float]] | None = None,
) -> WorldFrame:
    """Transform a model in place to a world with z up: by accelerometers, if most agree to 10 degrees and with GPS's up
    (if known) to 45; else by GPS, if its positions determine it; else by the cameras' mean up. Scale and north are
    GPS's if it determines them. `gps`: degrees and metres; `ups`: unit vectors in the cameras' axes (OpenCV)."""
    up = _by_gravity(model, ups or {})
    local, origin = local_positions(gps)
    centers = {i.name: i.projection_center() for i in model.images.values() if i.has_pose}
    names = [name for name in centers if name in local]
    placed = np.array([centers[n] for n in names])
    positions = np.array([local[n] for n in names])
    if (by_gps := _by_gps(placed, positions)) is not None:
        similarity, agree = by_gps
        source = "gps"
        by_phones = None if up is None else similarity.rotation.matrix() @ up
        if by_phones is not None and by_phones @ UP > STEEPEST:
            turn, _ = Rotation.align_vectors(UP, by_phones)
            turn = pycolmap.Rotation3d(turn.as_matrix())
            source = "gravity"
            similarity = pycolmap.Sim3d(1.0, turn, np.zeros(3)) * similarity
        model.transform(similarity)
        error = float(np.median(_gps_errors(similarity, placed, positions)[agree]))
        return WorldFrame(source, 1.0, origin, error, len(local), similarity.matrix().tolist(), int(agree.sum()))
    similarity = _by_up(model, np.array(list(centers.values())), up)
    model.transform(similarity)
    source = "cameras" if up is None else "gravity"
    return WorldFrame(source, None, None, None, len(local), similarity.matrix().tolist())


def _gps_errors(similarity: pycolmap.Sim3d, centers: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Measure distances [n] in metres between transformed cameras and their GPS positions [n, 3]."""
    return np.linalg.norm((similarity * centers) - positions, axis=1)


def _by_gravity(model: pycolmap.Reconstruction, ups: Mapping[str, tuple[float, float, float]]) -> np.ndarray | None:
    """Average the accelerometers' up [3] in the model's world; None unless three, and most of them, agree."""
    images = [image for image in model.images.values() if image.has_pose and image.name in ups]
    if len(images) < 3:
        return None
    directions = np.array([image.cam_from_world().rotation.matrix().T @ ups[image.name] for image in images])
    agreeing = directions @ directions.T > SAME_UP
    most = agreeing[np.argmax(agreeing.sum(axis=1))]
    if most.sum() < 3 or most.mean() <= 0.5:
        return None
    up = directions[most].mean(axis=0)
    return up / np.linalg.norm(up)


def _by_gps(centers: np.ndarray, positions: np.ndarray) -> tuple[pycolmap.Sim3d, np.ndarray] | None:
    """Align centers with positions [n, 3] in metres, and mark those that agree [n]. None = they
    are too few, too close together, on one line, or of another shape than centers [n, 3]."""
    if len(positions) < 3:
        return None
    spread = np.linalg.svd(positions - positions.mean(axis=0), compute_uv=False) / np.sqrt(len(positions))
    shape = np.linalg.svd(centers - centers.mean(axis=0), compute_uv=False)
    if spread[0] < LEAST_SPREAD or spread[1] < LEAST_SPREAD / 2 or shape[1] < 0.05 * shape[0]:
        return None
    options = pycolmap.RANSACOptions(random_seed=0)
    for error in AGREEMENTS:  # the least to which half agree: others may be of another flight
        options.max_error = error
        result = pycolmap.estimate_sim3d_robust(centers, positions, options)
        if result is None:
            continue
        similarity = result["tgt_from_src"] if isinstance(result, dict) else result  # as pycolmap 4.1 and 4.2 have it
        errors = _gps_errors(similarity, centers, positions)
        if 2 * (errors <= error).sum() >= len(errors):
            agree = errors <= 2 * error  # with those that noise puts farther away
            similarity = pycolmap.estimate_sim3d(centers[agree], positions[agree])
            if similarity is None:
                return None
            same_shape = np.median(_gps_errors(similarity, centers, positions)[agree]) < SAME_SHAPE * spread[0]
            return (similarity, agree) if same_shape else None
    warn(f"GPS is not used: fewer than half of {len(positions)} photographs agree on it to {AGREEMENTS[-1]:g} m.")
    return None


def _by_up(model: pycolmap.Reconstruction, centers: np.ndarray, up: np.ndarray | None) -> pycolmap.Sim3d:
    """Make the similarity that turns `up` (None = the cameras' mean) to z, and centers and scales the cameras."""
    turns = np.array([image.cam_from_world().rotation.matrix() for image in model.images.values() if image.has_pose])
    side, down, _ = turns.mean(0)
    axis = up
    if axis is None:
        axis = -down if np.linalg.norm(down) >= 0.1 else -turns[0, 1]  # the cameras' ups may cancel
        axis = axis / np.linalg.norm(axis)
    side = side - axis * (axis @ side)
    if np.linalg.norm(side) < 1e-3:
        side = np.cross(axis, [1.0, 0, 0] if abs(axis[0]) < 0.9 else [0, 1.0, 0])
    side /= np.linalg.norm(side)
    turn = np.stack([side, np.cross(axis, side), axis])
    middle = centers.mean(axis=0)
    size = float(np.mean(np.linalg.norm(centers - middle, axis=1)))
    scale = 1.0 / size if size > 0 else 1.0
    return pycolmap.Sim3d(scale, pycolmap.Rotation3d(turn), -scale * turn @ middle)
