"""Compare each CPU kernel with the machine's ceilings, on a scene like a trained one (`scenes.trained_like`).

The baked scene has a uint8 atlas with a tile per surfel, at one texel per pixel. Kernels are called through
`bitymi_ns.ops`, as in training and rendering; median of --runs after two warm-up runs.

Operations: additions, multiplications, comparisons, minima, roots and divisions count 1, exp and log 10, integers 0.
Only operations that the formulas need are counted, not unused lanes of SIMD blocks. Bytes: streamed arrays count once;
gathered rows, table entries and texels count every time, cached or not; per-tile buffers count once per pixel. Loads:
gathered table entries (16 bytes) and texels (4 bytes).

The formulas are in `cases`, with n surfels (v visible), p pixels, f fragments (t textured, with at least the scene's
weight bound), b pairs of surfel and tile (r with a fragment), K sites, L levels:

- trace: fragments are written, then sorted; the backward pass reads a row of geom and 14 sums per pair.
- field: 88 L for cell, weights and interpolation, then an MLP of 4 L x 16 x 16 x 3; the backward pass looks up again,
  and half of its loads are read-modify-write; 128 L are indices and weights, written and read; 64 MB of gradient.
- blend, texels: neighbouring texels are gathered from the cache, so their loads are not counted.
"""

import math
import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # read when torch loads OpenMP

import torch
from harness import Arguments, Options, number, publish, say, seconds, table
from scenes import LOG2_TABLE, SITES, textured, trained_like
from torch import Tensor

from bitymi_ns import ops
from bitymi_ns.ops.constants import SUPPORT
from bitymi_ns.ops.trace_cpu import tracers

CPU = torch.device("cpu")
WARM_UP = 2
LEVELS = 4
TILE_SIDE = 8
HEADER = (
    "kernel", "limit", "ms", "CPU ms", "Mop", "MB", "M loads", "GFLOP/s", "GB/s", "M loads/s", "of arithmetic",
    "of bandwidth", "of loads",
)  # fmt: skip
Case = tuple[str, Callable[[], object], float, float, float]  # kernel, call, operations, bytes and loads


def back(outputs: Tensor, inputs: Sequence[Tensor]) -> Callable[[], object]:
    """Prepare a backward pass on a retained graph, with fixed random gradients."""
    gradients = torch.randn_like(outputs)
    return lambda: torch.autograd.grad(outputs, inputs, gradients, retain_graph=True)


def pairs(projection: ops.Projection) -> int:
    """Count the pairs of surfel and tile that the tracer visits."""
    geom = projection.geom.detach()
    with tracers(geom).borrow() as tracer:
        tracer.run(**projection.view(geom), most=1)
        return tracer.pairs


def cases(n: int, width: int, height: int) -> tuple[str, list[Case]]:
    """Describe a scene's counts, and list its kernels with their work; backward passes run on a retained graph."""
    scene, camera = trained_like(n, width, height, CPU)
    baked, _ = textured(n, width, height, CPU)
    q, field, bound = scene.surfels, scene.field, scene.config.weight_bound
    assert field is not None
    geometry = (q["means"], q["quats"], q["log_scales"], q["opacity_logits"], q["beta_raw"])

    def project() -> ops.Projection:
        return ops.project(*geometry, camera, scene.near)

    projection = project()
    fragments = ops.trace(projection, scene.config.rim)
    base = scene.base_color(projection)
    leaf = base.detach().requires_grad_()  # leaves, so that each backward pass runs one kernel
    frames = projection.frames.detach()

    def residual(weights: tuple[Tensor, ...]) -> Tensor:
        return ops.fragment_residual(fragments, frames, field.geometry, weights, bound)

    weights = field.weights
    fixed = tuple(w.detach() for w in weights)
    listed = residual(fixed).requires_grad_()
    geom = projection.geom.detach().requires_grad_()
    at = replace(projection, geom=geom)
    weight, uv = (values.detach().requires_grad_() for values in (fragments.weight, fragments.uv))
    alone = replace(fragments, weight=weight, uv=uv, depth=fragments.depth.detach())
    photo, other = (torch.rand(height, width, 3) for _ in range(2))
    other.requires_grad_()
    side = torch.full((n, 2), TILE_SIDE, dtype=torch.int32)
    tiles = ops.TexelTiles.of_sizes(side, projection.geom.new_full((n,), SUPPORT))
    texels = (torch.rand(tiles.count, 3) - 0.5).requires_grad_()

    def blend(*textures: Any, residual: Tensor | None = None) -> Tensor:
        return ops.blended_image(alone, at, leaf, *textures, bound=bound, residual=residual)

    view = tuple(q[name] for name in ops.VIEW_COLORS["sv"].names)
    K, L = SITES, LEVELS
    v, p, f = int(projection.visible.sum()), width * height, len(fragments)
    t, b = int((fragments.weight >= bound).sum()), pairs(projection)
    r = int(torch.unique_consecutive(fragments.surfel).numel())
    look_up = 32 + 88 * L + 2 * 16 * (4 * L + 16 + 3) + 32
    learning = look_up + 96 + 80 + 4 * 16 * (4 * L + 16) + 64 * L
    table_bytes = L * 16 * (1 << LOG2_TABLE)
    rows = 80 * v + v * math.log2(max(2, v)) + 30 * b
    ops_project, ops_view, bytes_project, bytes_view = 300 * n, (17 + 45 * K) * v, 152 * n, (28 * K + 25) * v
    counts = (
        f"{v:,} visible, {f:,} fragments ({f / p:.1f} per pixel), {100 * t / f:.0f} % of them textured, {b:,} pairs of "
        f"surfel and tile ({r:,} with a fragment)"
    )
    without_graph = torch.no_grad()
    return counts, [
        ("project", without_graph(project), ops_project, bytes_project, 0),
        ("project backward", back(projection.geom, geometry), 350 * n, 260 * n, 0),
        ("view colour", without_graph(lambda: scene.base_color(projection)), ops_view, bytes_view, 0),
        ("view colour backward", back(base, (q["means"], *view)), (25 + 75 * K) * v, (56 * K + 40) * v, 0),
        (
            "trace", without_graph(lambda: ops.trace(projection, scene.config.rim)),
            65 * f + rows, 60 * f + 72 * b + 16 * v, 0,
        ),
        ("trace backward", back(fragments.weight, (projection.geom,)), 140 * f, 20 * f + 176 * (r + n), 0),
        ("field", without_graph(lambda: residual(fixed)), look_up * t, 12 * f + (56 + 128 * L) * t, 8 * L * t),
        (
            "field backward", back(residual(weights), weights),
            learning * t, 12 * f + (184 + 512 * L) * t + table_bytes, 16 * L * t,
        ),
        ("blend", without_graph(blend), 15 * f, 5 * f + 40 * p, 0),
        ("blend backward", back(blend(), (weight, geom, leaf)), 20 * f, 9 * f + 20 * p + 108 * n, 0),
        ("blend, field", without_graph(lambda: blend(residual=listed)), 18 * f, 17 * f + 40 * p, 0),
        (
            "blend backward, field", back(blend(residual=listed), (weight, geom, leaf, listed)),
            23 * f, 33 * f + 20 * p + 108 * n, 0,
        ),
        ("blend, texels", without_graph(lambda: blend(texels, tiles)), 15 * f + 45 * t, 5 * f + 56 * t + 40 * p, 0),
        (
            "blend backward, texels", back(blend(texels, tiles), (weight, uv, geom, leaf, texels)),
            20 * f + 110 * t, 17 * f + 104 * t + 20 * p + 108 * n, 0,
        ),
        ("ssim forward + backward", lambda: torch.autograd.grad(ops.ssim(other, photo), other), 1233 * p, 264 * p, 0),
        (
            "baked render, uint8 atlas", lambda: baked.render(camera),
            ops_project + ops_view + 75 * f + rows + 70 * t,
            bytes_project + bytes_view + 84 * b + 16 * v + 16 * t + 20 * p, 4 * t,
        ),
    ]  # fmt: skip


def main(parser: Arguments, words: Sequence[str]) -> None:
    """Time the kernels and publish a table per scene."""
    parser.add_argument("--surfels", nargs="+", type=int, default=[5_000, 20_000], help="sizes of the scene")
    parser.add_argument("--width", type=int, default=270)
    parser.add_argument("--height", type=int, default=480)
    parser.add_argument("--runs", type=int, default=9, help="timed runs a kernel (%(default)s)")
    parser.add_argument("--gflops", type=float, default=546.0, help="fp32 FMA ceiling, GFLOP/s (%(default)s)")
    parser.add_argument("--gbytes", type=float, default=77.0, help="memory triad, GB/s (%(default)s)")
    parser.add_argument("--mloads", type=float, default=2050.0, help="random loads in 8 MiB, M/s (%(default)s)")
    parser.add_output()
    options = parser.parse_args(words)
    ceilings = (options.gflops * 1e9, options.gbytes * 1e9, options.mloads * 1e6)
    parts, load = [], os.getloadavg()[0]
    for n in options.surfels:
        counts, kernels = cases(n, options.width, options.height)
        rows = []
        for name, run, *work in kernels:
            wall, cpu = seconds(run, Options(CPU, WARM_UP, options.runs))
            say(f"{n:,} surfels, {name}: {1e3 * wall:.2f} ms")
            rates = [amount / wall for amount in work]
            shares = [rate / ceiling for rate, ceiling in zip(rates, ceilings, strict=True)]
            limit = ("arithmetic", "bandwidth", "loads")[shares.index(max(shares))]
            row = [name, limit, number(1e3 * wall), number(1e3 * cpu), *(number(a / 1e6, 1) for a in work)]
            row += [number(rates[0] / 1e9, 1), number(rates[1] / 1e9, 1), number(rates[2] / 1e6, 0)]
            row += [f"{100 * share:.0f} %" for share in shares]
            if not work[2]:
                row[6] = row[9] = row[12] = ""
            rows.append(row)
        title = f"### {n:,} surfels at {options.width} x {options.height}\n\n{counts}\n"
        parts.append(title + "\n" + table(HEADER, rows, (0, 1)))
    notes = [
        f"Ceilings: {options.gflops:,.0f} GFLOP/s, {options.gbytes:,.0f} GB/s, {options.mloads:,.0f} M random loads/s, "
        f"of all cores (--gflops, --gbytes, --mloads); median of {options.runs} runs; {torch.get_num_threads()} "
        "threads. Limit: the ceiling of which the kernel reaches the largest share.",
        f"Load average at the start: {load:.1f}. Other work on the machine spoils ms and shares, CPU ms hardly.",
        "Operations and bytes are counted by the formulas of this script.",
    ]
    publish("CPU kernels", "\n\n".join(parts), notes, options.output)
