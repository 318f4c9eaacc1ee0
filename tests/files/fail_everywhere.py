"""Make each disk access fail in turn in every writer of results.

Run with an empty folder and names of writers (none: all), with faults.c preloaded and named in BITYMI_FAULTS_LIBRARY.
BITYMI_FAULTS=all tries every access; by default slow writers get a few, from the first to the last. After each fault
the earlier result is unchanged or the new one complete, nothing else is left, and the message is one line.
"""

import ctypes
import errno
import io
import json
import os
import shutil
import sys
import time
import traceback
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import torch
from nerfstudio.scripts import render
from nerfstudio.scripts import train as ns_train
from nerfstudio.scripts.eval import ComputePSNR

from bitymi_ns import cli, exit_messages
from bitymi_ns.capture.colmap_model import write_model
from bitymi_ns.capture.nerfstudio import write_capture
from bitymi_ns.capture.sfm_report import FILES
from bitymi_ns.capture.types import FoundPoses
from bitymi_ns.files import complete_folder, write_errors_as
from bitymi_ns.plugin.console import InputError
from bitymi_ns.plugin.export.command import ExportAtlas
from bitymi_ns.plugin.export.mesh import ExportMesh
from bitymi_ns.plugin.run import checkpoints, folder_lock
from bitymi_ns.plugin.run.callbacks import TrainingCurve
from bitymi_ns.sample import capture as sample_capture
from bitymi_ns.sample import generate
from tests.bundle.test_notes import text as notes
from tests.e2e.conftest import small_run

OPEN, WRITE, RENAME, MKDIR, FSYNC, FOLDER, READ = (1 << k for k in range(7))
FULL = WRITE | MKDIR | FSYNC
CASES = [
    (errno.ENOSPC, OPEN | WRITE | RENAME | MKDIR | FSYNC, FULL),  # a full disk stays full
    (errno.EIO, OPEN | WRITE | RENAME | MKDIR | FSYNC | READ, 0),
    (errno.EMFILE, OPEN | FOLDER | READ, 0),
]
SOME = 2  # accesses tried per case by default
SLOW = ("sample", "bundle", "mesh", "maps", "eval")  # one access only
QUICK = ("pack", "report", "capture", "model", "checkpoint", "curve")  # every access
GOLDEN = 0.618  # spacing of the tried accesses, as a share of all

Contents = dict[str, bytes | None]
Write = Callable[[int], Any]  # writes version 0 or 1; returns the exit status if it is a command


class Faults:
    def __init__(self) -> None:
        self._library = ctypes.CDLL(os.environ["BITYMI_FAULTS_LIBRARY"])
        self._library.faults_arm.argtypes = [ctypes.c_char_p, ctypes.c_int, ctypes.c_long, ctypes.c_int, ctypes.c_int]
        self._library.faults_count.restype = ctypes.c_long
        self._library.faults_path.restype = ctypes.c_char_p

    def arm(self, folder: Path, kinds: int, step: int, error: int, later: int) -> None:
        self._library.faults_arm(f"{folder}/".encode(), kinds, step, error, later)

    def disarm(self) -> tuple[int, int, str]:
        """Return the number of accesses, and kind and path of the one that failed."""
        found = self._library.faults_count(), self._library.faults_kind(), self._library.faults_path().decode()
        self._library.faults_arm(b"", 0, 0, 0, 0)
        return found


def contents(folder: Path, folders: bool = True) -> Contents:
    """Read everything below a folder; folders are None."""
    there = [path for path in folder.rglob("*") if folders or path.is_file()]
    return {str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None for path in there}


def put(folder: Path, what: Contents) -> None:
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for name, data in sorted(what.items()):
        if data is None:
            (folder / name).mkdir(parents=True)
        else:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(data)


def said(write: Write) -> str | None:
    """Write the second version; returns the message if that ended early, else None."""
    told = io.StringIO()
    with redirect_stderr(told), redirect_stdout(io.StringIO()):
        try:
            if not write(1):
                return None
            line = told.getvalue()
        except SystemExit as error:
            line = str(error)
        except OSError as error:
            line = exit_messages.line_of(error) or ""
            if not line:
                raise
    assert line.strip() and "Traceback" not in line and "[Errno" not in line, line
    assert "cannot be written" in line or "could not be written" in line or "cannot be read" in line, line
    return line.strip()


SEPARATE = ("maps",)  # writers of independent files, each written atomically
REPLACE_NOTHING = ("capture",)
FOLDERS_STAY = ("maps", "begin")  # may leave empty folders


def check(name: str, write: Write, place: Path, faults: Faults, every: bool) -> str:
    start, there = time.perf_counter(), partial(contents, place, name not in FOLDERS_STAY)
    versions: list[Contents] = []
    for version in (1, 1, 0):
        put(place, {})
        with redirect_stderr(io.StringIO()) as told, redirect_stdout(io.StringIO()):
            assert not write(version), told.getvalue()
        versions.append(there())
    newer, again, older = versions
    steady = {key for key in newer if newer[key] == again[key]}  # others contain times
    steady -= {"a/bundle.json"}  # complete before the comparison is added to it
    assert newer.keys() == again.keys() and newer != older, newer.keys() ^ again.keys()
    tried, lines = 0, set()
    for before in ({},) if name in REPLACE_NOTHING else ({}, older):
        for error, kinds, later in CASES:
            put(place, before)
            faults.arm(place, kinds, 0, 0, 0)
            assert said(write) is None
            steps = range(1, faults.disarm()[0] + 1)
            some = [steps[int(len(steps) * (GOLDEN * (tried + k) % 1))] for k in range(1 if name in SLOW else SOME)]
            for step in steps if every or name in QUICK else sorted(set(some)):
                put(place, before)
                faults.arm(place, kinds, step, error, later)
                try:
                    line = said(write)
                finally:
                    _, kind, path = faults.disarm()
                found, tried = there(), tried + 1
                where = f"{name}: {errno.errorcode[error]} at {step} ({kind}, {path}): {line}"
                if kind == FOLDER or path.endswith(".new") and kind == RENAME:  # cleaning up, left to the next writer
                    assert said(write) is None, where
                    found, line = there(), None
                whole = found.keys() == newer.keys() and all(found[key] == newer[key] for key in steady)
                changed = {key for key in found.keys() | before.keys() if found.get(key, 0) != before.get(key, 0)}
                if line is not None and name in SEPARATE:
                    whole = all(key in found and (key not in steady or found[key] == newer[key]) for key in changed)
                assert whole or line is not None and not changed, (where, changed, found.keys() ^ newer.keys())
                lines |= {line} - {None}
    return f"{name}: {tried} faults, {len(lines)} messages, {time.perf_counter() - start:.1f} s"


def writers(work: Path) -> dict[str, Callable[[Path, int], Any]]:
    room = generate(work / "room", views=10, width=48, height=36, seed=0, points=200)
    config = small_run(room, work / "outputs")
    config.max_num_iterations, config.steps_per_save = 10, 10
    config.pipeline.model.curve_points = 1
    ns_train.main(config)
    run = config.get_base_dir() / "config.yml"
    bundles = [work / "bundle-0", work / "bundle-1"]

    def export(folder: Path, version: int, **options: Any) -> None:
        given = dict(format="uint8", polish_steps=0, finetune_steps=0, tolerance=(0.02, 0.05)[version])
        ExportAtlas(load_config=run, output_dir=folder, **{**given, **options}).main()

    for version, bundle in enumerate(bundles):
        export(bundle, version)
        (bundle / "notes.json").write_bytes(notes())
    state = torch.load(next((run.parent / "nerfstudio_models").glob("*.ckpt")), weights_only=True)

    paths = [work / f"path-{version}.json" for version in range(2)]
    for version, path in enumerate(paths):
        pose = np.diag([1.0, -1.0, -1.0, 1.0]).flatten().tolist()
        frames = [{"camera_to_world": pose, "fov": fov, "aspect": 4 / 3} for fov in (40.0, 60.0 + version)]
        size = {"render_width": 48, "render_height": 36, "seconds": 1.0, "fps": 2, "camera_path": frames}
        path.write_text(json.dumps(size))

    def along(place: Path, version: int, name: str, **options: Any) -> None:
        options |= dict(camera_path_filename=paths[version], output_path=place / name)
        render.RenderCameraPath(load_config=bundles[0] / "config.yml", **options).main()

    def dataset(place: Path, version: int) -> None:
        options = dict(load_config=bundles[version] / "config.yml", rendered_output_names=["rgb", "raw-depth"])
        render.DatasetRender(output_path=place / "maps", **options).main()

    def checkpoint(place: Path, version: int) -> None:
        path = place / "models" / "step-000000009.ckpt"
        checkpoints.save({**state, "step": 9 + version}, path, place, config.pipeline.model.scene)

    (work / "curve").write_text("".join(json.dumps({"step": step}) + "\n" for step in range(10)))

    def curve(place: Path, version: int) -> None:
        TrainingCurve(place / "more" / "curve.jsonl", resumed_from=work / "curve", steps_done=5 + version)

    models = [work / f"model-{version}" for version in range(2)]
    for version, folder in enumerate(models):
        made = pycolmap.Reconstruction()
        made.add_camera_with_trivial_rig(pycolmap.Camera.create_from_model_name(1, "PINHOLE", 50.0 + version, 48, 36))
        for k, path in enumerate(sorted((room / "images").iterdir())):
            image = pycolmap.Image(path.name, np.zeros((0, 2)), 1, k + 1)
            made.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
        folder.mkdir()
        made.write_binary(folder)
        for name in FILES:
            (folder / name).write_text(f"report {version}")

    def capture(place: Path, version: int) -> None:
        found = FoundPoses(models[version], room / "images", models[version], {}, 10, 10, 0.1, 3.0, {})
        shutil.rmtree(place / "a", ignore_errors=True)  # a capture never replaces files
        with write_errors_as(place / "a", InputError):
            write_capture(found, place / "a", lambda *told: None)

    found = [pycolmap.Reconstruction(folder) for folder in models]

    def model(place: Path, version: int) -> None:
        with write_errors_as(place / "a", InputError), complete_folder(place / "a") as new:
            write_model(found[version], new)

    def begin(place: Path, version: int) -> None:
        begun = small_run(room, place, name="begun")
        begun.max_num_iterations = 10 + version
        try:
            begun.save_config()
        finally:
            folder_lock.leave(begun.get_base_dir())

    report = work / "psnr.json"
    ComputePSNR(load_config=run, output_path=report).main()

    def bitymi(*words: object) -> int:
        return cli.main([str(word) for word in words])

    small = ("--views", 10, "--width", 32, "--height", 24, "--points", 60)

    def mesh(place: Path, version: int) -> None:
        options = dict(resolution=16, format="obj", overwrite=True)
        ExportMesh(load_config=bundles[version] / "config.yml", output_dir=place / "a", **options).main()

    def evaluate(place: Path, version: int) -> None:
        ComputePSNR(load_config=(run, bundles[0] / "config.yml")[version], output_path=place / "a.json").main()

    return {
        "sample": lambda p, v: bitymi("sample", "--output-dir", p / "a", *small, "--seed", v, "--overwrite"),
        "bundle": lambda p, v: export(p / "a", v, overwrite=True),
        "pack": lambda p, v: bitymi("pack", bundles[v], "--output", p / "a.bitymi", "--overwrite"),
        "extras": lambda p, v: bitymi("extras", bundles[v], "--output", p / "a", "--overwrite"),
        "view": lambda p, v: bitymi("view", bundles[v], "--export", p / "a", "--overwrite"),
        "view-one": lambda p, v: bitymi("view", bundles[v], "--export", p / "a", "--overwrite", "--one-file"),
        "report": lambda p, v: bitymi("report", report, "--output-dir", p / "a", "--title", f"title {v}"),
        "mesh": mesh,
        "film": lambda p, v: along(p, v, "a.mp4"),
        "frames": lambda p, v: along(p, v, "a", output_format="images"),
        "maps": dataset,
        "capture": capture,
        "model": model,
        "checkpoint": checkpoint,
        "curve": curve,
        "begin": begin,
        "eval": evaluate,
    }


def main(work: Path, *names: str) -> None:
    torch.set_num_threads(1)
    sample_capture.Room = lru_cache(sample_capture.Room)  # textures take seconds and write nothing
    faults = Faults()
    with redirect_stdout(io.StringIO()):
        found = writers(work)
    wrong = []
    for name in names or found:
        place = work / "place" / name
        try:
            write = partial(found[name], place)
            print(check(name, write, place, faults, os.environ.get("BITYMI_FAULTS") == "all"), flush=True)
        except Exception as error:
            wrong.append(name)
            print(f"{name}: WRONG: {''.join(traceback.format_exception(error))}", flush=True)
    sys.exit(f"wrong: {', '.join(wrong)}" if wrong else 0)


if __name__ == "__main__":
    main(Path(sys.argv[1]), *sys.argv[2:])
