"""Write poses as a nerfstudio capture: photographs, transforms.json, point cloud, COLMAP model."""

import json
import shutil
from pathlib import Path

import numpy as np

from bitymi_ns.files import complete_folder, copy_files
from bitymi_ns.ply import write_cloud
from bitymi_ns.progress import Progress
from bitymi_ns.trust import inside
from . import pycolmap
from .sfm_report import FILES
from .transforms import INTRINSICS
from .types import FoundPoses

CLOUD = "sparse_pc.ply"


def write_capture(poses: FoundPoses, folder: Path, progress: Progress) -> None:
    """Write the capture, with the report, into a new or empty folder. Cameras keep the photographs' distortion. Raises
    OSError: it cannot be written; ValueError: the folder holds something, or a name in the model leads out of it."""

    def check() -> None:
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise ValueError(f"{folder} exists already: name another folder, or remove it")

    model = pycolmap.Reconstruction(poses.model)
    names = sorted(image.name for image in model.images.values() if image.has_pose)
    with complete_folder(folder, check) as new:
        for i, name in enumerate(names, 1):
            target = inside(new / "images", name)
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(poses.images / name, target)
            progress("copying photographs", i, len(names))
        copy_files(poses.model, new / "sparse" / "0")
        points = model.points3D.values()
        xyz, rgb = (np.reshape([getattr(point, name) for point in points], (-1, 3)) for name in ("xyz", "color"))
        write_cloud(new / CLOUD, xyz, rgb)  # COLMAP's own writer does not notice a full disk
        (new / "transforms.json").write_text(json.dumps(transforms(model), indent=2, ensure_ascii=False) + "\n", "utf8")
        for name in FILES:
            shutil.copyfile(poses.report / name, new / name)


def transforms(model: pycolmap.Reconstruction) -> dict[str, object]:
    """Build transforms.json, camera to world with OpenGL axes."""
    frames = []
    for image in sorted((i for i in model.images.values() if i.has_pose), key=lambda i: i.name):
        pose = np.vstack([image.cam_from_world().inverse().matrix(), [0, 0, 0, 1]])
        pose[:3, 1:3] *= -1
        frames.append({"file_path": f"images/{image.name}", "transform_matrix": pose.tolist()})
        if model.num_cameras() > 1:
            frames[-1] |= intrinsics(image.camera)
    shared = intrinsics(next(iter(model.cameras.values()))) if model.num_cameras() == 1 else {"camera_model": "OPENCV"}
    return {**shared, "ply_file_path": CLOUD, "frames": frames}


def intrinsics(camera: pycolmap.Camera) -> dict[str, object]:
    """Convert a COLMAP camera (OPENCV, or a simpler pinhole or radial model) to nerfstudio's entries."""
    distortion = dict.fromkeys(("k1", "k2", "p1", "p2"), 0.0)
    first = sum(len(part) for part in (camera.focal_length_idxs(), camera.principal_point_idxs()))
    distortion |= dict(zip(distortion, camera.params[first:].tolist(), strict=False))
    focal = (camera.focal_length_x, camera.focal_length_y)
    sizes = (camera.width, camera.height, *focal, camera.principal_point_x, camera.principal_point_y)
    return {"camera_model": "OPENCV", **dict(zip(INTRINSICS, sizes, strict=True)), **distortion}
