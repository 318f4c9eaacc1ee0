"""Run each CUDA kernel once on a small scene, for sanitizers.

`--sections baked training` selects kernels; `--times RUNS` prints the device time by kernel.
"""

from collections.abc import Callable, Sequence
from functools import partial

import torch
from harness import Arguments, image_size, table
from scenes import textured, trained_like, with_texels
from torch.nn.functional import l1_loss

from bitymi_ns import ops
from bitymi_ns.scene.baked_renderer import BakedRenderer

Run = Callable[[], object]


def baked(n: int, width: int, height: int, device: torch.device, every: bool = False) -> Run:
    """Prepare a frame with a BC7 atlas; `every`: with all images."""
    scene, camera = textured(n, width, height, device)
    if every:
        return lambda: scene.render_views([camera], None, ops.baked.IMAGES)
    renderer = BakedRenderer(scene, width, height)
    renderer.draw([camera])
    return renderer.run


def training(n: int, width: int, height: int, device: torch.device, tiled: bool = False, most: int = 0) -> Run:
    """Prepare a training step: render, loss 0.8 L1 + 0.2 (1 - SSIM), backward and Adam, with the field, or with texels
    if `tiled`. `most`: limit of a fragment list, 0 = none."""
    scene, camera = (with_texels if tiled else trained_like)(n, width, height, device)
    scene.config.max_fragments = most
    # rates 0: the work of a step without changing the scene
    descent = ops.TexelDescent(scene.field.share, 0.0) if tiled else None
    optimizer = torch.optim.Adam((scene.surfels if tiled else scene).parameters(), lr=0.0, fused=True)
    photo = torch.rand(height, width, 3, device=device)

    def run() -> None:
        optimizer.zero_grad(set_to_none=True)
        rgb = scene.render(camera, descent=descent).rgb
        (0.8 * l1_loss(rgb, photo) + 0.2 * (1 - ops.ssim(rgb, photo))).backward()
        optimizer.step()

    return run


def exact(n: int, width: int, height: int, device: torch.device) -> Run:
    """Prepare a training step of either texture with deterministic sums."""
    steps = [training(n, width, height, device, tiled) for tiled in (False, True)]

    def run() -> None:
        torch.use_deterministic_algorithms(True, warn_only=True)  # some of torch's own operations have none
        for step in steps:
            step()
        torch.use_deterministic_algorithms(False)

    return run


SECTIONS = {"baked": baked, "images": partial(baked, every=True), "training": training}
SECTIONS |= {"texels": partial(training, tiled=True), "listed": partial(training, tiled=True, most=1 << 30)}
SECTIONS |= {"deterministic": exact}


def main(parser: Arguments, words: Sequence[str]) -> None:
    """Run or time the chosen kernels."""
    parser.add_argument("--surfels", type=int, default=300)
    parser.add_argument("--size", type=image_size, default="96x64", metavar="WxH", help="image size (%(default)s)")
    parser.add_argument("--sections", nargs="*", choices=list(SECTIONS), default=list(SECTIONS))
    parser.add_argument("--times", type=int, default=0, metavar="RUNS", help="time by kernel over so many runs")
    arguments = parser.parse_args(words)
    device = parser.device()
    for name in arguments.sections:
        run = SECTIONS[name](arguments.surfels, *arguments.size, device)
        if arguments.times:
            print_times(name, run, arguments.times)
        else:
            run()
            torch.cuda.synchronize()
            print(f"{name}: done", flush=True)


def print_times(name: str, run: Run, runs: int) -> None:
    """Print the device time per run of each kernel after a warm-up, longest first."""
    for _ in range(5):
        run()
    torch.cuda.synchronize()
    activities = [torch.profiler.ProfilerActivity.CPU, torch.profiler.ProfilerActivity.CUDA]
    with torch.profiler.profile(activities=activities) as profile:
        for _ in range(runs):
            run()
        torch.cuda.synchronize()
    kernels = [e for e in profile.key_averages() if e.device_type == torch.autograd.DeviceType.CUDA]
    total = sum(e.self_device_time_total for e in kernels) / runs
    print(f"\n#### {name}: {total:.0f} us on the device per run, {sum(e.count for e in kernels) / runs:.0f} kernels\n")
    longest = sorted(kernels, key=lambda e: -e.self_device_time_total)[:45]
    rows = [(f"`{e.key[:90]}`", f"{e.count / runs:.1f}", f"{e.self_device_time_total / runs:.1f}") for e in longest]
    print(table(("kernel", "per run", "us per run"), rows))
