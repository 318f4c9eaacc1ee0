"""`bitymi verify`: is a bundle whole, and does it hold what the trained scene holds?"""

from __future__ import annotations

import copy
from pathlib import Path

import torch
from nerfstudio.utils.rich_utils import CONSOLE

from bitymi_ns.bake.verify import check_field, check_view_color
from bitymi_ns.bundle import Bundle, Check, check_world
from bitymi_ns.plugin.data.cameras import to_camera
from bitymi_ns.plugin.errors import fail
from bitymi_ns.plugin.export.command import held_out_psnr, load_trained, world_of
from bitymi_ns.scene.field import HashField

_PSNR_SLACK = 0.1  # dB


def check_run(bundle: Bundle, run: Path, views: int) -> list[Check]:
    """Checks a bundle against the run it was baked from.

    Args:
        bundle: what was read.
        run: config.yml of the run, its folder, or one of its checkpoints.
        views: held-out views to render.
    """
    if views < 1:
        fail(f"--views must be at least 1, not {views}")
    config, step = find_run(run)
    with CONSOLE.capture():  # nerfstudio reports at length what it loads
        _, pipeline = load_trained(config, step)
    model, datamanager = pipeline.model, pipeline.datamanager
    cameras = datamanager.train_dataset.cameras
    train = [to_camera(cameras[i : i + 1], torch.device("cpu")) for i in range(len(cameras))]
    checks = [check_view_color(bundle, model.scene.surfels, train)]
    if isinstance(model.scene.field, HashField):
        checks.append(check_field(bundle, copy.deepcopy(model.scene.field).cpu(), train))
    if len(datamanager.eval_dataset):
        scene, background = bundle.scene, model.background.cpu()
        rows = held_out_psnr(model, datamanager, lambda c: scene.render(c, background=background).rgb, views)
        worst, photos = min(row[0] for row in rows), sum(row[2] - row[1] for row in rows) / len(rows)
        stated = bundle.info.statistics.held_out and bundle.info.statistics.held_out.psnr_baked_against_neural_worst
        detail = f"at least {worst:.2f} dB in {len(rows)} views"
        detail += "" if stated is None else f" (stated {stated:.2f})"
        detail += f"; against the photographs {photos:+.3f} dB"
        checks.append(Check("PSNR against the trained scene", stated is None or worst >= stated - _PSNR_SLACK, detail))
    return [*checks, check_world(bundle.info.world, world_of(datamanager))]


def find_run(run: Path) -> tuple[Path, int | None]:
    """The config.yml of a run named by it, by its folder or by a checkpoint, and the checkpoint's step."""
    if run.suffix == ".ckpt":
        step = run.stem.removeprefix("step-")
        if not run.is_file() or not step.isdecimal():
            fail(f"there is no checkpoint {run}")
        return run.parent.parent / "config.yml", int(step)
    if run.is_dir() and not (run / "config.yml").is_file() and (run.parent / "config.yml").is_file():
        run = run.parent  # the folder of its checkpoints
    return (run / "config.yml" if run.is_dir() else run), None
