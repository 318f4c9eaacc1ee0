"""Compare bundles with gsplat at equal quality on a GPU: train Gaussians, in several numbers, on the same photographs
with gsplat's MCMC strategy, and render both at the held-out cameras: PSNR and ms per frame.

Bundles are those of `long.py --keep`. `--train` trains the Gaussians first, from the same points, with the learning
rates of gsplat's example and the strategy's regularisation."""

import importlib
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from statistics import fmean
from typing import Any

import torch
from harness import Arguments, Options, Rows, device_milliseconds, means, number, publish, say
from scenes import SplitCapture, load_capture
from torch import Tensor
from torch.nn.functional import normalize

from bitymi_ns import ops
from bitymi_ns.bundle import read_bundle
from bitymi_ns.ops.constants import SH_C0
from bitymi_ns.ops.parameters import Tensors
from bitymi_ns.scene.baked import BakedScene
from bitymi_ns.scene.baked_renderer import BakedRenderer
from bitymi_ns.scene.camera import Camera
from bitymi_ns.train.init import neighbour_distance, scene_extent
from bitymi_ns.train.losses import fitted_psnr, photometric, psnr
from bitymi_ns.train.views import training_order

RATES = {"means": 1.6e-4, "scales": 5e-3, "opacities": 5e-2, "quats": 1e-3, "sh0": 2.5e-3, "shN": 2.5e-3 / 20}

CAMERAS = 6  # held-out cameras to time
RUNS = 50  # frames per camera
SIZES = (1, 2)  # multiples of the photographs' size to time
Frames = Callable[[Camera], Callable[[], Tensor]]
"""Camera -> function that renders its view: [H, W, 3], or [H, W, 1] int32 with 8 bits per channel."""


def packed(scene: BakedScene) -> Frames:
    """Render a bundle as a CUDA graph, with 8 bits per channel."""

    def make(camera: Camera) -> Callable[[], Tensor]:
        renderer = BakedRenderer(scene, camera.width, camera.height, images=("packed",), graph=True)
        images = renderer.draw([camera])

        def run() -> Tensor:
            renderer.run()
            return images["packed"][0]

        return run

    return make


def rasterized(gsplat: Any, g: dict[str, Tensor]) -> Frames:
    """Render Gaussians as in `activated` with gsplat's rasterization."""

    def make(camera: Camera) -> Callable[[], Tensor]:
        view = (camera.viewmat[None], camera.K[None], camera.width, camera.height)
        return torch.no_grad()(lambda: gsplat.rasterization(*g.values(), *view, sh_degree=3, packed=False)[0][0])

    return make


def inferred(g: dict[str, Tensor]) -> Frames:
    """Render Gaussians with gsplat's inference renderer, converted to half precision beforehand."""
    experimental = importlib.import_module("gsplat.experimental")  # which the gsplat of nerfstudio lacks

    scene = experimental.GaussianInferenceScene.from_gaussian_tensors(
        *g.values(), sh_degree=3, sh_compression="none", id=f"none{len(g['means'])}"
    )
    renderer = experimental.GaussianInferenceRenderer(scene)

    def make(camera: Camera) -> Callable[[], Tensor]:
        view = {"viewmat": camera.viewmat, "K": camera.K, "width": camera.width, "height": camera.height}
        return torch.inference_mode()(lambda: renderer.render(**view).frame[0, ..., :3])

    return make


def first_gaussians(capture: SplitCapture, most: int, extent: float) -> dict[str, Tensor]:
    """Initialise means, scales (logarithms), quats, opacities (logits), sh0 [N, 1, 3], shN [N, 15, 3] from points."""
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


def activated(p: Tensors) -> dict[str, Tensor]:
    """Compute means, quats (unit), scales, opacities, sh [N, 16, 3] from parameters as in `first_gaussians`."""
    return {
        "means": p["means"],
        "quats": normalize(p["quats"], dim=-1),
        "scales": p["scales"].exp(),
        "opacities": p["opacities"].sigmoid(),
        "sh": torch.cat([p["sh0"], p["shN"]], 1),
    }


def train(
    gsplat: Any, capture: SplitCapture, most: int, steps: int, device: torch.device
) -> tuple[dict[str, Tensor], float]:
    """Train Gaussians on a capture with gsplat's MCMC strategy, which refines in the first 25/30 of the steps. `most`:
    maximum number of Gaussians. Returns the Gaussians, as in `activated`, and seconds of training."""
    extent = scene_extent(torch.stack([view.camera.center for view in capture.train]), capture.points)
    parameters = torch.nn.ParameterDict(
        {name: torch.nn.Parameter(value.to(device)) for name, value in first_gaussians(capture, most, extent).items()}
    )
    rates = {**RATES, "means": RATES["means"] * extent}
    optimizers = {
        name: torch.optim.Adam([{"params": value, "lr": rates[name], "name": name}], eps=1e-15, fused=True)
        for name, value in parameters.items()
    }
    refine = {"refine_start_iter": min(500, steps // 10), "refine_stop_iter": steps * 25 // 30}
    strategy = gsplat.MCMCStrategy(cap_max=most, **refine)
    strategy.check_sanity(parameters, optimizers)
    state = strategy.initialize_state()
    falling = torch.optim.lr_scheduler.ExponentialLR(optimizers["means"], gamma=0.01 ** (1 / steps))
    views = [view.to(device) for view in capture.train]
    torch.cuda.synchronize(device)
    start = time.perf_counter()
    for step in range(steps):
        view = views[training_order(len(views), 0, step)]
        at = (view.camera.viewmat[None], view.camera.K[None], view.camera.width, view.camera.height)
        degree = min(3, step // max(1, min(1000, steps // 10)))
        rgb, _, information = gsplat.rasterization(*activated(parameters).values(), *at, sh_degree=degree, packed=False)
        loss = photometric(rgb[0], view.target(None, device), 0.2)
        loss = loss + 0.01 * torch.sigmoid(parameters["opacities"]).mean()
        loss = loss + 0.01 * torch.exp(parameters["scales"]).mean()
        loss.backward()
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        falling.step()
        rate = falling.get_last_lr()[0]
        strategy.step_post_backward(parameters, optimizers, state, step, information, lr=rate)
    torch.cuda.synchronize(device)
    seconds = time.perf_counter() - start
    return {name: value.detach().contiguous() for name, value in activated(parameters).items()}, seconds


def row(
    name: str, count: int, took: float | None, draws: Callable[[], Frames], capture: SplitCapture, device: torch.device
) -> list[str]:
    """Measure the row of a renderer: primitives, seconds of training (None: not trained here), quality on the held-out
    views, and median milliseconds of a frame, averaged over cameras, by image size."""
    make, qualities = draws(), []
    for view in (view.to(device) for view in capture.held_out):
        image = make(view.camera)()
        rgb = image if image.is_floating_point() else image.view(torch.uint8)[..., :3] / 255
        rgb, target = rgb.float().clamp(0.0, 1.0), view.target(None, device)
        psnrs = {"psnr": psnr(rgb, target, view.mask), "fitted_psnr": fitted_psnr(rgb, target, view.mask)}
        qualities.append(psnrs | {"ssim": float(ops.ssim(rgb, target))})
    good, every = means(qualities), max(1, len(capture.held_out) // CAMERAS)
    cameras = [view.camera.to(device) for view in capture.held_out[::every][:CAMERAS]]
    options = Options(device, 5, RUNS)
    frames = [fmean(device_milliseconds(make(camera.scaled(k)), options) for camera in cameras) for k in SIZES]
    say(f"{name}, {count:,}: {good['psnr']:.2f} dB, {', '.join(f'{ms:.3f} ms' for ms in frames)}")
    cells = [name, number(count, 0), number(took, 0), number(good["psnr"]), number(good["fitted_psnr"])]
    return [*cells, number(good["ssim"], 3), *(number(ms, 3) for ms in frames)]


def main(parser: Arguments, words: Sequence[str]) -> None:
    """Train Gaussians, or measure all renderers and publish the table."""
    parser.add_argument("data", type=Path, help="folder of an undistorted capture with transforms.json")
    parser.add_argument("--train", nargs="+", type=int, metavar="COUNT", help="train so many Gaussians, draw nothing")
    parser.add_argument("--steps", type=int, default=20_000, help="of training Gaussians (%(default)s)")
    parser.add_argument("--gaussians", type=Path, required=True, help="folder of the trained Gaussians")
    parser.add_argument("--bundles", nargs="*", type=Path, default=[], help="baked scenes of the same capture")
    parser.add_output()
    arguments = parser.parse_args(words)
    device = parser.device()
    capture = load_capture(arguments.data.expanduser())
    try:
        import gsplat
        import gsplat.cuda._backend  # compiles the kernels if needed
    except (ImportError, RuntimeError, OSError) as error:
        parser.error(f"gsplat cannot be used here: {error}")
    if arguments.train:
        arguments.gaussians.mkdir(parents=True, exist_ok=True)
        for most in arguments.train:
            trained = train(gsplat, capture, most, arguments.steps, device)
            torch.save(trained, arguments.gaussians / f"{most}.pt")
            say(f"{most:,} Gaussians, {arguments.steps:,} steps: {trained[1]:.0f} s")
        return
    camera = capture.held_out[0].camera
    header = ("what draws", "primitives", "training s", "PSNR dB", "after affine fit", "SSIM")
    rows = Rows((*header, *(f"ms at {k * camera.width} x {k * camera.height}" for k in SIZES)))
    made: list[tuple[str, int, float | None, Callable[[], Frames]]] = []
    for folder in arguments.bundles:
        bundle = read_bundle(folder, decode=False)
        made.append((folder.name, len(bundle), None, partial(packed, bundle.scene.to(device))))
    for file in sorted(arguments.gaussians.glob("*.pt")):
        g, seconds = torch.load(file, map_location=device, weights_only=True)
        count = len(g["means"])
        made.append(("gsplat rasterization", count, seconds, partial(rasterized, gsplat, g)))
        made.append(("gsplat inference renderer", count, seconds, partial(inferred, g)))
    about = f"{len(capture.train)} photographs of {camera.width} x {camera.height}; {len(capture.held_out)} held out."
    for name, count, took, make in made:
        rows.add(f"{name}, {count:,}", partial(row, name, count, took, make, capture, device))
        title, notes = f"Equal quality: {arguments.data.name}", [f"Device: {torch.cuda.get_device_name(device)}."]
        publish(title, f"{about}\n\n{rows}", notes, arguments.output)
