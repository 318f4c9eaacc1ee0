"""Check a model, explain why photographs have no pose, and what to photograph differently."""

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.cluster.hierarchy import DisjointSet
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from .. import pycolmap
from .job import MAX_ERROR, CameraGroup, Job, NoPoses

LINK = 15  # points that link two photographs; COLMAP's least inliers of a pair
FEW_FEATURES = 60  # features of a photograph with hardly any detail
PARALLAX = 1.0  # largest parallax (`parallax`) of photographs from one spot, degrees
ROTATED = 2.0  # error up to which a rotation explains a match, in pixels of the images with features
MOST = 0.9
"""Least share of a pair's matches, and of the pairs, that a rotation explains if the camera only turned; fewer if it
moves before a far background."""
PAIRS_TRIED = 60
TELLING = 30  # fewest matches of a pair that tell a rotation from a translation
GUESSES = (0.5, 0.6, 0.7, 0.85, 1.0, 1.2, 1.5, 2.0, 3.0)  # unknown focal lengths, in longer sides

SHOOT = "Walk round it, and let each photograph share at least two thirds with the one before"
FROM_ONE_SPOT = "the photographs were taken from one spot, which tells nothing of depth. Step sideways between them"


@dataclass(frozen=True)
class ViewGraph:
    features: dict[str, int]  # per photograph
    inliers: dict[tuple[str, str], int]  # matches per pair that fit a common geometry

    def components(self) -> list[set[str]]:
        """List connected sets of photographs, the largest first, without single ones."""
        sets = DisjointSet(self.features)
        for first, second in self.inliers:
            sets.merge(first, second)
        return sorted((part for part in sets.subsets() if len(part) > 1), key=len, reverse=True)


def view_graph(database: Path) -> ViewGraph:
    with pycolmap.Database.open(database) as opened:
        names = {image.image_id: image.name for image in opened.read_all_images()}
        features = {name: opened.num_keypoints_for_image(i) for i, name in names.items()}
        pairs, counts = opened.read_two_view_geometry_num_inliers()
    inliers = {}
    for pair, count in zip(pairs, counts, strict=True):
        if count > 0:
            first, second = pycolmap.pair_id_to_image_pair(pair)
            inliers[names[first], names[second]] = int(count)
    return ViewGraph(features, inliers)


def left_out(graph: ViewGraph, placed: set[str], title: dict[str, str]) -> dict[str, str]:
    """Explain by name (`title`) why photographs other than the `placed` ones have no pose."""
    best: Counter[str] = Counter()  # most matches with another photograph
    with_placed: Counter[str] = Counter()
    for (first, second), count in graph.inliers.items():
        for name, partner in ((first, second), (second, first)):
            best[name] = max(best[name], count)
            with_placed[name] = max(with_placed[name], count * (partner in placed))
    reasons = {}
    for name, count in graph.features.items():
        if name in placed:
            continue
        if count < FEW_FEATURES:
            why = f"hardly any detail in it: {count} features (blurred, dark, or a bare surface)"
        elif not best[name]:
            why = "no other photograph shows the same: take some in between"
        elif not with_placed[name]:
            why = "it overlaps only with others that were left out as well: take some in between"
        else:
            why = f"too little in common with the others: {with_placed[name]} matches with the most similar one"
        reasons[title[name]] = why
    return reasons


def why_none(job: Job, graph: ViewGraph) -> NoPoses:
    count = len(job.order)
    bare = sum(features < FEW_FEATURES for features in graph.features.values())
    if bare > count / 2:
        why = f"fewer than {FEW_FEATURES} features: they are blurred, dark, or show bare surfaces"
        return NoPoses(f"{bare} of {count} photographs show hardly any detail ({why}). Take in more, in more light")
    parts = graph.components()
    if not parts or len(parts[0]) < max(3, 0.2 * count):
        together = f"at most {len(parts[0])} of {count} are connected" if parts else "no two of them show the same"
        return NoPoses(f"the photographs do not overlap: {together}. {SHOOT}")
    why = f"the scene may have moved between them, or the camera hardly did. {SHOOT}"
    return NoPoses(f"{len(parts[0])} of {count} photographs overlap, but no poses explain what they show: {why}")


def parallax(model: pycolmap.Reconstruction) -> float:
    """Compute the median over the points of the widest angle between two rays, degrees."""
    centers = {image.image_id: image.projection_center() for image in model.images.values() if image.has_pose}
    ids = list(model.point3D_ids())
    angles = []
    for point_id in ids[:: max(1, len(ids) // 1000)]:
        point = model.point3D(point_id)
        rays = np.array([point.xyz - centers[e.image_id] for e in point.track.elements])
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        angles.append(np.degrees(np.arccos(np.clip((rays @ rays.T).min(), -1, 1))))
    return float(np.median(angles)) if angles else 0.0


def only_turned(job: Job, database: Path) -> bool:
    """Test if a rotation explains most pairs: the matches fit K R K^-1 for some focal length."""
    groups = {name: group for group in job.cameras for name in group.names}
    with pycolmap.Database.open(database) as opened:
        images = {image.image_id: image for image in opened.read_all_images()}
        points = {i: opened.read_keypoints(i)[:, :2] for i in images}
        pairs, geometries = opened.read_two_view_geometries()
    counted = sorted(zip(pairs, geometries, strict=True), key=lambda item: -len(item[1].inlier_matches))
    counted = [item for item in counted if len(item[1].inlier_matches) >= TELLING]
    tried = counted[:: max(1, len(counted) // PAIRS_TRIED)]  # wide pairs too: neighbours show little parallax
    turned = 0
    for pair, geometry in tried:
        matches = np.asarray(geometry.inlier_matches)
        first, second = pycolmap.pair_id_to_image_pair(pair)
        of_pair = zip((first, second), matches.T, strict=True)
        pair_of = [(groups[images[i].name], points[i][column]) for i, column in of_pair]
        limit = ROTATED * max(1.0, max(pair_of[0][0].camera.size) / job.max_image_size)
        for guess in GUESSES[: 1 if all(group.prior for group, _ in pair_of) else None]:
            (a, focal), (b, _) = (_rays(group, pixels, guess) for group, pixels in pair_of)
            if np.mean(_turn_errors(a, b, focal) < limit) > MOST:
                turned += 1
                break
    return len(tried) > 0 and turned > MOST * len(tried)


def _rays(group: CameraGroup, points: np.ndarray, guess: float) -> tuple[np.ndarray, float]:
    """Make unit rays [n,3] of pixels [n,2], and pixels per radian; `guess`: unknown focal length in longer sides."""
    camera, side = group.camera.colmap, max(group.camera.size)
    if not (group.prior or camera.is_spherical()):
        camera = pycolmap.Camera.create_from_model_name(0, "SIMPLE_PINHOLE", guess * side, *group.camera.size)
    rays = camera.cam_ray_from_img(points.astype(np.float64))
    assert rays is not None  # as for a single point without one
    return rays, _pixels_per_radian(camera)


def _pixels_per_radian(camera: pycolmap.Camera) -> float:
    return camera.width / (2.0 * np.pi) if camera.is_spherical() else camera.mean_focal_length()


def _turn_errors(a: np.ndarray, b: np.ndarray, focal: float) -> np.ndarray:
    """Measure distances [n] in pixels of unit rays [n, 3] after the best rotation; `focal`: pixels per radian."""
    keep = np.ones(len(a), bool)
    for _ in range(3):  # then without the worst half, which has the wrong matches
        turn, _ = Rotation.align_vectors(b[keep], a[keep])
        distances = np.linalg.norm(turn.apply(a) - b, axis=1) * focal
        keep = distances <= np.median(distances)
    return distances


def drop_unlinked(model: pycolmap.Reconstruction) -> None:
    """Remove the poses of cameras that too few points link to the largest group: mappers register
    them by directions between pairs, whose points the filters may have removed."""
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
    for image, group in zip(placed, part, strict=True):
        if group != largest:
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
            limit = MAX_ERROR * pixel / _pixels_per_radian(placed[second].camera)  # angle in the picture's middle
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
