"""Targets of scripts/fuzz.py: readers of untrusted files, with seed inputs."""

from __future__ import annotations

import copy
import io
import json
import struct
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import atheris
import numpy as np
import torch
from PIL import ExifTags, Image

from bitymi_ns.capture import exif
from bitymi_ns.capture.depth_normal_maps import read_depth, read_normal
from bitymi_ns.capture.lens import lenses_of
from bitymi_ns.capture.points import read_cloud
from bitymi_ns.capture.types import CaptureError, ColmapCamera, MapFiles
from bitymi_ns.measure.report.page import compose, to_page
from bitymi_ns.measure.report.read import collect
from bitymi_ns.measure.report.records import ReportError
from bitymi_ns.plugin.console import InputError
from bitymi_ns.plugin.data.dataparser import BitymiDataParserConfig
from bitymi_ns.plugin.run import checkpoints
from bitymi_ns.plugin.run.camera_path import read_camera_path
from bitymi_ns.plugin.run.checkpoint_reader import read_archive
from bitymi_ns.plugin.run.checkpoint_schema import Entry, restore_optimizer
from bitymi_ns.ply import PlyError
from bitymi_ns.safe_reading import reading
from bitymi_ns.sample import generate
from bitymi_ns.scene.config import SceneConfig
from tests.captures import as_binary, colmap_model
from tests.hostile import ODD_VALUES, nodes, parts, saved
from tests.measure.report.conftest import cell
from tests.plugin.run.test_checkpoints import moved, state

CUT = b"\n--8<--\n"  # separates the files of an input


@dataclass
class Target:
    run: Callable[[bytes], object]  # reads an input
    seeds: list[bytes]
    refusals: tuple[type[BaseException], ...] = ()  # documented exceptions
    json: bool = False  # the last file of an input is JSON or JSONL


def no_colmap(*_: Any, **__: Any) -> Any:
    """Replace structure from motion, which takes seconds."""
    raise CaptureError("not here")


def _capture(work: Path) -> Path:
    return generate(work / "room", views=4, width=48, height=36, seed=0, points=20)


def transforms(work: Path) -> Target:
    """Parse transforms.json, up to the views."""
    room = _capture(work)
    (room / "masks").mkdir()
    for path in sorted((room / "images").iterdir())[:2]:
        Image.new("L", (48, 36), 255).save(room / "masks" / path.name)
    np.save(room / "depth.npy", np.ones((36, 48), np.float32))
    meta = json.loads((room / "transforms.json").read_text())
    own = json.dumps(meta)
    for frame in meta["frames"]:
        frame |= {"depth_file_path": "depth.npy", "mask_path": f"masks/{Path(frame['file_path']).name}"}
        frame |= {key: meta[key] for key in ("fl_x", "fl_y", "cx", "cy", "w", "h")}
    meta |= {"train_filenames": [meta["frames"][0]["file_path"]], "val_filenames": [meta["frames"][1]["file_path"]]}
    meta |= {"applied_transform": np.eye(4)[:3].tolist(), "aabb_scale": 4, "k1": 0.1, "camera_model": "OPENCV"}
    meta |= {"test_filenames": [], "applied_scale": 2.0, "orientation_override": "none", "auto_scale_poses_override": 1}
    ngp = {"camera_angle_x": 0.8, "frames": [{**frame, "file_path": frame["file_path"]} for frame in meta["frames"]]}

    def run(data: bytes) -> None:
        (room / "transforms.json").write_bytes(data)
        BitymiDataParserConfig(data=room).setup().outputs  # noqa: B018

    return Target(run, [own.encode(), json.dumps(meta).encode(), json.dumps(ngp).encode()], (InputError,), True)


def _colmap(work: Path, binary: bool) -> Target:
    room = _capture(work)
    model = room / "sparse" / "0"
    colmap_model(room, model)
    if binary:
        as_binary(model)
    (room / "transforms.json").unlink()
    files = sorted(model.iterdir())

    def run(data: bytes) -> None:
        for path, part in zip(files, data.split(CUT), strict=False):
            path.write_bytes(part)
        BitymiDataParserConfig(data=room).setup().outputs  # noqa: B018

    whole = CUT.join(path.read_bytes() for path in files)
    return Target(run, [whole, whole.replace(b" PINHOLE ", b" SIMPLE_RADIAL_FISHEYE ")], (InputError,))


def exif_data(work: Path) -> Target:
    """Read the EXIF of a photograph."""
    tags = Image.Exif()
    tags.update({ExifTags.Base.Make: "Apple", ExifTags.Base.Orientation: 6})
    tags.get_ifd(ExifTags.IFD.Exif).update(
        {
            ExifTags.Base.FocalLength: 4.2,
            ExifTags.Base.FocalLengthIn35mmFilm: 26,
            ExifTags.Base.FocalPlaneXResolution: 5000.0,
            ExifTags.Base.FocalPlaneResolutionUnit: 2,
            ExifTags.Base.ExifImageWidth: 48,
            ExifTags.Base.ExifImageHeight: 36,
            ExifTags.Base.ExposureTime: 0.01,
            ExifTags.Base.FNumber: 1.8,
            ExifTags.Base.ISOSpeedRatings: (100, 200),
            ExifTags.Base.DateTimeOriginal: "2024:01:01 00:00:00",
            ExifTags.Base.MakerNote: b"Apple iOS\0\0\1MM\0\1\0\10\0\12\0\0\0\3\0\0\0\40" + struct.pack(">6i", *[1] * 6),
        }
    )
    gps = {1: "N", 2: (46.0, 30.0, 1.5), 3: "E", 4: (7.0, 1.0, 2.0), 5: b"\0", 6: 500.0}
    tags.get_ifd(ExifTags.IFD.GPSInfo).update(gps)
    buffer = io.BytesIO()
    Image.new("RGB", (48, 36)).save(buffer, "JPEG")
    plain = buffer.getvalue()

    def run(data: bytes) -> None:
        segment = b"Exif\0\0" + data[:60000]
        photograph = plain[:2] + b"\xff\xe1" + struct.pack(">H", len(segment) + 2) + segment + plain[2:]
        for read in (exif.read_exif, exif.exposure_settings, exif.exposure_exif):
            with Image.open(io.BytesIO(photograph)) as image:
                read(image)

    return Target(run, [tags.tobytes()[6:]])


def maps(work: Path) -> Target:
    """Read depth and normal maps. The first byte selects the format."""
    (lens,) = lenses_of(ColmapCamera("PINHOLE", 8, 6, (8.0, 8.0, 4.0, 3.0)), (8, 6), "a")
    endings, seeds = (".npy", ".npz", ".png", ".tiff", ".exr"), []
    for k, values in enumerate((np.ones((6, 8), np.float32), np.ones((6, 8), np.uint16), np.ones((6, 8, 3), "f4"))):
        buffer, packed = io.BytesIO(), io.BytesIO()
        np.save(buffer, values)
        np.savez_compressed(packed, values)
        seeds += [bytes([0]) + buffer.getvalue(), bytes([1]) + packed.getvalue()]
        if k == 1:
            for j, form in ((2, "PNG"), (3, "TIFF")):
                image = io.BytesIO()
                Image.fromarray(values).save(image, form)
                seeds.append(bytes([j]) + image.getvalue())
    head = b"v/1\1\2\0\0\0dataWindow\0box2i\0\20\0\0\0" + struct.pack("<4i", 0, 0, 7, 5)
    seeds.append(bytes([4]) + head + b"channels\0chlist\0\23\0\0\0Z\0\2\0\0\0\0\0\0\0\1\0\0\0\1\0\0\0\0\0")

    def run(data: bytes) -> None:
        path = work / f"map{endings[data[0] % len(endings) if data else 0]}"
        path.write_bytes(data[1:])
        for read, files in ((read_depth, MapFiles(depth=path)), (read_normal, MapFiles(normal=path))):
            try:
                read(files, lens)
            except CaptureError:
                pass

    return Target(run, seeds)


def ply(work: Path) -> Target:
    """Read point clouds."""
    path = _capture(work) / "sparse_pc.ply"
    text = "ply\nformat ascii 1.0\ncomment a\nelement vertex 2\nproperty double x\nproperty float y\nproperty float z\n"
    text += "property uchar red\nproperty uchar green\nproperty uchar blue\nelement face 1\n"
    text += "property list uchar int vertex_indices\nend_header\n1 2 3 4 5 6\n1 2 3 4 5 6\n3 0 1 0\n"
    seeds = [path.read_bytes(), text.encode()]

    def run(data: bytes) -> None:
        path.write_bytes(data)
        read_cloud(path, "look")

    return Target(run, seeds, (PlyError, CaptureError))


def camera_path(work: Path) -> Target:
    """Read camera paths, including nerfstudio's reader."""
    from nerfstudio.cameras.camera_paths import get_path_from_json

    frame = {"camera_to_world": np.eye(4).flatten().tolist(), "fov": 50.0, "aspect": 1.5, "principal_point": [0.5, 0.5]}
    value = {"render_width": 48, "render_height": 36, "seconds": 1.0, "fps": 2, "camera_type": "perspective"}
    value |= {"camera_path": [frame, frame], "crop": None, "keyframes": []}
    path = work / "path.json"

    def run(data: bytes) -> None:
        path.write_bytes(data)
        get_path_from_json(json.loads(read_camera_path(path).model_dump_json()))

    return Target(run, [json.dumps(value).encode()], (InputError,), True)


def report(work: Path) -> Target:
    """Read inputs of `bitymi report`. The first file of an input selects the name of the second."""
    results = {"psnr": 20.0, "ssim": 0.9, "lpips": 0.1, "psnr_std": 1.0, "num_rays_per_sec": 1e6, "fps": 3.0}
    evaluation = {"experiment_name": "a", "method_name": "bitymi", "checkpoint": "a/b/c.ckpt", "results": results}
    point = {"step": 10, "seconds": 1.0, "cpu_seconds": 2.0, "surfels": 10, "fragments": 5, "psnr": 20.0}
    point |= {"scene": "a", "method": "bitymi"}
    train = cell("train", {"seconds": 1.0, "steps": 10, "curve": "named/curve.jsonl"})
    cells = [
        train,
        cell("eval", evaluation),
        cell("export", {"bytes": 9}, "bc7"),
        cell("eval", {**evaluation, "pictures": "named"}, "bc7"),
    ]
    seeds = {"eval.json": [evaluation], "curve.jsonl": [point, point], "cells.jsonl": cells}
    names = list(seeds)

    def run(data: bytes) -> None:
        first, _, rest = data.partition(CUT)
        path = work / names[sum(first) % len(names)]
        path.write_bytes(rest)
        try:
            to_page(compose(collect([path], work / "out"), "fuzz"))
        finally:
            path.unlink()

    starts = [next(bytes([b]) for b in range(256) if b % len(names) == k) for k in range(len(names))]
    lines = ["".join(f"{json.dumps(line)}\n" for line in seeds[name]).encode() for name in names]
    (work / "named").mkdir()
    for name, line in zip(names, lines, strict=True):
        (work / "named" / name).write_bytes(line)
    return Target(run, [CUT.join(pair) for pair in zip(starts, lines, strict=True)], (ReportError,), True)


def checkpoint(work: Path) -> Target:
    """Read checkpoints with optimisers. An input chooses mutations of a valid one, whose bytes have a checksum."""
    path = checkpoints.path_of(work, 7)
    tensors = [torch.zeros(3), torch.zeros(0), torch.zeros(5, 3, dtype=torch.int32), torch.zeros(1, 1, 1)]
    tensors += [torch.full((5, 3), 1e30), torch.zeros(5, 3).expand(5, 3).T, torch.zeros(5, 3).to_sparse()]
    tensors += [torch.zeros(5, 3, dtype=torch.complex64), torch.zeros(5, dtype=torch.bool), torch.empty(5, 3, 0)]
    odd: tuple[Any, ...] = (*ODD_VALUES, *tensors, (1, 2), torch.float32, b"a")

    def run(data: bytes) -> None:
        dice = atheris.FuzzedDataProvider(data)
        value = [state(SceneConfig())]
        for _ in range(dice.ConsumeIntInRange(0, 3)):
            places = nodes(value)
            (holder, key), (other, name) = (places[dice.ConsumeIntInRange(0, len(places) - 1)] for _ in range(2))
            how = dice.ConsumeIntInRange(0, 5)
            if how == 0 and holder is not value:
                del holder[key]
            elif how == 1:
                holder[key] = copy.deepcopy(other[name])
            elif how == 2 and isinstance(holder, dict):
                holder[dice.ConsumeUnicodeNoSurrogates(8)] = holder.pop(key)
            else:
                holder[key] = odd[dice.ConsumeIntInRange(0, len(odd) - 1)]
        try:
            torch.save(value[0], path)
        except Exception:  # cannot be stored, hence not read
            return
        loaded = checkpoints.load(path, SceneConfig())
        for name, moments in loaded["optimizers"].items():
            parameter = loaded["pipeline"][f"_model.scene.surfels.{name}"]
            optimizer = moved(parameter)
            restore_optimizer(optimizer, Entry(moments, name))
            optimizer.step()

    return Target(run, [bytes(range(k, k + 40)) for k in range(8)], (InputError, checkpoints.Misfit))


def archive(work: Path) -> Target:
    """Read files of torch.save; an input that is no archive becomes the pickle of one."""
    path = checkpoints.path_of(work, 7)
    layers = torch.nn.Linear(2, 3).state_dict()
    whole = saved({"step": 7, "pipeline": layers, "optimizers": {"a": [(0.5, None, True, -(2**70))]}})
    with zipfile.ZipFile(io.BytesIO(whole)) as file:
        pickled = file.read("archive/data.pkl")

    def run(data: bytes) -> None:
        path.write_bytes(
            data if data[:1] == b"P" else parts(lambda held, _: {**held, "data.pkl": data}.items())(whole, work)
        )
        with reading("it", InputError), open(path, "rb") as file:
            state = read_archive(file)
        layers = state.get("pipeline") if isinstance(state, dict) else None
        for values in layers.values() if isinstance(layers, dict) else ():
            if isinstance(values, torch.Tensor):
                values.clone().sum()

    return Target(run, [whole, pickled], (InputError,))


TARGETS: dict[str, Callable[[Path], Target]] = {
    "transforms": transforms,
    "colmap-text": lambda work: _colmap(work, binary=False),
    "colmap-binary": lambda work: _colmap(work, binary=True),
    "exif": exif_data,
    "maps": maps,
    "ply": ply,
    "camera-path": camera_path,
    "report": report,
    "checkpoint": checkpoint,
    "archive": archive,
}
