"""Check a model: cameras that no points link to the others, and matches that contradict the poses."""

from pathlib import Path

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from bitymi_ns.capture import pycolmap
from bitymi_ns.capture.sfm.job import MAX_ERROR

LINK = 15  # points seen together that link two photographs; COLMAP's least number of inliers of a pair


def drop_unlinked(model: pycolmap.Reconstruction) -> None:
    """Remove the poses of cameras that too few points link to the largest group: they are arbitrary.

    Mappers register such cameras by directions between pairs, whose points the filters may have removed.
    """
    placed = [image for image in model.images.values() if image.has_pose]
    column = {image.image_id: i for i, image in enumerate(placed)}
    tracks = [sorted({column[e.image_id] for e in p.track.elements}) for p in model.points3D.values()]
    columns = np.array([i for track in tracks for i in track], int)
    starts = np.cumsum([0, *map(len, tracks)])
    seen = csr_matrix((np.ones(len(columns), np.int32), columns, starts), (len(tracks), len(placed)))
    _, part = connected_components(seen.T @ seen >= LINK, directed=False)
    if not len(part):
        return
    largest = np.bincount(part).argmax()
    for image, of in zip(placed, part, strict=True):
        if of != largest:
            model.deregister_frame(image.frame_id)


def contradicted(model: pycolmap.Reconstruction, database: Path, pixel: float) -> float:
    """Compute the share of verified matches between placed photographs that poses contradict: the rays pass each other
    by more than `MAX_ERROR` pixels of `Job.pixel`, or meet behind a camera."""
    placed = {i: image for i, image in model.images.items() if image.has_pose}
    total = against = 0
    with pycolmap.Database.open(database) as opened:
        pixels = {i: opened.read_keypoints(i)[:, :2].astype(np.float64) for i in placed}
        rays = {i: np.asarray(image.camera.cam_ray_from_img(pixels[i])) for i, image in placed.items()}
        for pair, geometry in zip(*opened.read_two_view_geometries(), strict=True):
            first, second = pycolmap.pair_id_to_image_pair(pair)
            matches = np.asarray(geometry.inlier_matches)
            if first not in placed or second not in placed or len(matches) < LINK:
                continue
            camera = placed[second].camera
            focal = camera.width / (2.0 * np.pi) if camera.is_spherical() else camera.mean_focal_length()
            limit = MAX_ERROR * pixel / focal  # angle in the middle of the picture
            a, b = (rays[i][column] for i, column in zip((first, second), matches.T, strict=True))
            move = placed[second].cam_from_world() * placed[first].cam_from_world().inverse()
            total += len(matches)
            against += int((~rays_meet(a, b, move.matrix(), limit)).sum())
    return against / max(total, 1)


def rays_meet(a: np.ndarray, b: np.ndarray, move: np.ndarray, limit: float | np.ndarray) -> np.ndarray:
    """Test [n] which pairs of unit rays [n,3], in their cameras' axes, meet in front of both. `move`: [3,4], first
    camera to second; `limit`: largest angle in radians between a ray and the plane of the other and both centres."""
    a, step = a @ move[:, :3].T, move[:, 3]
    normal = np.cross(np.broadcast_to(step, a.shape), a)
    off = np.abs((normal * b).sum(1)) / np.maximum(np.linalg.norm(normal, axis=1), 1e-12)
    cosine = (a * b).sum(1)
    along_a, along_b = cosine * (b @ step) - a @ step, b @ step - cosine * (a @ step)  # times sin^2 of their angle
    parallel = 1.0 - cosine**2 < limit**2
    return (off < limit) & (((along_a > 0.0) & (along_b > 0.0)) | (parallel & (cosine > 0.0)))
