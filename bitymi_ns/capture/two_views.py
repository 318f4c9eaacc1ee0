"""Match pairs of photographs without their poses, and count the matches that poses explain."""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from bitymi_ns.capture import pycolmap
from bitymi_ns.capture.image_files import image_size, in_proportion, in_threads, read_image
from bitymi_ns.capture.masks import checked_mask
from bitymi_ns.capture.order import natural
from bitymi_ns.capture.sfm.consistency import rays_meet
from bitymi_ns.capture.types import OPENCV_AXES, CaptureError, ColmapCamera, Photograph, Pose
from bitymi_ns.ranges import spread

Array = npt.NDArray[np.float64]
Features = tuple[Array, npt.NDArray[np.float32]]
"""Positions [n, 2] in pixels of the camera, and descriptors [n, 128] of length 1."""
CLIPS, CLIP = 6, 6  # runs of photographs that are consecutive by name, and photographs of each
SIDE = 500  # longer side that photographs are reduced to, pixels; twice as much of 360-degree pictures
FEATURES, COARSE = 1500, 128  # features of a photograph; largest ones that decide on likeness
RATIO = 0.8  # most ratio of the distances of a feature's nearest and second nearest
PAIRS, TRIALS = 20, 80  # pairs wanted, and pairs matched at most
ALIKE = 8  # least matches of coarse features of a pair that is not near by name
LEAST, OWN = 15, 0.4  # least matches of a pair, and share of them, that its own essential matrix explains
SAMPLES = 1000  # random samples in the search for that matrix, at most
MOTION = 0.05  # least median motion between the photographs of a pair, in longer sides
TOLERANCE = 0.004  # largest distance to the epipolar plane, in longer sides; matches that move less tell nothing
STILL = 1e-4  # baseline, relative to the largest coordinate of a camera, below which cameras are at one place


class Pair(NamedTuple):
    """Matches of two photographs, by their indices, in pixels [n, 2] of their cameras."""

    first: int
    second: int
    x: Array
    y: Array
    own: Pose  # [3, 4] pose of the second camera against the first one's that explains most matches


def match_pairs(photographs: Sequence[Photograph]) -> list[Pair]:
    """Match pairs of photographs that are near by name or look alike, and move; their poses are not used."""
    order = sorted(range(len(photographs)), key=lambda i: natural(str(photographs[i].file)))
    if len(order) > CLIPS * CLIP:
        order = [order[i + k] for i in spread(len(order) - CLIP + 1, CLIPS) for k in range(CLIP)]
    order = list(dict.fromkeys(order))
    features = in_threads(lambda i: _features(photographs[i]), order)
    near, wide = [], []
    for i in range(len(order)):
        for j in range(i + 1, len(order)):
            coarse = len(_mutual(*(features[k][1][:COARSE] for k in (i, j)))) if j > i + 2 else ALIKE
            if coarse >= ALIKE:
                (wide if j > i + 2 else near).append((i, j))
    rng = np.random.default_rng(0)
    queues = [[some[i] for i in rng.permutation(len(some))] for some in (near, wide)]
    pairs: list[Pair] = []
    cameras = [each.camera for each in photographs]
    for trial in range(TRIALS):
        queue = queues[trial % 3 == 2] or queues[trial % 3 != 2]
        if not queue or len(pairs) >= PAIRS:
            break
        i, j = queue.pop()
        pair = _match(cameras, order[i], order[j], features[i], features[j])
        pairs += [] if pair is None else [pair]
    return pairs


def _features(photograph: Photograph) -> Features:
    """Find SIFT features, the largest first, with square roots of the histograms as descriptors (Arandjelovic and
    Zisserman, 2012); none if the photograph cannot be read, or not with its camera."""
    camera = photograph.camera
    side = SIDE * (2 if camera.colmap.is_spherical() else 1)
    size = tuple(max(1, round(each * min(1.0, side / max(camera.size)))) for each in camera.size)
    nothing = np.zeros((0, 2)), np.zeros((0, 128), np.float32)
    try:
        image = np.asarray(read_image(photograph.file, wanted=size).convert("RGBA"), np.float32)
        mask = None if photograph.mask is None else np.asarray(checked_mask(photograph.mask).resize(size), np.uint8)
    except CaptureError:  # reported where it is used
        return nothing
    if not in_proportion(image_size(photograph.file) or camera.size, camera.size):
        return nothing
    alpha = image[..., 3:] / 255.0
    grey = (image[..., :3] * alpha + 255.0 * (1.0 - alpha)).mean(-1).astype(np.uint8)
    found, values = cv2.SIFT_create(FEATURES, contrastThreshold=0.02).detectAndCompute(grey, mask)
    if not found:
        return nothing
    largest = np.argsort([-each.size for each in found], kind="stable")
    points = np.array([each.pt for each in found])[largest] + 0.5
    values = np.sqrt(values[largest] / np.maximum(values[largest].sum(1, keepdims=True), 1e-6))
    return points * np.divide(camera.size, size), values


def _mutual(a: npt.NDArray[np.float32], b: npt.NDArray[np.float32]) -> npt.NDArray[np.int64]:
    """Match features [n, 128] and [m, 128], each the other's nearest by far; return their indices [k, 2]."""
    if min(len(a), len(b)) < 2:
        return np.zeros((0, 2), np.int64)
    cosine = a @ b.T
    rows, there = np.arange(len(a)), cosine.argmax(1)
    mutual = cosine.argmax(0)[there] == rows
    best = cosine[rows, there]
    cosine[rows[mutual], there[mutual]] = -1.0
    second = np.maximum(cosine.max(1), cosine.max(0)[there])
    kept = mutual & (1.0 - best < RATIO**2 * (1.0 - second))
    return np.stack([rows[kept], there[kept]], 1)


def _match(cameras: Sequence[ColmapCamera], i: int, j: int, a: Features, b: Features) -> Pair | None:
    """Match two photographs; None = too few matches, or too little motion."""
    matched = _mutual(a[1], b[1])
    x, y = a[0][matched[:, 0]], b[0][matched[:, 1]]
    motion = np.linalg.norm(x / max(cameras[i].size) - y / max(cameras[j].size), axis=1)
    moves = motion > TOLERANCE
    x, y = x[moves], y[moves]
    if len(x) < LEAST or np.median(motion[moves]) < MOTION:
        return None
    options = pycolmap.RANSACOptions(max_num_trials=SAMPLES, random_seed=0)
    options.max_error = TOLERANCE * max(cameras[i].size)
    found = pycolmap.estimate_essential_matrix(x, y, cameras[i].colmap, cameras[j].colmap, options)
    if found is None:
        return None
    pair = Pair(i, j, x, y, found["cam2_from_cam1"].matrix())
    return pair if explained([pair], rays_of([pair], cameras))[0] >= max(LEAST, OWN * len(x)) else None


def rays_of(pairs: Sequence[Pair], cameras: Sequence[ColmapCamera]) -> list[tuple[Array, Array, Array]]:
    """Compute the unit rays [n, 3] of each pair's matches in both cameras' axes (OpenCV), and the tolerances [n] at the
    second one, radians; `cameras` of all photographs."""
    lenses = {camera: camera.colmap for camera in dict.fromkeys(cameras)}
    rays = []
    for pair in pairs:
        first, second = lenses[cameras[pair.first]], lenses[cameras[pair.second]]
        b, step = second.cam_ray_from_img(pair.y), TOLERANCE * max(second.width, second.height) * np.eye(2)
        limits = [np.linalg.norm(second.cam_ray_from_img(pair.y + each) - b, axis=1) for each in step]
        rays.append((first.cam_ray_from_img(pair.x), b, np.fmin(*limits)))
    return rays


def explained(
    pairs: Sequence[Pair], rays: Sequence[tuple[Array, Array, Array]], poses: Pose | None = None
) -> npt.NDArray[np.int64]:
    """Count the matches of each pair [P] whose rays, see `rays_of`, meet in front of both cameras. `poses`: [N, 4, 4]
    camera to world with OpenGL axes, of all photographs; None = the pairs' own."""
    counts = np.zeros(len(pairs), np.int64)
    to_world = None if poses is None else poses @ OPENCV_AXES
    to_camera = None if to_world is None else np.linalg.inv(to_world)
    least = 0.0 if poses is None else STILL * np.abs(poses[:, :3, 3]).max()
    for k, (pair, (a, b, limit)) in enumerate(zip(pairs, rays, strict=True)):
        move = pair.own if to_world is None else (to_camera[pair.second] @ to_world[pair.first])[:3]
        if np.linalg.norm(move[:, 3]) > least:  # without a baseline every match would lie in the plane
            counts[k] = rays_meet(a, b, move, limit).sum()
    return counts
