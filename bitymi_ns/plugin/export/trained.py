"""Load and preview a trained run, make its bundle's cameras.json, and compare both."""

import io
import pickle
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from nerfstudio.utils.eval_utils import eval_setup
from nerfstudio.utils.rich_utils import CONSOLE
from PIL import Image

from bitymi_ns.bake.verify import check_view_color
from bitymi_ns.bundle import Bundle, Check, check_world
from bitymi_ns.bundle.cameras import CapturedCamera, cameras_data
from bitymi_ns.bundle.parts import CAMERAS, bundle_at
from bitymi_ns.bundle.statistics import HeldOut
from bitymi_ns.bundle.world import World
from bitymi_ns.capture.frame import UP, read_frame
from bitymi_ns.exit_messages import line_of
from bitymi_ns.scene.baked import BakedScene, as_bytes
from bitymi_ns.scene.camera import Camera
from bitymi_ns.train.losses import fitted_psnr, psnr
from bitymi_ns.trust import told_apart
from ..console import fail
from ..data.cameras import to_cameras
from ..run.model import BitymiModel

_PSNR_SLACK = 0.1  # dB
MOST_PIXELS = 1600  # longer side of a photograph in a bundle


def load_trained(load_config: Path, step: int | None = None) -> tuple[Any, Any]:
    """Load configuration and pipeline of a trained scene, at a checkpoint's step or the last one."""

    def choose(config: Any) -> Any:
        config.load_step = step
        return config

    if bundle_at(load_config) is not None:
        fail(f"{load_config} is a bundle's. Give the config.yml of the training run that it was made from.")
    if not load_config.is_file():
        fail(f"there is no {load_config}. Give the config.yml of a trained scene (ns-train says where it is).")
    try:
        config, pipeline, _, _ = eval_setup(load_config, test_mode="test", update_config_callback=choose)
    except (yaml.YAMLError, AttributeError, KeyError) as error:
        fail(f"{load_config} is not the configuration of a trained scene: {error}", error)
    except (RuntimeError, EOFError, IndexError, AssertionError, OSError, ValueError, pickle.UnpicklingError) as error:
        detail = line_of(error) or (str(error).strip().splitlines() or [""])[0]
        if isinstance(error, AssertionError) and not detail:  # nerfstudio's, of another kind of file
            fail(f"{load_config} is not the configuration of a trained scene. ns-train says where it is.", error)
        fail(f"the checkpoint of {load_config} cannot be loaded: {detail or type(error).__name__}", error)
    if not isinstance(pipeline.model, BitymiModel):
        fail(f"{load_config} is a run of {config.method_name}: give the config.yml of a bitymi training run")
    return config, pipeline


def world_of(datamanager: Any) -> World:
    """Return the transform from the capture to the scene, with up and metres if this package's SfM found the poses."""
    outputs = datamanager.train_dataparser_outputs
    report = datamanager.train_dataset.facts.poses_report
    frame = None if report is None else read_frame(report)
    transform = np.asarray(outputs.dataparser_transform)[:3]
    scale = float(outputs.dataparser_scale)
    return World(transform, scale) if frame is None else World(transform, scale, UP, frame.up, frame.metres_per_unit)


@torch.no_grad()
def preview(model: BitymiModel, camera: Camera, format: str = "PNG") -> bytes:
    return _encoded(model.render(camera, model.background, maps=False).rgb, format)


def camera_files(datamanager: Any, train: Sequence[Camera], photographs: bool, exposure: Any) -> dict[str, bytes]:
    """Make cameras.json, with colour corrections by the state of the run's `Exposure`, and, if asked for, the held-out
    photographs as JPEG of at most `MOST_PIXELS` along a side: contents by name of the file."""
    files: dict[str, bytes] = {}
    photos = [*datamanager.train_dataset.image_filenames, *datamanager.eval_dataset.image_filenames]
    names = told_apart(photos)
    trained, held_out = datamanager.corrections(exposure)
    given = zip(names[: len(train)], train, trained, strict=True)
    rows = [CapturedCamera.of(name, camera, False, correction=of_camera) for name, camera, of_camera in given]
    for i, name in enumerate(names[len(train) :]):
        view = datamanager.eval_views[i]
        photograph = f"photograph-{i + 1:04d}.jpg" if photographs else None
        if photograph is not None:
            files[photograph] = _encoded(view.target(torch.zeros(3), "cpu"), "JPEG", MOST_PIXELS, quality=88)
        rows.append(CapturedCamera.of(name, view.camera, True, photograph, held_out[i]))
    return {CAMERAS: cameras_data(rows), **files}


def _encoded(image: torch.Tensor, format: str, most: int | None = None, **options: Any) -> bytes:
    """Encode an image [H, W, 3], of at most `most` pixels along a side."""
    picture, buffer = Image.fromarray(as_bytes(image).numpy()), io.BytesIO()
    if most is not None:
        picture.thumbnail((most, most), Image.Resampling.LANCZOS)
    picture.save(buffer, format=format, **options)
    return buffer.getvalue()


@torch.no_grad()
def compare(model: BitymiModel, datamanager: Any, scene: BakedScene) -> HeldOut:
    """Average `held_out_psnr` in dB over the held-out views, with the worst of the bundle against the trained scene."""
    rows = held_out_psnr(model, datamanager, scene, len(datamanager.eval_dataset))
    names = ("psnr_baked_against_neural", "psnr_neural_against_photos", "psnr_baked_against_photos")
    names += ("fitted_psnr_neural_against_photos", "fitted_psnr_baked_against_photos")
    means = (round(sum(column) / len(rows), 4) for column in zip(*rows, strict=True))
    worst = round(min(row[0] for row in rows), 4)
    return HeldOut(views=len(rows), **dict(zip(names, means, strict=True)), psnr_baked_against_neural_worst=worst)


@torch.no_grad()
def held_out_psnr(model: BitymiModel, datamanager: Any, scene: BakedScene, views: int) -> list[list[float]]:
    """Compute PSNR of the first `views` held-out views, a row each: bundle against trained scene, trained scene and
    bundle against the photograph, and these two after the affine fit of colours."""
    rows = []
    scene, background = scene.to(model.device), model.background
    held_out = datamanager.corrected_eval_views(model.resume_state.get("exposure"))
    for view in (held_out[index].to(model.device) for index in range(min(views, len(held_out)))):
        drawn = model.render(view.camera, background, maps=False), scene.render(view.camera, background)
        neural, baked = (view.shown(output.rgb, output.alpha, background).clamp(0.0, 1.0) for output in drawn)
        photo = view.target(background, model.device)
        of_photo = [measure(rgb, photo, view.mask) for measure in (psnr, fitted_psnr) for rgb in (neural, baked)]
        rows.append([psnr(baked, neural, view.mask), *of_photo])
    return rows


def check_run(bundle: Bundle, run: Path, views: int) -> list[Check]:
    """Check a bundle against its run, named by config.yml, folder or a checkpoint."""
    if views < 1:
        fail(f"--views must be at least 1, not {views}")
    step = None
    if run.suffix == ".ckpt":
        number = run.stem.removeprefix("step-")
        if not run.is_file() or not number.isdecimal():
            fail(f"there is no checkpoint {run}")
        run, step = run.parent.parent / "config.yml", int(number)
    elif run.is_dir():  # of the run or of its checkpoints
        folders = [folder for folder in (run, run.parent) if (folder / "config.yml").is_file()]
        run = (folders[0] if folders else run) / "config.yml"
    with CONSOLE.capture():  # nerfstudio reports at length
        _, pipeline = load_trained(run, step)
    model, datamanager = pipeline.model, pipeline.datamanager
    train = to_cameras(datamanager.train_dataset.cameras, "cpu")
    checks = [check_view_color(bundle, model.scene.surfels, train)]
    if len(datamanager.eval_dataset):
        rows = held_out_psnr(model, datamanager, bundle.scene, views)
        worst = min(row[0] for row in rows)
        photos = sum(row[2] - row[1] for row in rows) / len(rows)
        stated = bundle.info.statistics.held_out and bundle.info.statistics.held_out.psnr_baked_against_neural_worst
        detail = f"at least {worst:.2f} dB in {len(rows)} views"
        detail += "" if stated is None else f" (stated {stated:.2f})"
        detail += f"; against the photographs {photos:+.3f} dB"
        checks.append(Check("PSNR against the trained scene", stated is None or worst >= stated - _PSNR_SLACK, detail))
    return [*checks, check_world(bundle.info.world, world_of(datamanager))]
