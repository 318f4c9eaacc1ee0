"""`ns-export bitymi-atlas`: bake a trained scene into a bundle, and measure what the bake cost.

Also `python -m bitymi_ns.host.export`, should a future nerfstudio not take the command in.
"""

from __future__ import annotations

import copy
import io
import os
import pickle
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
import yaml
from nerfstudio.utils.eval_utils import eval_setup
from nerfstudio.utils.rich_utils import CONSOLE
from PIL import Image
from rich.table import Table

from bitymi_ns.bake import BakeOptions, BundleError, bake, export, read_bundle, rich_progress
from bitymi_ns.bake.bundle import World
from bitymi_ns.bake.folder import check_target
from bitymi_ns.bake.manifest import MANIFEST, dump
from bitymi_ns.host.bundle_config import BakedModelConfig
from bitymi_ns.host.cameras import to_camera
from bitymi_ns.host.errors import fail
from bitymi_ns.host.model import BitymiModel
from bitymi_ns.host.preset import build, load_preset
from bitymi_ns.scene.camera import Camera
from bitymi_ns.train.losses import psnr
from bitymi_ns.train.views import as_float, over_background

INTERRUPTED = 130


@dataclass(kw_only=True)
class ExportAtlas(BakeOptions):
    """Bake a trained bitymi scene into a bundle: surfels, a compressed texture atlas and a manifest.

    The bundle is written aside and renamed, opened again, and compared with the trained scene and with the photographs
    on the held-out views.
    """

    load_config: Path
    """config.yml of a trained scene."""
    output_dir: Path
    """Folder of the bundle."""
    overwrite: bool = False
    """Replace a bundle that is there already."""
    compare: bool = True
    """Render the held-out views from the bundle and from the trained scene and state the difference."""

    def main(self) -> None:
        """Run the export."""
        self._written = False
        try:
            self._run()
        except KeyboardInterrupt:
            there = (self.output_dir / MANIFEST).is_file()
            state = "is complete" if self._written else "is the earlier one" if there else "was not written"
            CONSOLE.print(f"[bold yellow]The export was interrupted; the bundle {self.output_dir} {state}.")
            raise SystemExit(INTERRUPTED) from None
        except BundleError as error:
            fail(str(error), error)

    def _run(self) -> None:
        try:
            check_target(self.output_dir, self.overwrite)
        except BundleError as error:
            hint = " Use --overwrite True to replace it." if not self.overwrite else ""
            fail(f"{error}.{hint}", error)
        config, pipeline = load_trained(self.load_config)
        model, datamanager = pipeline.model, pipeline.datamanager
        outputs = datamanager.train_dataparser_outputs
        cameras = datamanager.undistorted_train_cameras()
        views = [to_camera(cameras[i : i + 1], model.device) for i in range(len(cameras))]
        options = BakeOptions(**{f.name: getattr(self, f.name) for f in fields(BakeOptions)})
        try:
            with rich_progress() as progress:
                baked = bake(model.scene, views, options, progress)
        except (ValueError, RuntimeError) as error:  # an option out of range; the BC7 encoder is not installed
            fail(f"the scene cannot be baked: {error}", error)
        background = tuple(model.background.tolist())
        export(
            baked,
            self.output_dir,
            background=background,
            world=World(np.asarray(outputs.dataparser_transform)[:3], float(outputs.dataparser_scale)),
            statistics={"options": asdict(options), "method": config.method_name},
            extra_files={"preview.png": preview(model, datamanager, views)},
            loose_files={"config.yml": bundle_config(config, self.output_dir, background)},
            overwrite=self.overwrite,
        )
        self._written = True
        bundle = read_bundle(self.output_dir)
        if self.compare and len(datamanager.eval_dataset):
            from bitymi_ns.scene.baked import BakedScene

            scene = BakedScene.from_bundle(bundle)
            held_out = compare(model, datamanager, lambda c: scene.render(c, background=torch.tensor(background)).rgb)
            bundle.info["statistics"]["held_out"] = held_out
            replace_file(self.output_dir / MANIFEST, dump(bundle.info))
        print_summary(self.output_dir, bundle.info)


def default_export() -> ExportAtlas:
    """The options as the preset states them; what has no default is left open."""
    options = build(BakeOptions, load_preset("bitymi").bake, "bitymi.yaml", "bake.")
    return ExportAtlas(load_config=tyro.MISSING, output_dir=tyro.MISSING, **asdict(options))


def load_trained(load_config: Path) -> tuple[Any, Any]:
    """Configuration and pipeline of a trained scene."""
    if not load_config.is_file():
        fail(f"there is no {load_config}. Give the config.yml of a trained scene (ns-train says where it is).")
    try:
        config, pipeline, _, _ = eval_setup(load_config, test_mode="test")
    except (yaml.YAMLError, AttributeError, KeyError) as error:
        fail(f"{load_config} is not the configuration of a trained scene: {error}", error)
    except (RuntimeError, EOFError, IndexError, AssertionError, OSError, ValueError, pickle.UnpicklingError) as error:
        detail = (str(error).strip().splitlines() or [type(error).__name__])[0]
        fail(f"the checkpoint of {load_config} cannot be loaded: {detail}", error)
    if not isinstance(pipeline.model, BitymiModel):
        fail(
            f"{load_config} is of the method {config.method_name} and not a scene that can be baked; "
            "give the config.yml of a bitymi training run"
        )
    return config, pipeline


@torch.no_grad()
def preview(model: BitymiModel, datamanager: Any, train_views: list[Camera]) -> bytes:
    """A PNG of the first held-out view, or of the first training view where none is held out."""
    camera = train_views[0]
    if len(datamanager.eval_dataset):
        camera = to_camera(datamanager.eval_view(0)[0], model.device)
    rgb = model.render(camera, model.background, maps=False).rgb
    pixels = (rgb.clamp(0.0, 1.0) * 255.0).round().to(torch.uint8).cpu().numpy()
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, format="PNG")
    return buffer.getvalue()


@torch.no_grad()
def compare(model: BitymiModel, datamanager: Any, render_baked: Callable[[Camera], torch.Tensor]) -> dict[str, float]:
    """Mean PSNR in dB over the held-out views, of bundle, trained scene and photographs against each other."""
    rows = []
    background = model.background
    for index in range(len(datamanager.eval_dataset)):
        cameras, batch = datamanager.eval_view(index)
        camera = to_camera(cameras, model.device)
        neural = model.render(camera, background, maps=False).rgb.clamp(0.0, 1.0).cpu()
        baked = render_baked(camera.to("cpu")).clamp(0.0, 1.0)
        photo = over_background(as_float(batch["image"].cpu()), background.cpu())
        mask = batch.get("mask")
        mask = None if mask is None else mask.cpu()
        rows.append([psnr(baked, neural, mask), psnr(neural, photo, mask), psnr(baked, photo, mask)])
    names = ("psnr_baked_against_neural", "psnr_neural_against_photos", "psnr_baked_against_photos")
    means = (round(sum(column) / len(rows), 4) for column in zip(*rows, strict=True))
    return {"views": len(rows), **dict(zip(names, means, strict=True))}


def bundle_config(config: Any, folder: Path, background: tuple[float, ...]) -> bytes:
    """The config.yml with which nerfstudio's tools open the bundle.

    It is no part of what bundle.json vouches for: nothing of ours reads it, and its data path may have to be edited
    when the photographs are moved.
    """
    config = copy.deepcopy(config)
    config.pipeline.model = BakedModelConfig(bundle=folder.absolute(), background=background)  # type: ignore[arg-type]
    config.load_dir = config.load_step = config.load_checkpoint = config.load_config = None
    config.optimizers = {}
    return yaml.dump(config).encode("utf8")


def replace_file(path: Path, data: bytes) -> None:
    """Write a file whole or not at all."""
    unfinished = path.with_name(f".{path.name}.unfinished")
    try:
        unfinished.write_bytes(data)
        os.replace(unfinished, path)
    except OSError as error:
        fail(f"{path} could not be written: {error}", error)
    finally:
        unfinished.unlink(missing_ok=True)


def print_summary(folder: Path, info: dict[str, Any]) -> None:
    """What was written, what was left out, and what it cost."""
    statistics = info["statistics"]
    table = Table("", "", title=f"Bundle {folder}", show_header=False)
    table.add_row("Surfels", f"{info['surfels']['count']:,} of {statistics['surfels']['trained']:,}")
    left_out = {k: v for k, v in statistics["surfels"]["left_out"].items() if v}
    table.add_row("Left out", ", ".join(f"{v:,} {k.replace('_', ' ')}" for k, v in left_out.items()) or "nothing")
    atlas = statistics.get("atlas")
    if atlas is None:
        table.add_row("Atlas", "none (the scene has no texture)")
    else:
        layers, height, width = atlas["pages"]
        size = info["files"][info["atlas"]["file"]]["bytes"]
        table.add_row("Atlas", f"{size / 1e6:.2f} MB {info['atlas']['format']}, {layers} x {width} x {height} texels")
        table.add_row("Occupancy", f"{100 * atlas['occupancy']:.1f} %")
        texels = statistics["texels"]
        saved = texels["nyquist"] - texels["after_cap_by_views"]
        table.add_row("Texels not needed", f"{saved:,} of {texels['nyquist']:,} (finer than any training view sees)")
        if atlas.get("psnr") is not None:
            table.add_row("Quantisation", f"{atlas['psnr']:.2f} dB over the texels")
    table.add_row("Files", f"{sum(f['bytes'] for f in info['files'].values()) / 1e6:.2f} MB in total")
    held_out = statistics.get("held_out")
    if held_out:
        table.add_row("Held-out views", f"{held_out['views']}")
        table.add_row("Bundle against trained scene", f"{held_out['psnr_baked_against_neural']:.2f} dB")
        table.add_row("Trained scene against photographs", f"{held_out['psnr_neural_against_photos']:.2f} dB")
        table.add_row("Bundle against photographs", f"{held_out['psnr_baked_against_photos']:.2f} dB")
    CONSOLE.print(table)
    CONSOLE.print(f"Evaluate it with: ns-eval --load-config {folder / 'config.yml'}", soft_wrap=True)


def main() -> None:
    """Command line of this module."""
    tyro.cli(tyro.conf.FlagConversionOff[ExportAtlas], default=default_export()).main()


if __name__ == "__main__":
    main()
