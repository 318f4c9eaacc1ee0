"""Helpers of the kernel benchmarks: timing on the device, scenes like trained ones."""

import math
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import torch
from common import say
from torch import Tensor
from torch.nn.functional import l1_loss

from bitymi_ns import ops
from bitymi_ns.bundle import Bundle
from bitymi_ns.codec.packing import pack
from bitymi_ns.scene.baked import BakedScene
from bitymi_ns.scene.camera import Camera
from bitymi_ns.scene.config import SceneConfig
from bitymi_ns.scene.field import HashField
from bitymi_ns.scene.scene import Scene
from bitymi_ns.train.config import TexelConfig
from bitymi_ns.train.losses import fitted_psnr, psnr
from bitymi_ns.train.texels import blank_texels
from bitymi_ns.train.views import View

SITES = 7
LOG2_TABLE = 17
FAILURES: list[str] = []
T = TypeVar("T")
CROSSING = 0.016  # share of the surfels that cross the camera's plane out of view
PIXEL_SCALE = 0.9  # median scale of a surfel, relative to the side of its share of the image
CLOCK = 2.0e9  # upper bound of GPU clocks, Hz, to convert seconds to cycles of `torch.cuda._sleep`


@dataclass(frozen=True)
class Options:
    """Settings of a benchmark."""

    device: torch.device  # of the kernels; CPU: their emulation, to try a script without a GPU
    warm_up: int  # untimed runs of each timing
    runs: int  # timed runs


def attempt(what: str, run: Callable[[], T]) -> T | None:
    """Run a part of a section; on failure append to FAILURES and return None."""
    try:
        return run()
    except (RuntimeError, ValueError, TypeError, AttributeError, OSError) as error:
        text = f"{what}: {type(error).__name__}: {' '.join(str(error).split())[:400]}"
        say(text)
        FAILURES.append(text)
        return None


def failures() -> str:
    """List the failed parts in Markdown."""
    return "".join(f"\n\n- Failed: {text}" for text in FAILURES)


def milliseconds(run: Callable[[], object], options: Options) -> float:
    """Measure the median device time of a call. Calls are queued behind a spin of the device that outlasts the
    queueing, so that launches are not measured. Synchronisations within a call are included."""
    for _ in range(options.warm_up):
        run()
    if options.device.type != "cuda":
        return 1e3 * statistics.median(_seconds(run) for _ in range(options.runs))
    torch.cuda.synchronize()
    host = _seconds(run)
    torch.cuda.synchronize()
    calls = max(1, min(16, options.runs, round(2e-3 / max(host, 1e-6))))
    samples = max(5, math.ceil(options.runs / calls))
    spin = int(min(0.02, 2.0 * calls * host + 1e-4) * CLOCK)
    times = []
    for _ in range(samples):
        start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        torch.cuda._sleep(spin)
        start.record()
        for _ in range(calls):
            run()
        end.record()
        torch.cuda.synchronize()
        times.append(start.elapsed_time(end) / calls)
    return statistics.median(times)


def with_launches(run: Callable[[], object], options: Options) -> float:
    """Measure the median milliseconds of a call followed by a synchronisation."""
    for _ in range(options.warm_up):
        run()

    def complete() -> None:
        run()
        if options.device.type == "cuda":
            torch.cuda.synchronize()

    return 1e3 * statistics.median(_seconds(complete) for _ in range(options.runs))


def _seconds(run: Callable[[], object]) -> float:
    start = time.perf_counter()
    run()
    return time.perf_counter() - start


def quality(
    draw: Callable[[Camera], Tensor], views: Sequence[View], device: torch.device, background: Tensor | None = None
) -> tuple[float, ...]:
    """Average PSNR, PSNR after an affine fit of colours, and SSIM over held-out views.

    Args:
        draw: renders the image [H, W, 3] of a camera.
        background: [3] colour behind photographs with alpha; None: black.
    """
    values = []
    for view in (view.to(device) for view in views):
        rgb, target = draw(view.camera).float().clamp(0, 1), view.target(background, device)
        values.append((psnr(rgb, target, view.mask), fitted_psnr(rgb, target, view.mask), float(ops.ssim(rgb, target))))
    return tuple(statistics.fmean(column) for column in zip(*values, strict=True))


def backward(outputs: Tensor | Sequence[Tensor], inputs: Sequence[Tensor]) -> Callable[[], object]:
    """Prepare a backward pass on a retained graph, with fixed random gradients."""
    outputs = [outputs] if isinstance(outputs, Tensor) else list(outputs)
    gradients = [torch.randn_like(output) for output in outputs]
    return lambda: torch.autograd.grad(outputs, inputs, gradients, retain_graph=True)


def without_graph(run: Callable[[], object]) -> Callable[[], object]:
    """Wrap a call in `torch.no_grad`."""

    def call() -> object:
        with torch.no_grad():
            return run()

    return call


def photo_loss(photo: Tensor) -> Callable[[Tensor], Tensor]:
    """Create the loss 0.8 L1 + 0.2 (1 - SSIM) against an image [height, width, 3]."""
    return lambda rgb: 0.8 * l1_loss(rgb, photo) + 0.2 * (1 - ops.ssim(rgb, photo))


def training_step(
    render: Callable[[], Tensor], loss: Callable[[Tensor], Tensor], parameters: list[Tensor]
) -> Callable[[], object]:
    """Prepare a training step: render, loss, backward and Adam on the parameters."""
    # learning rate 0: the work of a step without changing the scene
    optimizer = torch.optim.Adam(parameters, lr=0.0, fused=True)

    def run() -> None:
        optimizer.zero_grad(set_to_none=True)
        loss(render()).backward()
        optimizer.step()

    return run


def trained_like(n: int, width: int, height: int, device: torch.device, texture: bool = True) -> tuple[Scene, Camera]:
    """Generate a scene with the statistics of trained ones, and its camera, deterministically.

    Fitted to scenes of 17,000 to 22,000 surfels after 1,200 steps on three captures: ln(s_u / s_v) is normal with
    standard deviation 0.85, the mean log scale in pixels has 0.7, opacity and kernel exponent are logistic-normal
    (medians 0.45 and 2.4); about 23 fragments are blended per pixel for any n. A fifth of the surfels lies outside the
    view; a share `CROSSING` are discs beside the camera that cross its plane.
    """
    g = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=g)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=g)

    focal = 0.9 * width
    K = torch.tensor([[focal, 0.0, 0.5 * width], [0.0, focal, 0.5 * height], [0.0, 0.0, 1.0]])
    z = 2.0 * torch.exp(1.4 * uniform(n))  # 2 to 8
    margin = 0.5 * (math.sqrt(1.25) - 1)
    x, y = ((uniform(n) * (1 + 2 * margin) - margin) * size for size in (width, height))
    means = torch.stack([(x - K[0, 2]) / focal * z, (y - K[1, 2]) / focal * z, z], dim=-1)
    pixels = PIXEL_SCALE * math.sqrt(width * height / n)
    size = torch.log(pixels * z / focal) + 0.7 * normal(n)
    aspect = 0.425 * normal(n)
    surfels = {
        "means": means,
        "quats": normal(n, 4),
        "log_scales": torch.stack([size + aspect, size - aspect], dim=-1),
        "opacity_logits": 1.3 * normal(n) - 0.2,
        "beta_raw": normal(n) + 0.45,
    }
    beside = n - round(CROSSING * n)
    _move_beside_the_camera({name: value[beside:] for name, value in surfels.items()}, g)
    surfels |= {"sv_sites": normal(n, SITES, 3), "sv_log_tau": torch.zeros(n, SITES)}
    surfels |= {"sv_rgb": uniform(n, SITES, 3) - 0.5}
    config = SceneConfig(view_color="sv", sv_sites=SITES, texture="hash" if texture else "none", near=0.2)
    field = None
    if texture:
        field = HashField(config, (0.0, 0.0, 5.0), 5.0, True, LOG2_TABLE, g)
        with torch.no_grad():
            field.field_w3.copy_(0.1 * normal(*field.field_w3.shape))  # starts at zero
    scene = Scene(config, surfels, field).to(device)
    return scene, Camera(torch.eye(4), K, width, height).to(device)


def _move_beside_the_camera(surfels: dict[str, Tensor], g: torch.Generator) -> None:
    """Move surfels in place so that they cross the camera's plane out of view.

    Statistics of a trained room of 12,900 surfels: median depth 0.09 times that of the others, 12 depths off the axis,
    larger scale 0.9 depths and three times the smaller.
    """
    n = len(surfels["means"])
    z = 0.35 * torch.exp(0.3 * torch.randn(n, generator=g)).clamp(min=0.75)  # behind `near`
    lateral = 12 * torch.exp(0.8 * torch.randn(n, generator=g)).clamp(min=0.25)
    turn = 2 * math.pi * torch.rand(n, generator=g)
    surfels["means"].copy_(z[:, None] * torch.stack([lateral * turn.cos(), lateral * turn.sin(), torch.ones(n)], dim=1))
    size = torch.log(0.9 * z) + 0.3 * torch.randn(n, generator=g)
    surfels["log_scales"].copy_(torch.stack([size, size - 1.1], dim=1))
    forward = torch.tensor([1.0, 0.0, -1.0, 0.0])  # turns the first axis to the camera's
    surfels["quats"].copy_(forward + 0.2 * torch.randn(n, 4, generator=g))


def with_texels(n: int, width: int, height: int, device: torch.device) -> tuple[Scene, Camera]:
    """Generate `trained_like` with a tile per surfel at the camera's resolution, and random texels that backward passes
    update at rate 0: the work of a step without changing them."""
    scene, camera = trained_like(n, width, height, device, texture=False)
    scene.config.texture = "texels"
    field = blank_texels(scene, [View(camera, torch.zeros(height, width, 3, device=device))], 1, TexelConfig())
    g = torch.Generator().manual_seed(1)
    with torch.no_grad():
        field.texels.copy_(0.1 * torch.randn(field.texels.shape, generator=g))
    field.descent = ops.TexelDescent(field.share, 0.0)
    scene.field = field
    return scene, camera


def textured(n: int, width: int, height: int, device: torch.device) -> tuple[BakedScene, Camera]:
    """Generate `trained_like` with an atlas of random texels, one per pixel: BC7 on a GPU, else uint8."""
    scene, camera = trained_like(n, width, height, torch.device("cpu"), texture=False)
    surfels = {name: value.detach().contiguous() for name, value in scene.surfels.items()}
    pixels = 6 * surfels["log_scales"].exp() * camera.K[0, 0] / surfels["means"][:, 2:]
    packing = pack(torch.exp2(torch.log2(pixels).ceil()).clamp(4, 64).long().numpy())
    g = torch.Generator().manual_seed(1)
    atlas = blocks = None
    if device.type == "cuda":
        blocks = torch.randint(
            0, 256, (packing.layers, packing.height // 4, packing.width // 4, 16), dtype=torch.uint8, generator=g
        )
        blocks[..., 0] = 0x40  # mode 6: any other bits are a valid block
    else:
        shape = (packing.layers, packing.height, packing.width, 4)
        atlas = torch.randint(0, 256, shape, dtype=torch.uint8, generator=g)
    baked = BakedScene(
        surfels,
        "sv",
        torch.from_numpy(packing.tiles).contiguous(),
        atlas,
        offset=-0.2,
        scale=0.4,
        weight_bound=scene.config.weight_bound,
        blocks=blocks,
    )
    return baked.to(device), camera


def around(bundle: Bundle, width: int, height: int) -> list[Camera]:
    """Build three cameras around the centre of a bundle, at the scale of training (cameras in the unit ball)."""
    middle = bundle.scene.surfels["means"].median(dim=0).values
    K = torch.tensor([[0.8 * width, 0, width / 2], [0, 0.8 * width, height / 2], [0, 0, 1]])
    cameras = []
    for angle in (0.0, 2.1, 4.2):
        eye = middle + 0.7 * torch.tensor([math.cos(angle), math.sin(angle), 0.3])
        forward = torch.nn.functional.normalize(middle - eye, dim=0)
        right = torch.nn.functional.normalize(torch.linalg.cross(forward, torch.tensor([0.0, 0.0, 1.0])), dim=0)
        viewmat = torch.eye(4)
        viewmat[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward])
        viewmat[:3, 3] = -viewmat[:3, :3] @ eye
        cameras.append(Camera(viewmat, K, width, height))
    return cameras
