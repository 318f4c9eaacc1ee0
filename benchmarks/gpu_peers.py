#!/usr/bin/env python
"""Compare with gsplat at equal quality on a card: train its Gaussians on the photographs of our bundles by its MCMC
strategy, with several numbers of Gaussians, and draw both at the held-out cameras: PSNR beside ms per frame.

Our bundles are those that `gpu_train.py --keep` left; `--train` trains the Gaussians first, from the same points, with
the rates of gsplat's own example and the regularisation that the strategy asks for."""

import math
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Any

import torch
from common import arguments_of, number, page, publish, say, table
from gpu_baked import measured
from harness import Options, attempt, milliseconds
from plain_capture import Capture, load_capture
from torch import Tensor
from torch.nn.functional import normalize

from bitymi_ns.bundle import read_bundle
from bitymi_ns.ops.constants import SH_C0
from bitymi_ns.ops.ssim import ssim
from bitymi_ns.scene.baked import BakedScene
from bitymi_ns.scene.baked_renderer import BakedRenderer
from bitymi_ns.scene.camera import Camera
from bitymi_ns.train.init import neighbour_distance, scene_extent
from bitymi_ns.train.losses import cc_psnr, photometric, psnr
from bitymi_ns.train.views import View, training_order

RATES = {"means": 1.6e-4, "scales": 5e-3, "opacities": 5e-2, "quats": 1e-3, "sh0": 2.5e-3, "shN": 2.5e-3 / 20}

Frames = Callable[[Camera], Callable[[], Tensor]]  # makes for a camera a function that draws its view, [H, W, 3]


def rasterized(gsplat: Any, g: dict[str, Tensor]) -> Frames:
    """Frames by gsplat's rasterization, of Gaussians as in `Gaussians.finished`."""

    def make(camera: Camera) -> Callable[[], Tensor]:
        view = (camera.viewmat[None], camera.K[None], camera.width, camera.height)
        return torch.no_grad()(lambda: gsplat.rasterization(*g.values(), *view, sh_degree=3, packed=False)[0][0])

    return make


def inferred(gsplat: Any, g: dict[str, Tensor]) -> Frames:
    """Frames by its inference renderer, of a scene that is packed to half precision beforehand."""
    from gsplat.experimental import GaussianInferenceRenderer, GaussianInferenceScene

    scene = GaussianInferenceScene.from_gaussian_tensors(
        *g.values(), sh_degree=3, sh_compression="none", id=f"none{len(g['means'])}"
    )
    renderer = GaussianInferenceRenderer(scene)

    def make(camera: Camera) -> Callable[[], Tensor]:
        view = {"viewmat": camera.viewmat, "K": camera.K, "width": camera.width, "height": camera.height}
        return torch.inference_mode()(lambda: renderer.render(**view).frame[0, ..., :3])

    return make


def load() -> tuple[Any, str]:
    """Import gsplat: the module and, where it is missing, the reason."""
    try:
        import gsplat
        import gsplat.cuda._backend  # compiles the kernels where that was not done
    except (ImportError, RuntimeError, OSError) as error:
        return None, f"gsplat cannot be timed here: {error}"
    return gsplat, ""


@dataclass
class Row:
    """A way to draw a scene: renderer, primitives, seconds of training (None = not trained here), means over the
    held-out views of psnr, psnr after the affine fit and ssim, and factor of the size -> mean ms per frame."""

    name: str
    count: int
    seconds: float | None
    quality: tuple[float, ...]
    frames: dict[int, float]


def quality(draw: Callable[[Camera], Tensor], views: Sequence[View], device: torch.device) -> tuple[float, ...]:
    """Means over the views: psnr, psnr after the affine fit, ssim."""
    values = []
    for view in (view.to(device) for view in views):
        rgb, target = draw(view.camera).float().clamp(0, 1), view.target(None, device)
        values.append((psnr(rgb, target, view.mask), cc_psnr(rgb, target, view.mask), float(ssim(rgb, target))))
    return tuple(fmean(column) for column in zip(*values, strict=True))


def timed(make: Callable[[Camera], Callable[[], object]], cameras: Sequence[Camera], options: Options) -> float:
    """Mean over the cameras of the median milliseconds of a frame."""
    return fmean(milliseconds(make(camera), options) for camera in cameras)


class Gaussians:
    """Trains Gaussians on a capture, by gsplat's MCMC strategy.

    Attributes:
        parameters: means, scales (logarithms), quats, opacities (logits), sh0 [N, 1, 3], shN [N, 15, 3].
        seconds: of training.
    """

    def __init__(self, gsplat: Any, capture: Capture, most: int, steps: int, device: torch.device) -> None:
        """
        Args:
            most: Gaussians.
            steps: of training; the strategy refines in the first 25 of 30 parts.
        """
        self._gsplat = gsplat
        centres = torch.stack([view.camera.center for view in capture.train])
        extent = scene_extent(centres, capture.points)
        self.parameters = torch.nn.ParameterDict(
            {name: torch.nn.Parameter(value.to(device)) for name, value in self._first(capture, most, extent).items()}
        )
        rates = {**RATES, "means": RATES["means"] * extent}
        optimizers = {
            name: torch.optim.Adam([{"params": value, "lr": rates[name], "name": name}], eps=1e-15, fused=True)
            for name, value in self.parameters.items()
        }
        strategy = gsplat.MCMCStrategy(
            cap_max=most, refine_start_iter=min(500, steps // 10), refine_stop_iter=steps * 25 // 30
        )
        strategy.check_sanity(self.parameters, optimizers)
        state = strategy.initialize_state()
        falling = torch.optim.lr_scheduler.ExponentialLR(optimizers["means"], gamma=0.01 ** (1 / steps))
        views = [view.to(device) for view in capture.train]
        torch.cuda.synchronize(device)
        start = time.perf_counter()
        for step in range(steps):
            view = views[training_order(len(views), 0, step)]
            rgb, information = self._draw(view.camera, min(3, step // max(1, min(1000, steps // 10))))
            target = view.target(None, device)
            loss = photometric(rgb, target, 0.2) + 0.01 * torch.sigmoid(self.parameters["opacities"]).mean()
            loss = loss + 0.01 * torch.exp(self.parameters["scales"]).mean()
            loss.backward()
            for optimizer in optimizers.values():
                optimizer.step()
                optimizer.zero_grad(set_to_none=True)
            falling.step()
            rate = falling.get_last_lr()[0]
            strategy.step_post_backward(self.parameters, optimizers, state, step, information, lr=rate)
        torch.cuda.synchronize(device)
        self.seconds = time.perf_counter() - start

    @staticmethod
    def _first(capture: Capture, most: int, extent: float) -> dict[str, Tensor]:
        chosen = torch.randperm(len(capture.points), generator=torch.Generator().manual_seed(0))[:most]
        points, colours = capture.points[chosen], capture.colours[chosen]
        size = neighbour_distance(points, extent).clamp_min(1e-6)
        n = len(points)
        return {
            "means": points.clone(),
            "scales": torch.log(0.1 * size)[:, None].repeat(1, 3),
            "quats": torch.randn(n, 4, generator=torch.Generator().manual_seed(1)),
            "opacities": torch.logit(torch.full((n,), 0.5)),
            "sh0": ((colours - 0.5) / SH_C0)[:, None],
            "shN": torch.zeros(n, 15, 3),
        }

    def _draw(self, camera: Camera, degree: int = 3) -> tuple[Tensor, dict]:
        p = self.parameters
        rgb, _, information = self._gsplat.rasterization(
            p["means"],
            p["quats"],
            torch.exp(p["scales"]),
            torch.sigmoid(p["opacities"]),
            torch.cat([p["sh0"], p["shN"]], 1),
            camera.viewmat[None],
            camera.K[None],
            camera.width,
            camera.height,
            sh_degree=degree,
            packed=False,
        )
        return rgb[0], information

    @torch.no_grad()
    def finished(self) -> dict[str, Tensor]:
        """means, quats (unit), scales, opacities, sh [N, 16, 3]."""
        p = self.parameters
        return {
            "means": p["means"].detach().contiguous(),
            "quats": normalize(p["quats"].detach(), dim=-1).contiguous(),
            "scales": p["scales"].detach().exp().contiguous(),
            "opacities": torch.sigmoid(p["opacities"].detach()).contiguous(),
            "sh": torch.cat([p["sh0"], p["shN"]], 1).detach().contiguous(),
        }


def row(
    name: str,
    count: int,
    seconds: float | None,
    make: Frames,
    capture: Capture,
    cameras: Sequence[Camera],
    times: Sequence[int],
    options: Options,
) -> Row:
    """Measure one renderer."""
    good = quality(lambda camera: make(camera)(), capture.held_out, options.device)
    frames = {k: timed(make, [camera.scaled(k) for camera in cameras], options) for k in times}
    say(f"{name}, {count:,}: {good[0]:.2f} dB, " + ", ".join(f"{ms:.3f} ms at {k} x" for k, ms in frames.items()))
    return Row(name, count, seconds, good, frames)


def packed_picture(scene: BakedScene, camera: Camera) -> Tensor:
    """[H, W, 3] of a frame with 8 bits per channel."""
    drawn = BakedRenderer(scene, camera.width, camera.height, images=("packed",)).draw([camera])["packed"][0]
    return drawn.view(torch.uint8).reshape(camera.height, camera.width, 4)[..., :3] / 255


def report(rows: Sequence[Row], capture: Capture, times: Sequence[int]) -> str:
    """Markdown."""
    camera = capture.held_out[0].camera
    header = ("what draws", "primitives", "training s", "PSNR dB", "after affine fit", "SSIM")
    header += tuple(f"ms at {k * camera.width} x {k * camera.height}" for k in times)
    cells = [
        [r.name, number(r.count, 0), number(r.seconds, 0), *(number(r.quality[i], 2) for i in (0, 1))]
        + [number(r.quality[2], 3), *(number(r.frames.get(k, math.nan), 3) for k in times)]
        for r in rows
    ]
    text = f"{len(capture.train)} photographs of {camera.width} x {camera.height}; {len(capture.held_out)} held out.\n"
    return text + "\n" + table(header, cells)


def main() -> int:
    """Command line."""
    parser = arguments_of(__doc__)
    parser.add_argument("data", type=Path, help="folder of an undistorted capture with transforms.json")
    parser.add_argument("--train", nargs="+", type=int, metavar="COUNT", help="train so many Gaussians, draw nothing")
    parser.add_argument("--steps", type=int, default=20_000, help="of training Gaussians (%(default)s)")
    parser.add_argument("--gaussians", type=Path, required=True, help="folder of the trained Gaussians")
    parser.add_argument("--bundles", nargs="*", type=Path, default=[], help="baked scenes of the same capture")
    parser.add_argument("--times", nargs="+", type=int, default=[1, 2], help="sizes, of the photographs' (%(default)s)")
    parser.add_argument("--cameras", type=int, default=6, help="held-out cameras that are timed (%(default)s)")
    parser.add_argument("--runs", type=int, default=50, help="frames per camera (%(default)s)")
    parser.add_argument("--output", type=Path, help="also write the Markdown to this file, anew after each row")
    arguments = parser.parse_args()
    if not torch.cuda.is_available():
        parser.error("no CUDA device was found (or torch is a CPU build)")
    device, times = torch.device("cuda"), arguments.times
    capture = load_capture(arguments.data.expanduser())
    gsplat, why = load()
    if arguments.train:
        arguments.gaussians.mkdir(parents=True, exist_ok=True)
        for most in arguments.train:
            trained = Gaussians(gsplat, capture, most, arguments.steps, device)
            torch.save((trained.finished(), trained.seconds), arguments.gaussians / f"{most}.pt")
            say(f"{most:,} Gaussians, {arguments.steps:,} steps: {trained.seconds:.0f} s")
        return 0
    every = max(1, len(capture.held_out) // arguments.cameras)
    cameras = [view.camera.to(device) for view in capture.held_out[::every][: arguments.cameras]]
    options = Options(device, 5, arguments.runs)
    rows: list[Row] = []
    notes = [f"Device: {torch.cuda.get_device_name(device)}.", *filter(None, [why])]

    def write(silent: bool = True) -> None:
        text = page(f"Equal quality: {arguments.data.name}", report(rows, capture, times), notes)
        publish(text, arguments.output, silent=silent)

    for folder in arguments.bundles:
        bundle = read_bundle(folder, decode=False)
        scene = bundle.scene.to(device)
        good = quality(lambda camera, scene=scene: packed_picture(scene, camera), capture.held_out, device)
        frames = {k: measured(scene, [camera.scaled(k) for camera in cameras], options)["packed"] for k in times}
        say(f"{folder.name}: {good[0]:.2f} dB, {frames}")
        rows.append(Row(folder.name, len(bundle), None, good, frames))
        write()
    for file in sorted(arguments.gaussians.glob("*.pt")) if gsplat is not None else []:
        g, seconds = torch.load(file, map_location=device, weights_only=True)
        for name, renderer in {"rasterization": rasterized, "inference renderer": inferred}.items():

            def drawn(name: str = name, make: Callable = renderer, g: dict = g, s: float = seconds) -> Row:
                return row(f"gsplat {name}", len(g["means"]), s, make(gsplat, g), capture, cameras, times, options)

            if found := attempt(f"{name}, {file.stem}", drawn):
                rows.append(found)
            write()
    write(silent=False)
    return 0


if __name__ == "__main__":
    sys.exit(main())
