"""Extract SIFT features of all photographs into COLMAP's database, choose pairs, and match them."""

from itertools import combinations
from pathlib import Path

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import minimum_spanning_tree

from bitymi_ns.files import write_file
from .. import pycolmap
from ..types import SPHERICAL_MODEL
from .job import PAIRS, CameraGroup, Job, StageProgress

SMALL = 1000  # pixels; photographs with a shorter longer side are doubled
SPHERICAL_SCALE = 2
"""Factor on `SMALL` and the largest image size for 360-degree pictures: with half the features, their
camera positions were wrong by a metre."""
FEW = 30  # most photographs that are all compared with all
WORTH_ALL = 150  # most that are, if too few get a pose otherwise
NEIGHBOURS = 20  # photographs that each is compared with, by likeness or by GPS
COARSE_FEATURES = (256, 128)
"""Features per photograph, of the largest, that decide on likeness, for up to MANY photographs and for more."""
MANY = 400
COARSE_COSINE = 0.85  # least cosine between descriptors of like features
SEQUENCE_NEIGHBOURS = 6
SEQUENCE_SHARE = 0.8  # least share of consecutive photographs that are among the most alike


def extract(job: Job, database: Path, tell: StageProgress) -> None:
    """Extract features of the photographs that have none in the database."""
    total = len(job.order)
    tell("finding features", 0, total, counts="keypoints")
    ids = zip(job.cameras, camera_ids(job, database), strict=True)
    single, groups = {"camera_mode": pycolmap.CameraMode.SINGLE}, []
    for group, camera_id in ids:
        camera = {"camera_model": group.camera.model, "existing_camera_id": camera_id}
        groups.append((group, pycolmap.ImageReaderOptions(**camera, mask_path=job.masks or "")))
    for group, reader in groups:  # extraction's threads would number them in any order
        pycolmap.import_images(database, job.images, image_names=group.names, options=reader, **single)
    for group, reader in groups:
        options = {"reader_options": reader, "extraction_options": _extraction(job, group), **single}
        how = {"image_names": group.names, "device": pycolmap.Device.cpu}
        pycolmap.extract_features(database, job.images, **how, **options)
    tell("finding features", total, total)


def camera_ids(job: Job, database: Path) -> list[int]:
    """Write the groups' cameras that the database lacks, and return the ids of all."""
    with pycolmap.Database.open(database) as opened:
        for group in job.cameras[opened.num_cameras() :]:
            camera = group.camera.colmap
            camera.has_prior_focal_length = group.prior
            opened.write_camera(camera)
        return [camera.camera_id for camera in opened.read_all_cameras()]


def _extraction(job: Job, group: CameraGroup) -> pycolmap.FeatureExtractionOptions:
    scale = SPHERICAL_SCALE if group.camera.model == SPHERICAL_MODEL else 1
    options = pycolmap.FeatureExtractionOptions(max_image_size=job.max_image_size * scale)
    options.sift.max_num_features = job.max_features
    side = min(max(group.camera.size), options.max_image_size)
    options.sift.first_octave = -1 if side < SMALL * scale else 0
    return options


def match(job: Job, database: Path, tell: StageProgress, every: bool = False) -> None:
    """Choose pairs, or take `every` one, and match those not matched yet."""
    listed = Path(job.work) / PAIRS
    if every or not listed.exists():
        pairs = list(combinations(range(len(job.order)), 2)) if every else choose(job, database, tell)
        write_file(listed, "".join(f"{job.order[i]} {job.order[j]}\n" for i, j in pairs).encode())
    options = pycolmap.ImportedPairingOptions(match_list_path=listed)
    total = len(listed.read_text("utf8").splitlines())
    tell("comparing photographs", 0, total, counts="two_view_geometries")
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = 0
    settings = {"pairing_options": options, "verification_options": verification}
    pycolmap.match_image_pairs(database, **settings, device=pycolmap.Device.cpu)
    tell("comparing photographs", total, total)


def choose(job: Job, database: Path, tell: StageProgress) -> list[tuple[int, int]]:
    """Choose pairs of indices into `job.order`, the smaller one first."""
    count = len(job.order)
    if job.matching == "exhaustive" or (job.matching == "auto" and count <= FEW):
        return list(combinations(range(count), 2))
    alike = likeness(job, database, tell)
    pairs = nearest_neighbours(alike, NEIGHBOURS)
    if job.sequence or job.matching == "sequential" or is_sequence(alike):
        pairs |= sequence(count)
    placed = [i for i, name in enumerate(job.order) if name in job.positions]
    if len(placed) > NEIGHBOURS:
        places = np.array([job.positions[job.order[i]] for i in placed])
        close = -np.linalg.norm(places[:, None] - places[None], axis=-1)
        pairs |= {(placed[i], placed[j]) for i, j in nearest_neighbours(close - close.min() + 1.0, NEIGHBOURS)}
    return sorted(pairs)


def likeness(job: Job, database: Path, tell: StageProgress) -> np.ndarray:
    """Count the largest features [n,n] that pairs of photographs share; 0 on the diagonal."""
    count = len(job.order)
    size = COARSE_FEATURES[count > MANY]
    descriptors = np.zeros((count, size, 128), np.float32)
    with pycolmap.Database.open(database) as opened:
        ids = {image.name: image.image_id for image in opened.read_all_images()}
        for i, name in enumerate(job.order):
            points = opened.read_keypoints(ids[name])
            if len(points) == 0:
                continue
            scale = np.linalg.norm(points[:, 2:4], axis=1)
            largest = np.argsort(-scale, kind="stable")[:size]
            values = opened.read_descriptors(ids[name]).data[largest].astype(np.float32)
            descriptors[i, : len(largest)] = values / np.maximum(np.linalg.norm(values, axis=1, keepdims=True), 1e-6)
    alike, rows = np.zeros((count, count), np.float32), np.arange(size)
    for i in range(count):
        tell("looking for overlap", i, count)
        for j in range(i + 1, count):
            cosine = descriptors[i] @ descriptors[j].T
            nearest = cosine.argmax(1)
            mutual = cosine.argmax(0)[nearest] == rows
            alike[i, j] = (mutual & (cosine[rows, nearest] > COARSE_COSINE)).sum()
    tell("looking for overlap", count, count)
    return alike + alike.T


def nearest_neighbours(alike: np.ndarray, neighbours: int) -> set[tuple[int, int]]:
    """Pair each photograph with those most alike [n,n] (0 = nothing shared), and along a tree that connects all."""
    pairs = set()
    for i, row in enumerate(alike):
        best = np.argsort(-row, kind="stable")[:neighbours]
        pairs |= {(min(i, j), max(i, j)) for j in best.tolist() if j != i and row[j] > 0}
    most = float(alike.max()) + 1.0
    tree = minimum_spanning_tree(csr_matrix(np.triu(most - alike, 1)))
    return pairs | {(min(i, j), max(i, j)) for i, j in np.argwhere(tree.toarray() > 0).tolist()}


def sequence(count: int) -> set[tuple[int, int]]:
    """Pair each photograph with those that follow it, and with some farther ones."""
    steps = sorted({*range(1, SEQUENCE_NEIGHBOURS + 1), 8, 16})
    return {(i, i + step) for i in range(count) for step in steps if i + step < count}


def is_sequence(alike: np.ndarray) -> bool:
    """Test if consecutive photographs are among the most alike."""
    count = len(alike)
    rank = [(alike[i] > alike[i, i + 1]).sum() for i in range(count - 1) if alike[i, i + 1] > 0]
    return sum(r < NEIGHBOURS / 2 for r in rank) >= SEQUENCE_SHARE * (count - 1)
