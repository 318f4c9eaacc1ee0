"""A world for the poses: up is up, and metres are metres where GPS says how long they are."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass

import numpy as np
import pycolmap

EARTH = 6378137.0
"""Equatorial radius in metres, WGS 84."""
FLATTENING = 1 / 298.257223563
GPS_ERROR = 5.0
"""Metres by which a phone's GPS is off."""
LEAST_SPREAD = 4 * GPS_ERROR
"""Metres; positions that spread less say nothing of the scale."""
SAME_SHAPE = 0.5
"""The largest error of the alignment, relative to the spread, at which it is believed."""


@dataclass(frozen=True)
class WorldFrame:
    """How the world of a model lies in the real one."""

    up: str
    """Where up comes from: "gps" or "cameras"; it is +z either way."""
    metres_per_unit: float | None
    """1 where GPS gave the scale; None where it is not known."""
    gps_origin: tuple[float, float, float] | None
    """Latitude, longitude (degrees) and altitude (metres) of the world's origin, x east and y north there."""
    gps_error: float | None
    """Median distance in metres between the cameras and their GPS positions."""
    gps_positions: int
    """Photographs with a position."""
    transform: list[list[float]]
    """[3,4] from the world as COLMAP left it to this one, scale included."""

    def values(self) -> dict[str, object]:
        return asdict(self)


def local_positions(
    places: Mapping[str, tuple[float, float, float]],
) -> tuple[dict[str, list[float]], tuple[float, float, float] | None]:
    """East, north and up in metres from the middle of the places, and that middle.

    Args:
        places: latitude, longitude and altitude by name.
    """
    if not places:
        return {}, None
    middle = np.median(np.array(list(places.values())), axis=0)
    latitude = np.radians(middle[0])
    eccentricity = FLATTENING * (2 - FLATTENING)
    w = 1 - eccentricity * np.sin(latitude) ** 2
    north = EARTH * (1 - eccentricity) / w**1.5
    east = EARTH / np.sqrt(w) * np.cos(latitude)
    local = {
        name: [
            float(np.radians(lon - middle[1]) * east),
            float(np.radians(lat - middle[0]) * north),
            float(alt - middle[2]),
        ]
        for name, (lat, lon, alt) in places.items()
    }
    return local, (float(middle[0]), float(middle[1]), float(middle[2]))


def settle(model: pycolmap.Reconstruction, places: Mapping[str, tuple[float, float, float]]) -> WorldFrame:
    """Move a model into a world with z up, by GPS where that is enough, else by the cameras; changed in place."""
    local, origin = local_positions(places)
    centers = {i.name: i.projection_center() for i in model.images.values() if i.has_pose}
    names = [name for name in centers if name in local]
    found = _by_gps(np.array([centers[n] for n in names]), np.array([local[n] for n in names])) if names else None
    if found is not None:
        similarity, error = found
        model.transform(similarity)
        return WorldFrame("gps", 1.0, origin, error, len(local), similarity.matrix().tolist())
    similarity = _by_cameras(model, np.array(list(centers.values())))
    model.transform(similarity)
    return WorldFrame("cameras", None, None, None, len(local), similarity.matrix().tolist())


def _by_gps(centers: np.ndarray, places: np.ndarray) -> tuple[pycolmap.Sim3d, float] | None:
    """The similarity from centers [n,3] to places [n,3] in metres, and its median error; None where it is not to be
    believed: too few, too close together or along one line, or another shape than the cameras'."""
    if len(places) < 3:
        return None
    spread = np.linalg.svd(places - places.mean(axis=0), compute_uv=False) / np.sqrt(len(places))
    shape = np.linalg.svd(centers - centers.mean(axis=0), compute_uv=False)
    if spread[0] < LEAST_SPREAD or spread[1] < LEAST_SPREAD / 2 or shape[1] < 0.05 * shape[0]:
        return None
    options = pycolmap.RANSACOptions()
    options.max_error = 2 * GPS_ERROR
    options.random_seed = 0
    found = pycolmap.estimate_sim3d_robust(centers, places, options)
    if found is None:
        return None
    similarity = found["tgt_from_src"] if isinstance(found, dict) else found  # as pycolmap 4.1 and 4.2 have it
    error = float(np.median(np.linalg.norm((similarity * centers) - places, axis=1)))
    return (similarity, error) if error < SAME_SHAPE * spread[0] else None


def _by_cameras(model: pycolmap.Reconstruction, centers: np.ndarray) -> pycolmap.Sim3d:
    """Up is the cameras' mean up; the origin is the middle of the cameras, and their mean distance from it is 1."""
    turns = [image.cam_from_world().rotation.matrix() for image in model.images.values() if image.has_pose]
    up = -np.mean([turn[1] for turn in turns], axis=0)
    if np.linalg.norm(up) < 0.1:  # they look all ways, or are turned all ways
        up = -turns[0][1]
    up /= np.linalg.norm(up)
    side = np.mean([turn[0] for turn in turns], axis=0)
    side -= up * (up @ side)
    if np.linalg.norm(side) < 1e-3:
        side = np.cross(up, [1.0, 0, 0] if abs(up[0]) < 0.9 else [0, 1.0, 0])
    side /= np.linalg.norm(side)
    turn = np.stack([side, np.cross(up, side), up])
    middle = centers.mean(axis=0)
    size = float(np.mean(np.linalg.norm(centers - middle, axis=1)))
    scale = 1.0 / size if size > 0 else 1.0
    return pycolmap.Sim3d(scale, pycolmap.Rotation3d(turn), -scale * turn @ middle)
