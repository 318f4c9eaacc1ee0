"""Measure each quality knob: error against its exact setting, milliseconds and bytes."""

import json
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from bitymi_ns.bake import Baked, BakeOptions, Learning, baked_and_reduced, rich_progress
from bitymi_ns.codec.quantise import STEPS
from bitymi_ns.measure.machine import commit, machine, versions
from bitymi_ns.ops.constants import ALPHA_MIN, TRANSMITTANCE_MIN
from bitymi_ns.plugin.console import fail, say
from bitymi_ns.plugin.data.cameras import to_cameras
from bitymi_ns.plugin.export.target import replace_file, require_writable
from bitymi_ns.plugin.export.trained import load_trained
from bitymi_ns.scene.baked import FAST, BakedScene
from bitymi_ns.scene.camera import Camera
from bitymi_ns.scene.field import TexelField
from bitymi_ns.train.evaluate import evenly_spaced
from bitymi_ns.train.losses import psnr

WEIGHT_BOUNDS = (0.0, ALPHA_MIN, 0.01, 0.02, 0.05, 0.1)
TRANSMITTANCES = (0.0, TRANSMITTANCE_MIN, FAST, 1e-2, 5e-2)
TILE_SIDES = (8, 16, 32, 64, 128)
TOLERANCES = (0.0, 0.25, 0.5, 0.75, 1.0, 2.0, 4.0)
FORMATS = ("fp16", "uint8", "bc7")
SIZES = (1.0, 0.75, 0.5, 0.25)

KNOBS = {
    "weight_bound": "fragments of smaller blending weight get no residual; exact: all do",
    "transmittance": "a pixel takes no surfel that would leave it less; exact: it takes all",
    "format": "texels of the atlas; exact: 32-bit floats",
    "r_max": "largest tile side; exact: the field at every fragment",
    "tolerance": "error allowed to the atlas, in 8-bit steps, 0 = the whole grid; exact: the field at every fragment",
    "resolution": "share of the image's side that is rendered, enlarged bilinearly; exact: all of it",
}
"""Knob -> what it does, and what it is measured against."""

Render = Callable[[Camera], Tensor]


@dataclass(frozen=True)
class Setting:
    """A value of a knob.

    Attributes:
        renderer: `trained` (the field at every fragment) or `baked`.
        render: camera -> [H, W, 3].
        bytes: of the atlas as it is stored; None where the knob does not change it.
        exact: the setting that the others are compared with.
        default: the setting of the run or of the exporter.
    """

    knob: str
    value: float | str
    renderer: str
    render: Render
    bytes: int | None = None
    exact: bool = False
    default: bool = False


class HeldOut:
    """Evenly spaced held-out views of a run with their photographs over the background."""

    def __init__(self, pipeline: Any, views: int) -> None:
        datamanager, model = pipeline.datamanager, pipeline.model
        count = len(datamanager.eval_dataset)
        if count == 0:
            fail("the run has no held-out views; knobs are measured on them")
        self.background: Tensor = model.background.cpu()
        self.views = [datamanager.eval_views[index] for index in evenly_spaced(count, views)]
        self.cameras: list[Camera] = [view.camera for view in self.views]  # on the device of the run

    def psnr(self, images: Sequence[Tensor]) -> float:
        """Mean PSNR in dB against the photographs, inside their masks."""
        pairs = [(image, view.to("cpu")) for image, view in zip(images, self.views, strict=True)]
        return statistics.fmean(psnr(image, v.target(self.background, "cpu"), v.mask) for image, v in pairs)

    def render(self, setting: Setting, repeats: int) -> tuple[list[Tensor], float, float]:
        """Images [H, W, 3] in [0, 1], wall and CPU milliseconds per view (medians of repeats, mean of views)."""
        images, wall, cpu = [], [], []
        for camera in self.cameras:
            images.append(setting.render(camera).clamp(0.0, 1.0).cpu())
            times = []
            for _ in range(max(1, repeats)):
                start = (time.perf_counter(), time.process_time())
                setting.render(camera)
                times.append((time.perf_counter() - start[0], time.process_time() - start[1]))
            wall.append(1e3 * statistics.median(t[0] for t in times))
            cpu.append(1e3 * statistics.median(t[1] for t in times))
        return images, statistics.fmean(wall), statistics.fmean(cpu)


def measure(held_out: HeldOut, settings: Sequence[Setting], repeats: int) -> list[dict[str, Any]]:
    """Measure the settings of one knob and renderer, of which exactly one is exact.

    Errors are against the exact setting, over all pixels and colours of all views, before rounding to 8 bits:
    `max_steps` and `mean_steps` in 8-bit steps, `psnr_exact` in dB. `psnr` is against the photographs; `ms` and
    `cpu_ms` are per view.
    """
    exact = next(s for s in settings if s.exact)
    drawn = {id(s): held_out.render(s, repeats) for s in [exact, *(s for s in settings if s is not exact)]}
    truth = drawn[id(exact)][0]
    points = []
    for setting in settings:
        images, ms, cpu_ms = drawn[id(setting)]
        errors = torch.cat([(a - b).abs().flatten() for a, b in zip(images, truth, strict=True)]).double()
        figures = {
            "max_steps": round(STEPS * float(errors.max()), 4),
            "mean_steps": round(STEPS * float(errors.mean()), 6),
            "psnr_exact": round(psnr(errors.square().mean().sqrt(), torch.tensor(0.0)), 4),
            "psnr": round(held_out.psnr(images), 4),
            "ms": round(ms, 3),
            "cpu_ms": round(cpu_ms, 3),
        }
        about = {name: value for name, value in vars(setting).items() if name != "render"}
        points.append({**about, **figures})
    return points


class Knobs:
    """The settings of every knob of a trained run."""

    def __init__(self, config: Any, pipeline: Any) -> None:
        model = pipeline.model
        self.scene = model.scene
        self.background = model.background.cpu()
        self.options = replace(BakeOptions(), drop_unseen=False, tolerance=0.0)  # one knob at a time: all else is kept
        self.views = to_cameras(pipeline.datamanager.train_dataset.cameras, model.device)
        self.bound = float(self.scene.config.weight_bound)
        self.has_learned = isinstance(self.scene.field, TexelField)

    def trained(self, camera: Camera, bound: float | None = None) -> Tensor:
        """Draw the trained scene, not baked."""
        with torch.no_grad():
            return self.scene.render(
                camera, self.background.to(camera.K), "frozen", weight_bound=self.bound if bound is None else bound
            ).rgb

    def _bake(self, **options: Any) -> Baked:
        with rich_progress() as progress:
            chosen = replace(self.options, **options)
            made = baked_and_reduced(self.scene, self.views, (), self.background, chosen, Learning(), progress)
            return made.encoded(progress)

    def _all_colors(self, baked: Baked, scene: BakedScene) -> BakedScene:
        """A scene with the view colours as trained: the knobs are those of the atlas."""
        surfels = {name: value.detach()[baked.rows].float().cpu() for name, value in self.scene.surfels.items()}
        return replace(scene, surfels=surfels)

    def exact_texels(self, baked: Baked) -> BakedScene:
        """A bake with its texels as 32-bit floats."""
        return self._all_colors(baked, baked.unquantised())

    def stored_texels(self, baked: Baked) -> BakedScene:
        """A bake with its texels as they are stored."""
        return self._all_colors(baked, baked.stored())

    def _draw(self, scene: BakedScene, bound: float | None = None, stop: float = TRANSMITTANCE_MIN) -> Render:
        """Settings share the scene and its cached state of the renderer."""

        def draw(camera: Camera) -> Tensor:
            scene.weight_bound = self.bound if bound is None else bound
            scene.transmittance_min = stop
            return scene.render(camera.to("cpu"), background=self.background).rgb

        return draw

    def groups(self, wanted: Sequence[str]) -> Iterator[list[Setting]]:
        """The settings of one knob and renderer after the other."""
        textured = self.scene.field is not None
        if "weight_bound" in wanted and textured:
            draws = {v: lambda c, v=v: self.trained(c, v) for v in sorted({*WEIGHT_BOUNDS, self.bound})}
            yield _group("weight_bound", 0.0, self.bound, draws, "trained")
        if {"weight_bound", "transmittance", "format", "resolution"} & set(wanted):
            yield from self._of_one_bake(wanted, textured)
        if "r_max" in wanted and textured and not self.has_learned:  # else the tiles have their sizes already
            yield self._of_the_bake("r_max", TILE_SIDES, self.options.r_max)
        if "tolerance" in wanted and textured:
            yield self._of_the_bake("tolerance", TOLERANCES, BakeOptions().tolerance)

    def _of_one_bake(self, wanted: Sequence[str], textured: bool) -> Iterator[list[Setting]]:
        baked = self._bake()
        stored = self.stored_texels(baked)

        if "weight_bound" in wanted and textured:
            bounds = sorted({*WEIGHT_BOUNDS, self.bound})
            yield _group("weight_bound", 0.0, self.bound, {v: self._draw(stored, bound=v) for v in bounds})
        if "transmittance" in wanted:
            draws = {v: self._draw(stored, stop=v) for v in TRANSMITTANCES}
            yield _group("transmittance", 0.0, TRANSMITTANCE_MIN, draws)
        if "resolution" in wanted:
            draw = self._draw(stored)
            yield _group("resolution", 1.0, 1.0, {v: lambda c, v=v: _enlarged(draw, c, v) for v in SIZES})
        if "format" in wanted and textured:
            texels = baked.texels
            assert texels is not None
            exact = self._draw(self.exact_texels(baked))
            settings = [Setting("format", "float32", "baked", exact, 16 * texels[..., 0].numel(), True)]
            for name in FORMATS:
                other = replace(baked, options=replace(baked.options, format=name)).with_texels(texels).encoded()
                assert other.atlas is not None
                draw = self._draw(self.stored_texels(other))
                default = name == self.options.format
                settings.append(Setting("format", name, "baked", draw, other.atlas.nbytes, False, default))
            yield settings

    def _of_the_bake(self, knob: str, values: Sequence[float], default: float) -> list[Setting]:
        """Against the field itself; texels as 32-bit floats, so that the format's error is not in it."""
        settings = [Setting(knob, "field", "trained", self.trained, None, True)]
        for value in sorted({*values, default}):
            baked = self._bake(**{knob: value})
            draw = self._draw(self.exact_texels(baked))
            size = None if baked.atlas is None else baked.atlas.nbytes
            settings.append(Setting(knob, value, "baked", draw, size, False, value == default))
        return settings


def _group(
    knob: str, exact: float, default: float, draws: dict[float, Render], renderer: str = "baked"
) -> list[Setting]:
    return [Setting(knob, v, renderer, draw, None, v == exact, v == default) for v, draw in draws.items()]


def _enlarged(draw: Render, camera: Camera, share: float) -> Tensor:
    """Render a view at a share of its size and enlarge it bilinearly, [H, W, 3]."""
    small = draw(camera.scaled(share))
    if share == 1.0:
        return small
    size = (camera.height, camera.width)
    return interpolate(small.permute(2, 0, 1)[None], size=size, mode="bilinear")[0].permute(1, 2, 0)


def measure_to_file(load_config: Path, output: Path, knobs: Sequence[str], views: int, repeats: int) -> None:
    """Measure the knobs of a trained run and write a JSON line a setting.

    Args:
        load_config: config.yml of a trained run.
        output: the file; replaced when all is measured.
        knobs: some of `KNOBS`; empty = all.
        views: held-out views, evenly spaced; 0 = all.
        repeats: timed renderings of each view.
    """
    unknown = [name for name in knobs if name not in KNOBS]
    if unknown:
        fail(f"there is no knob {', '.join(unknown)}; there are {', '.join(KNOBS)}")
    if repeats < 1:
        fail(f"--repeats must be at least 1, not {repeats}")
    if not output.parent.is_dir():
        fail(f"there is no folder {output.parent} for {output.name}")
    require_writable(output)
    config, pipeline = load_trained(load_config)
    held_out = HeldOut(pipeline, views)
    about = {"scene": config.experiment_name, "method": config.method_name, "views": len(held_out.cameras)}
    origin = {"machine": machine(), "versions": versions(), "commit": commit(), "config": str(load_config)}
    lines = []
    for settings in Knobs(config, pipeline).groups(list(knobs) or list(KNOBS)):
        for point in measure(held_out, settings, repeats):
            lines.append(json.dumps({**point, **about, "against": KNOBS[point["knob"]], "made": origin}))
        name = f"{settings[0].knob} ({settings[-1].renderer})"
        say(f"{name}: {len(settings)} settings on {len(held_out.cameras)} views")
    if not lines:
        fail("none of these knobs applies to this run: it has no texture")
    replace_file(output, ("\n".join(lines) + "\n").encode("utf8"))
    say(f"Wrote {output}")
