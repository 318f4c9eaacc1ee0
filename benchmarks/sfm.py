"""Camera poses of a capture by `find_poses` and by COLMAP's command-line defaults, in one run: time, photographs
placed, reprojection error, and the distance of the poses from given ones.

    python benchmarks/sfm.py CAPTURE...        folders with images/ and transforms.json
    python benchmarks/sfm.py --only ours CAPTURE

COLMAP's defaults are those of feature_extractor, exhaustive_matcher and mapper. Both run on the CPU, one after the
other, each in a process of its own; CPU seconds are the operating system's and include those of its children.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pycolmap

from bitymi_ns.capture import find_poses
from bitymi_ns.measure.markdown import table


def ours(images: Path, work: Path) -> dict[str, object]:
    """Our poses; the photographs are links, so that the results land in the work folder."""
    photos = work / "images"
    photos.mkdir()
    for path in images.iterdir():
        (photos / path.name).symlink_to(path.resolve())
    poses = find_poses(work, progress=lambda step, done, total: print(step, done, total) if done == total else None)
    return {"model": str(poses.model), "seconds": poses.seconds}


def defaults(images: Path, work: Path) -> dict[str, object]:
    """COLMAP's."""
    seconds = {}

    def timed(name: str, function: object, *arguments: object) -> object:
        begun = time.monotonic()
        result = function(*arguments)  # type: ignore[operator]
        seconds[name] = time.monotonic() - begun
        print(name, f"{seconds[name]:.1f} s", flush=True)
        return result

    database = work / "database.db"
    timed("finding features", lambda: pycolmap.extract_features(database, images, device=pycolmap.Device.cpu))
    timed("comparing photographs", lambda: pycolmap.match_exhaustive(database, device=pycolmap.Device.cpu))
    models = timed("placing one camera after the other", pycolmap.incremental_mapping, database, images, work)
    best = max(models, key=lambda i: models[i].num_reg_images())  # type: ignore[attr-defined,call-overload]
    return {"model": str(work / str(best)), "seconds": seconds}


def pose_errors(model: pycolmap.Reconstruction, given: Path) -> tuple[float, float]:
    """Median rotation error in degrees, and median distance of the centers in per cent of the cameras' extent (the
    largest distance from their middle), after a similarity that brings the poses to those of a transforms.json."""
    known = {}
    for frame in json.loads(given.read_text("utf8"))["frames"]:
        pose = np.array(frame["transform_matrix"], float)
        pose[:3, 1:3] *= -1
        known[Path(frame["file_path"]).name] = pose
    images = [i for i in model.images.values() if i.has_pose and Path(i.name).name in known]
    ours = np.array([image.cam_from_world().inverse().matrix() for image in images])
    theirs = np.array([known[Path(image.name).name] for image in images])
    found = pycolmap.estimate_sim3d(ours[:, :, 3], theirs[:, :3, 3])
    distance = np.linalg.norm(found * ours[:, :, 3] - theirs[:, :3, 3], axis=1)
    extent = np.linalg.norm(theirs[:, :3, 3] - theirs[:, :3, 3].mean(axis=0), axis=1).max()
    relative = np.swapaxes(theirs[:, :3, :3], 1, 2) @ found.rotation.matrix() @ ours[:, :, :3]
    # Rounded poses make small angles from the trace alone unsafe; the skew part is exact there.
    skew = np.stack(
        [
            relative[:, 2, 1] - relative[:, 1, 2],
            relative[:, 0, 2] - relative[:, 2, 0],
            relative[:, 1, 0] - relative[:, 0, 1],
        ],
        1,
    )
    angle = np.degrees(np.arctan2(np.linalg.norm(skew, axis=1), np.trace(relative, axis1=1, axis2=2) - 1))
    return float(np.median(angle)), float(np.median(distance) / extent * 100)


def measured(side: str, capture: Path) -> dict[str, object]:
    """One side on one capture, in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        begun, before = time.monotonic(), os.times()
        command = [sys.executable, __file__, "--side", side, "--work", folder, str(capture)]
        subprocess.run(command, check=True)
        after, wall = os.times(), time.monotonic() - begun
        result = json.loads((Path(folder) / "result.json").read_text("utf8"))
        model = pycolmap.Reconstruction(result["model"])
        rotation, center = pose_errors(model, capture / "transforms.json")
    cpu = after.children_user + after.children_system - before.children_user - before.children_system
    names = {"finding features": "features", "comparing photographs": "matching"}
    stages = {names.get(k, k): v for k, v in result["seconds"].items() if k != "all"}
    return {
        "capture": capture.name,
        "by": {"ours": "find_poses", "defaults": "COLMAP's defaults"}[side],
        "placed": f"{model.num_reg_images()} of {len(list((capture / 'images').iterdir()))}",
        "CPU s": f"{cpu:.0f}",
        "wall s": f"{wall:.0f}",
        "reprojection (px)": f"{model.compute_mean_reprojection_error():.3f}",
        "track length": f"{model.compute_mean_track_length():.2f}",
        "points": model.num_points3D(),
        "rotation error (deg)": f"{rotation:.3f}",
        "center error (%)": f"{center:.3f}",
        "stages (wall s)": ", ".join(f"{k} {v:.0f}" for k, v in stages.items() if v >= 0.5),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", nargs="+", type=Path)
    parser.add_argument("--only", choices=("ours", "defaults"))
    parser.add_argument("--side", choices=("ours", "defaults"), help=argparse.SUPPRESS)
    parser.add_argument("--work", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.side:
        pycolmap.logging.minloglevel = 2
        result = {"ours": ours, "defaults": defaults}[arguments.side](arguments.captures[0] / "images", arguments.work)
        (arguments.work / "result.json").write_text(json.dumps(result), "utf8")
        return
    sides = [arguments.only] if arguments.only else ["defaults", "ours"]
    rows = [measured(side, capture) for capture in arguments.captures for side in sides]
    print(table(list(rows[0]), [list(map(str, row.values())) for row in rows]))


if __name__ == "__main__":
    main()
