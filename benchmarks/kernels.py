"""Time each CPU kernel on a scene like a trained one (`scenes.trained_like`), through `bitymi_ns.ops` as in training
and rendering: medians after two warm-up runs. The baked scene has a uint8 atlas, a tile per surfel, a texel per
pixel."""

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # read when torch loads OpenMP

import torch
from harness import Arguments, Options, image_size, number, publish, say, seconds, table
from scenes import textured, trained_like
from torch import Tensor

from bitymi_ns import ops
from bitymi_ns.ops.constants import SUPPORT
from bitymi_ns.ops.project import geometry_of

CPU = torch.device("cpu")
WARM_UP = 2
TILE_SIDE = 8


def back(outputs: Tensor, inputs: Sequence[Tensor]) -> Callable[[], object]:
    """Prepare a backward pass on a retained graph, with fixed random gradients."""
    gradients = torch.randn_like(outputs)
    return lambda: torch.autograd.grad(outputs, inputs, gradients, retain_graph=True)


def cases(n: int, width: int, height: int) -> tuple[str, dict[str, Callable[[], object]]]:
    """Describe a scene's counts, and prepare its kernels by name; backward passes run on a retained graph."""
    scene, camera = trained_like(n, width, height, CPU)
    baked, _ = textured(n, width, height, CPU)
    q, field, bound = scene.surfels, scene.field, scene.config.weight_bound
    assert field is not None
    geometry = geometry_of(q)
    project = partial(ops.project, *geometry, camera, scene.near)
    projection = project()
    fragments = ops.trace(projection, scene.config.rim)
    base = scene.base_color(projection)
    leaf = base.detach().requires_grad_()  # leaves, so that each backward pass runs one kernel
    residual = partial(ops.fragment_residual, fragments, projection.frames.detach(), field.geometry)
    fixed = tuple(w.detach() for w in field.weights)
    listed = residual(fixed, bound).requires_grad_()
    geom = projection.geom.detach().requires_grad_()
    weight, uv = (values.detach().requires_grad_() for values in (fragments.weight, fragments.uv))
    alone = replace(fragments, weight=weight, uv=uv, depth=fragments.depth.detach())
    blend = partial(ops.blended_image, alone, replace(projection, geom=geom), leaf, bound=bound)
    side = torch.full((n, 2), TILE_SIDE, dtype=torch.int32)
    tiles = ops.TexelTiles.of_sizes(side, projection.geom.new_full((n,), SUPPORT))
    texels = (torch.rand(tiles.count, 3) - 0.5).requires_grad_()
    photo, other = (torch.rand(height, width, 3) for _ in range(2))
    other.requires_grad_()
    view = tuple(q[name] for name in ops.VIEW_COLORS["sv"].names)
    textured_share = float((fragments.weight >= bound).float().mean())
    counts = (
        f"{int(projection.visible.sum()):,} visible, {len(fragments):,} fragments "
        f"({len(fragments) / (width * height):.1f} per pixel), {100 * textured_share:.0f} % of them textured"
    )
    forward = {
        "project": project,
        "view colour": partial(scene.base_color, projection),
        "trace": partial(ops.trace, projection, scene.config.rim),
        "field": partial(residual, fixed, bound),
        "blend": blend,
        "blend, field": partial(blend, residual=listed),
        "blend, texels": partial(blend, texels, tiles),
        "baked render, uint8 atlas": partial(baked.render, camera),
    }
    backward = {
        "project backward": back(projection.geom, geometry),
        "view colour backward": back(base, (q["means"], *view)),
        "trace backward": back(fragments.weight, (projection.geom,)),
        "field backward": back(residual(field.weights, bound), field.weights),
        "blend backward": back(blend(), (weight, geom, leaf)),
        "blend backward, field": back(blend(residual=listed), (weight, geom, leaf, listed)),
        "blend backward, texels": back(blend(texels, tiles), (weight, uv, geom, leaf, texels)),
        "ssim forward + backward": lambda: torch.autograd.grad(ops.ssim(other, photo), other),
    }
    return counts, {name: torch.no_grad()(run) for name, run in forward.items()} | backward


def main(parser: Arguments, words: Sequence[str]) -> None:
    """Time the kernels and publish a table per scene."""
    parser.add_argument("--surfels", nargs="+", type=int, default=[5_000, 20_000], help="sizes of the scene")
    parser.add_argument("--size", type=image_size, default="270x480", metavar="WxH", help="(%(default)s)")
    parser.add_argument("--runs", type=int, default=9, help="timed runs a kernel (%(default)s)")
    parser.add_output()
    options = parser.parse_args(words)
    parts, load = [], os.getloadavg()[0]
    for n in options.surfels:
        counts, kernels = cases(n, *options.size)
        rows = []
        for name, run in kernels.items():
            wall, cpu = seconds(run, Options(CPU, WARM_UP, options.runs))
            say(f"{n:,} surfels, {name}: {1e3 * wall:.2f} ms")
            rows.append([name, number(1e3 * wall), number(1e3 * cpu)])
        title = f"### {n:,} surfels at {options.size[0]} x {options.size[1]}\n\n{counts}\n"
        parts.append(title + "\n" + table(("kernel", "ms", "CPU ms"), rows))
    notes = [
        f"Median of {options.runs} runs; {torch.get_num_threads()} threads. Load average at the start: {load:.1f}: "
        "other work on the machine spoils ms, CPU ms hardly."
    ]
    publish("CPU kernels", "\n\n".join(parts), notes, options.output)
