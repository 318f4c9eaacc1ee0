"""Decide how poses and intrinsics are to be read: match photographs, and count what each reading explains."""

import os
import shlex
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import combinations, product
from operator import ne
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from bitymi_ns.ranges import spread
from bitymi_ns.trust import listed, told_apart
from . import pycolmap
from .image_files import image_size, in_proportion, in_threads, read_image
from .masks import checked_mask
from .order import natural
from .sfm.model_checks import rays_meet
from .types import OPENCV_AXES, SPHERICAL_MODEL, CaptureError, ColmapCamera, Photograph, fail, warn

Array = npt.NDArray[np.float64]
Features = tuple[Array, npt.NDArray[np.float32]]
"""Positions [n, 2] in pixels of the camera, and descriptors [n, 128] of length 1."""
AUTO, WRITTEN = "auto", "written"
MIRROR = np.diag([1.0, 1.0, -1.0, 1.0])
CAMERA_AXES = {"opengl": np.eye(4), "opencv": OPENCV_AXES, "left-handed": MIRROR}
TURNS = {"": 0, "turn90": 90, "turn180": 180, "turn270": 270}  # degrees about the optical axis
SWAPPED, NO_DISTORTION = "sides-swapped", "no-distortion"
INTRINSICS = {f"intrinsics{factor:g}": factor for factor in (0.125, 0.25, 0.5, 2.0, 4.0, 8.0)}
"""Factors on focal lengths and principal points, as of pictures of another size."""
ENOUGH = 100  # matches that decide
FITS = 0.5  # least share of matches that poses explain, relative to the pairs' own poses
LEAD = 2.0
"""Least ratio of what a reading explains to what poses do as written: up to 0.26 if these are right, else from 3.9."""
CLIPS, CLIP = 6, 6  # runs of photographs consecutive by name, and photographs of each
SIDE = 500  # longer side of reduced photographs, pixels; twice that of 360-degree pictures
FEATURES, COARSE = 1500, 128  # per photograph; largest ones that decide on likeness
RATIO = 0.8  # largest ratio of a feature's nearest and second distance
PAIRS, TRIALS = 20, 80  # wanted, and most that are matched
ALIKE = 8  # least coarse matches of a pair that is not near by name
LEAST, OWN = 15, 0.4  # least number and share of a pair's matches that its own essential matrix explains
SAMPLES = 1000  # most random samples in the search for it
MOTION = 0.05  # least median motion of a pair, in longer sides
TOLERANCE = 0.004  # largest distance to the epipolar plane, and least motion of a match, in longer sides
STILL = 1e-4  # baseline of cameras at one place, relative to the largest coordinate


class Reading(NamedTuple):
    """Convention of poses."""

    axes: str = "opengl"
    direction: str = "c2w"
    order: str = ""  # of quaternions; empty = matrices
    turn: str = ""
    intrinsics: str = ""

    @property
    def name(self) -> str:
        """Name for --poses-as."""
        return "-".join(filter(None, self))


def readings(own: Reading) -> list[Reading]:
    """List the readings of a format with its `own` convention, those that differ least first."""
    orders = ("xyzw", "wxyz") if own.order else ("",)
    every = product(CAMERA_AXES, ("c2w", "w2c"), orders, TURNS, ("", *INTRINSICS, SWAPPED, NO_DISTORTION))
    return [Reading(*each) for each in sorted(every, key=lambda each: sum(map(ne, each, own)))]


def read_as(poses: Array, own: Reading, reading: Reading) -> tuple[Array, Array]:
    """Convert poses [N, 4, 4], camera to world with OpenGL axes by a format's `own` convention, to those of a reading;
    also return the reflection [4, 4] of their world if that was left-handed, else the identity."""
    if reading[:4] == own[:4]:
        return poses, np.eye(4)
    matrices = poses @ CAMERA_AXES[own.axes]
    matrices = np.linalg.inv(matrices) if own.direction == "w2c" else matrices
    if reading.order != own.order:
        x, y, z, w = Rotation.from_matrix(matrices[:, :3, :3]).as_quat().T
        meant = (w, x, y, z) if own.order == "wxyz" else (y, z, w, x)
        matrices[:, :3, :3] = Rotation.from_quat(np.stack(meant, 1)).as_matrix()
    matrices = np.linalg.inv(matrices) if reading.direction == "w2c" else matrices
    matrices = matrices @ CAMERA_AXES[reading.axes]
    mirrored = reading.axes == "left-handed" and np.median(np.linalg.det(matrices)) < 0.0
    world, turn = MIRROR if mirrored else np.eye(4), np.eye(4)
    turn[:3, :3] = Rotation.from_euler("z", TURNS[reading.turn], degrees=True).as_matrix().round()
    return world @ matrices @ turn, world


def camera_as(camera: ColmapCamera, kind: str) -> ColmapCamera:
    """Convert a camera to other intrinsics; that of 360-degree pictures has none."""
    if not kind or camera.model == SPHERICAL_MODEL:
        return camera
    lens, params = camera.colmap, np.array(camera.params)
    if kind == NO_DISTORTION:
        K = lens.calibration_matrix()
        return camera._replace(model="PINHOLE", params=(*K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist(),))
    for indices in map(list, (lens.focal_length_idxs(), lens.principal_point_idxs())):
        params[indices] = params[indices][::-1] if kind == SWAPPED else params[indices] * INTRINSICS[kind]
    return camera._replace(params=tuple(params.tolist()))


class Pair(NamedTuple):
    """Matches of two photographs, by their indices, in pixels [n, 2] of their cameras."""

    first: int
    second: int
    x: Array
    y: Array
    own: Array  # [3, 4] first camera to second, by the matches


def match_pairs(photographs: Sequence[Photograph]) -> list[Pair]:
    """Match pairs of photographs that are near by name or look alike, and move."""
    order = sorted(range(len(photographs)), key=lambda i: natural(str(photographs[i].file)))
    if len(order) > CLIPS * CLIP:
        order = list(dict.fromkeys(order[i + k] for i in spread(len(order) - CLIP + 1, CLIPS) for k in range(CLIP)))
    features = in_threads(lambda i: _features(photographs[i]), order)
    near, wide = [], []
    for i, j in combinations(range(len(order)), 2):
        if j <= i + 2:
            near.append((i, j))
        elif len(_mutual(features[i][1][:COARSE], features[j][1][:COARSE])) >= ALIKE:
            wide.append((i, j))
    rng, pairs, tried = np.random.default_rng(0), [], []
    for step, candidates in ((1, near), (2, wide)):
        tried += [(k * step, *candidates[i]) for k, i in enumerate(rng.permutation(len(candidates)))]
    for _, i, j in sorted(tried)[:TRIALS]:
        if len(pairs) < PAIRS:
            pairs += _match([each.camera for each in photographs], order[i], order[j], features[i], features[j])
    return pairs


def _features(photograph: Photograph) -> Features:
    """Find SIFT features, the largest first, with square roots of the histograms as descriptors (Arandjelovic and
    Zisserman, 2012); none if the photograph cannot be read, or not with its camera, which is reported later."""
    camera, points, mask = photograph.camera, (), np.empty(0, np.uint8)
    size = camera.within(SIDE * (2 if camera.model == SPHERICAL_MODEL else 1))
    with suppress(CaptureError):
        image = np.asarray(read_image(photograph.file, wanted=size).convert("L"))
        if photograph.mask is not None:
            mask = np.asarray(checked_mask(photograph.mask).resize(size), np.uint8)
        if in_proportion(image_size(photograph.file) or (0, 1), camera.size):
            points, values = cv2.SIFT.create(FEATURES, contrastThreshold=0.02).detectAndCompute(image, mask)
    if not points:
        return np.zeros((0, 2)), np.zeros((0, 128), np.float32)
    largest = np.argsort([-point.size for point in points], kind="stable")
    values = np.sqrt(values[largest] / np.maximum(values[largest].sum(1, keepdims=True), 1e-6))
    return (np.array([point.pt for point in points])[largest] + 0.5) * np.divide(camera.size, size), values


def _mutual(a: npt.NDArray[np.float32], b: npt.NDArray[np.float32]) -> npt.NDArray[np.int64]:
    """Match features [n, 128] and [m, 128], each the other's nearest by far; return indices [k, 2]."""
    if min(len(a), len(b)) < 2:
        return np.zeros((0, 2), np.int64)
    cosine = a @ b.T
    rows, nearest = np.arange(len(a)), cosine.argmax(1)
    mutual = cosine.argmax(0)[nearest] == rows
    best = cosine[rows, nearest]
    cosine[rows[mutual], nearest[mutual]] = -1.0
    second = np.maximum(cosine.max(1), cosine.max(0)[nearest])
    kept = mutual & (1.0 - best < RATIO**2 * (1.0 - second))
    return np.stack([rows[kept], nearest[kept]], 1)


def _match(cameras: Sequence[ColmapCamera], i: int, j: int, a: Features, b: Features) -> list[Pair]:
    """Match two photographs; none = too few matches, or too little motion."""
    matched = _mutual(a[1], b[1])
    x, y = a[0][matched[:, 0]], b[0][matched[:, 1]]
    motion = np.linalg.norm(x / max(cameras[i].size) - y / max(cameras[j].size), axis=1)
    moves = motion > TOLERANCE
    x, y = x[moves], y[moves]
    if len(x) < LEAST or np.median(motion[moves]) < MOTION:
        return []
    options = pycolmap.RANSACOptions(max_num_trials=SAMPLES, random_seed=0)
    options.max_error = TOLERANCE * max(cameras[i].size)
    essential = pycolmap.estimate_essential_matrix(x, y, cameras[i].colmap, cameras[j].colmap, options)
    pair = [] if essential is None else [Pair(i, j, x, y, essential["cam2_from_cam1"].matrix())]
    return pair if explained(pair, rays_of(pair, cameras)).sum() >= max(LEAST, OWN * len(x)) else []


def rays_of(pairs: Sequence[Pair], cameras: Sequence[ColmapCamera]) -> list[tuple[Array, Array, Array]]:
    """Compute unit rays [n, 3] of pairs' matches in both cameras' axes, and tolerances [n] at the second, radians."""
    lenses = {camera: camera.colmap for camera in dict.fromkeys(cameras)}
    rays = []
    for pair in pairs:
        first, second = lenses[cameras[pair.first]], lenses[cameras[pair.second]]
        b = second.cam_ray_from_img(pair.y)
        step = TOLERANCE * max(second.width, second.height) * np.eye(2)
        limits = [np.linalg.norm(second.cam_ray_from_img(pair.y + each) - b, axis=1) for each in step]
        rays.append((first.cam_ray_from_img(pair.x), b, np.fmin(*limits)))
    return rays


def explained(
    pairs: Sequence[Pair], rays: Sequence[tuple[Array, Array, Array]], poses: Array | None = None
) -> npt.NDArray[np.int64]:
    """Count the matches of each pair [P] whose rays, see `rays_of`, meet in front of both cameras. `poses`: [N, 4, 4]
    camera to world with OpenGL axes; None = the pairs' own."""
    counts = np.zeros(len(pairs), np.int64)
    to_world = np.eye(4)[None] if poses is None else poses @ OPENCV_AXES
    to_camera, least = np.linalg.inv(to_world), STILL * np.abs(to_world[:, :3, 3]).max()
    for k, (pair, (a, b, limit)) in enumerate(zip(pairs, rays, strict=True)):
        move = pair.own if poses is None else (to_camera[pair.second] @ to_world[pair.first])[:3]
        if np.linalg.norm(move[:, 3]) > least:  # without a baseline every match would lie in the plane
            counts[k] = rays_meet(a, b, move, limit).sum()
    return counts


class Decision(NamedTuple):
    """Reading that the photographs ask for (None = none explains them), and shares of matches that are explained."""

    reading: Reading | None
    share: float = 0.0  # by the reading that explains most
    written: float = 0.0
    own: float = 0.0  # by the pairs' own poses
    worst: tuple[str, ...] = ()  # photographs whose matches are explained least


def decide(photographs: Sequence[Photograph], poses: Array, written: Reading) -> Decision:
    """Find the reading by which poses explain by far most matches of pairs; as written if too few, or cameras are
    unusable."""
    cameras, every = [each.camera for each in photographs], readings(written)
    lenses = [camera.colmap for camera in dict.fromkeys(cameras)]
    focals = [value for lens in lenses for value in lens.params[lens.focal_length_idxs()]]
    usable = all(np.isfinite(lens.params).all() for lens in lenses) and min(focals, default=1.0) > 0.0
    pairs = match_pairs(photographs) if usable else []
    own = explained(pairs, rays_of(pairs, cameras))
    total = sum(len(pair.x) for pair in pairs)
    if own.sum() < ENOUGH:
        return Decision(written)
    counts: dict[Reading, npt.NDArray[np.int64]] = {}
    for kinds in ([""], [*INTRINSICS, SWAPPED, NO_DISTORTION]):
        for kind in kinds:
            rays = rays_of(pairs, [camera_as(camera, kind) for camera in cameras])
            counts |= {reading: explained(pairs, rays, read_as(poses, written, reading)[0])
                       for reading in every if reading.intrinsics == kind}  # fmt: skip
        best = max(counts, key=lambda each: counts[each].sum())
        share, as_written, most = (float(each.sum() / total) for each in (counts[best], counts[written], own))
        if share >= max(FITS * most, LEAD * as_written):
            return Decision(best, share, as_written, most)
        if as_written >= FITS * most:
            return Decision(written, share, as_written, most)
    sums = np.zeros((2, len(photographs)))
    for pair, *both in zip(pairs, counts[written], own, strict=True):
        sums[:, [pair.first, pair.second]] += np.array(both)[:, None]
    names = told_apart([each.file for each in photographs])
    worst = [names[i] for i in np.argsort(sums[0] / np.maximum(sums[1], 1e-9)) if sums[1, i]]
    return Decision(None, share, as_written, most, tuple(worst[:3]))


def as_meant(
    photographs: Sequence[Photograph], written: Reading, frame: Array, source: str, asked: str
) -> tuple[list[Photograph], Array, str]:
    """Give photographs the poses and intrinsics of the reading `asked` for (AUTO = the photographs decide), and say so;
    return them, the reflection [4, 4] of their world, and the reading's name. `frame`: [4, 4] from the world of the
    files to that of the photographs. Raises CaptureError: the format has no such reading."""
    named = {WRITTEN: written} | {each.name: each for each in readings(written)}
    poses = np.linalg.inv(frame) @ np.stack([each.pose for each in photographs])
    decision = Decision(named.get(asked))
    if asked == AUTO:
        decision = decide(photographs, poses, written)
    elif decision.reading is None:
        usual = [known.name for known in named.values() if not known.turn and not known.intrinsics]
        fail(f"--poses-as is {asked}, but {source} can be read as {AUTO}, {WRITTEN}, or as {', '.join(usual[1:])}.")
    reading, explains = decision.reading, "of what pairs of photographs have in common"
    if reading is None:
        folder = shlex.quote(os.path.commonpath([os.path.abspath(each.file.parent) for each in photographs]))
        least = f"where {decision.own:.0%} can be; least in {listed(decision.worst)}"
        bad = f"the poses fit the photographs badly: they explain {decision.written:.0%} {explains}, {least}"
        warn(f"{source}: {bad}. `bitymi sfm {folder}` finds others.")
    if reading is None or reading == written:
        return list(photographs), np.eye(4), WRITTEN
    if asked == AUTO:
        read_as_meant = f"the poses are read as {reading.name}, which explains {decision.share:.0%} {explains}"
        as_written = f"as written ({written.name}), {decision.written:.0%}"
        warn(f"{source}: {read_as_meant}; {as_written}. `bitymi-data --poses-as {WRITTEN}` keeps those.")
    meant, world = read_as(poses, written, reading)
    photographs = [replace(each, pose=frame @ pose, camera=camera_as(each.camera, reading.intrinsics))
                   for each, pose in zip(photographs, meant, strict=True)]  # fmt: skip
    return photographs, frame @ world @ np.linalg.inv(frame), reading.name
