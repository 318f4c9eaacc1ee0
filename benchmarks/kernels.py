#!/usr/bin/env python
"""How far each CPU kernel stands from the machine's ceilings, on a synthetic scene like a trained one.

The scene: surfels in a slab before the camera with random orientation, log-normal scales that shrink with the root of
their number, logistic-normal opacities, kernel exponents about 3.5 and random Spherical Voronoi colours; a hash field
of 4 levels; for the baked render a uint8 atlas with one texel per pixel of each surfel's size on screen. Each kernel is
called through `bitymi_ns.ops`, as training and rendering call it; median of --runs after two to warm up.

Operations: additions, multiplications, comparisons, minima, roots and divisions count 1, exp and log 10, integers
nothing. Only what the formulas ask for is counted: pixels that a pack computes in vain are the kernel's own loss.
Bytes: arrays that are streamed count once; rows, table entries and texels that are gathered count every time, in cache
or not; what a tile keeps counts once per pixel. Loads: gathered table entries (16 bytes) and texels (4 bytes).

With n surfels of which v are visible, p pixels, f fragments of which t are textured (weight at least the scene's
bound), b pairs of surfel and tile, r of them with a fragment, K sites, L levels, T bytes of table gradient:

  project             300 n operations; 152 n bytes (11 floats in, 27 out)
  project backward    350 n; 260 n
  view colour         (17 + 45 K) v; (28 K + 25) v
  view colour backw.  (25 + 75 K) v; (56 K + 40) v
  trace               65 f + 80 v + v log2 v + 30 b; 60 f (written, then put in order) + 64 b + 16 v + 8 b
  trace backward      140 f; 20 f + 176 r (row of geom, 14 sums read and written) + 176 n
  shade               6 f + (32 + 88 L + 512 + 32 L 4 + 128) t; 32 f + (44 + 128 L) t; 8 L t loads
                      88 L: cell, weights and interpolation; the rest: MLP of 4 L x 16 x 16 x 3
  shade backward,     6 f; 68 f + 36 n
    field frozen
  shade backward      6 f + (the shading of t again + 96 + 80 + 1024 + 256 L + 64 L) t;
                      68 f + 36 n + (44 + 128 L + 256 L + 128 L + 128) t + T; 16 L t loads (half of them read-modify-
                      write; 128 L are indices and weights written and read again)
  composite           9 f; 21 f + 40 p (a pack of some ten fragments has 8 bytes, here and below)
  composite backward  14 f; 45 f + 20 p + 96 n
  blend               15 f; 5 f + 40 p
  blend backward      20 f; 9 f + 20 p + 108 n
  blend, texels       15 f + 45 t; 5 f + 56 t + 40 p
  blend backward,     20 f + 110 t; 17 f + 104 t + 20 p + 108 n
    texels            (neighbouring texels are gathered from the cache, so loads are not counted)
  ssim                411 values (3 p) forward and backward; 88 bytes a value
  baked render        project + view colour + trace, of which 65 f without the fragment list (no 60 f), and
                      10 f + 70 t; 16 t bytes of texels, 20 p, 12 b; 4 t loads
"""

from __future__ import annotations

import argparse
import math
import os
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # read when torch loads OpenMP

import torch
from common import number, page, publish, say, table

from bitymi_ns import ops
from bitymi_ns.codec.packing import pack
from bitymi_ns.ops.constants import SUPPORT
from bitymi_ns.ops.trace_cpu import tracers
from bitymi_ns.scene.baked import BakedScene
from bitymi_ns.scene.camera import Camera
from bitymi_ns.scene.config import SceneConfig
from bitymi_ns.scene.field import HashField
from bitymi_ns.scene.scene import Scene

WARM_UP = 2
SITES = 7
LEVELS = 4
LOG2_TABLE = 17
TILE_SIDE = 8


@dataclass(frozen=True)
class Work:
    """What a kernel has to do at least."""

    operations: float
    bytes: float
    loads: float = 0.0

    def __add__(self, other: Work) -> Work:
        return Work(self.operations + other.operations, self.bytes + other.bytes, self.loads + other.loads)


@dataclass(frozen=True)
class Sizes:
    """What the work depends on (the letters of the module's docstring)."""

    n: int
    v: int
    p: int
    f: int
    t: int
    b: int
    r: int

    def project(self) -> Work:
        return Work(300 * self.n, 152 * self.n)

    def project_backward(self) -> Work:
        return Work(350 * self.n, 260 * self.n)

    def view_color(self) -> Work:
        return Work((17 + 45 * SITES) * self.v, (28 * SITES + 25) * self.v)

    def view_color_backward(self) -> Work:
        return Work((25 + 75 * SITES) * self.v, (56 * SITES + 40) * self.v)

    def trace(self, fragment_list: bool = True) -> Work:
        sorting = self.v * math.log2(max(2, self.v))
        listed = 60 * self.f if fragment_list else 0
        return Work(65 * self.f + 80 * self.v + sorting + 30 * self.b, listed + 72 * self.b + 16 * self.v)

    def trace_backward(self) -> Work:
        return Work(140 * self.f, 20 * self.f + 176 * self.r + 176 * self.n)

    def shade(self) -> Work:
        textured = 32 + 88 * LEVELS + 2 * 16 * (4 * LEVELS + 16 + 3) + 32
        return Work(6 * self.f + textured * self.t, 32 * self.f + (44 + 128 * LEVELS) * self.t, 8.0 * LEVELS * self.t)

    def shade_backward_frozen(self) -> Work:
        return Work(6 * self.f, 68 * self.f + 36 * self.n)

    def shade_backward(self) -> Work:
        again = (self.shade().operations - 6 * self.f) / max(1, self.t)
        mlp = 96 + 80 + 4 * 16 * (4 * LEVELS + 16)
        gradient = LEVELS * 16 * (1 << LOG2_TABLE)
        return Work(
            6 * self.f + (again + mlp + 64 * LEVELS) * self.t,
            68 * self.f + 36 * self.n + (172 + 512 * LEVELS) * self.t + gradient,
            16.0 * LEVELS * self.t,
        )

    def composite(self) -> Work:
        return Work(9 * self.f, 21 * self.f + 40 * self.p)

    def composite_backward(self) -> Work:
        return Work(14 * self.f, 45 * self.f + 20 * self.p + 96 * self.n)

    def blend(self) -> Work:
        return Work(15 * self.f, 5 * self.f + 40 * self.p)

    def blend_backward(self) -> Work:
        return Work(20 * self.f, 9 * self.f + 20 * self.p + 108 * self.n)

    def blend_texels(self) -> Work:
        return self.blend() + Work(45 * self.t, 56 * self.t)

    def blend_texels_backward(self) -> Work:
        return self.blend_backward() + Work(110 * self.t, 8 * self.f + 104 * self.t)

    def ssim(self) -> Work:
        return Work(411 * 3 * self.p, 88 * 3 * self.p)

    def baked(self) -> Work:
        own = Work(10 * self.f + 70 * self.t, 16 * self.t + 20 * self.p + 12 * self.b, 4.0 * self.t)
        return self.project() + self.view_color() + self.trace(fragment_list=False) + own


def synthetic(n: int, width: int, height: int) -> tuple[Scene, Camera]:
    """A scene and the camera that looks at it; the same every time."""
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    def uniform(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=generator)

    focal = 1.285 * max(width, height) * 9 / 16  # 347 pixels at 270 x 480
    box = torch.tensor([5.2 * width / focal, 5.2 * height / focal, 2.0])  # fills the view at depth 5
    corner = torch.tensor([-box[0] / 2, -box[1] / 2, 4.0])
    surfels = {
        "means": uniform(n, 3) * box + corner,
        "quats": normal(n, 4),
        "log_scales": math.log(0.035 * math.sqrt(20_000 / n)) + 0.4 * normal(n, 2),
        "opacity_logits": 1.5 * normal(n),
        "beta_raw": torch.full((n,), 2.0),
        "sv_sites": normal(n, SITES, 3),
        "sv_log_tau": torch.zeros(n, SITES),
        "sv_rgb": uniform(n, SITES, 3) - 0.5,
    }
    config = SceneConfig(view_color="sv", sv_sites=SITES, levels=LEVELS, near=0.2)
    field = HashField(config, (0.0, 0.0, 5.0), 5.0, True, LOG2_TABLE, generator)
    with torch.no_grad():
        field.field_w3.copy_(0.1 * normal(*field.field_w3.shape))  # starts at zero
    K = torch.tensor([[focal, 0.0, width / 2 + 3], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    return Scene(config, surfels, field), Camera(torch.eye(4), K, width, height)


def baked_scene(scene: Scene, camera: Camera) -> BakedScene:
    """The scene with an atlas of random texels, tiles as large as the surfels are on screen."""
    surfels = {name: value.detach().contiguous() for name, value in scene.surfels.items()}
    pixels = 6 * surfels["log_scales"].exp() * camera.K[0, 0] / surfels["means"][:, 2:]
    sizes = torch.exp2(torch.log2(pixels).ceil()).clamp(4, 64).long()
    packing = pack(sizes.numpy())
    shape = (packing.layers, packing.height, packing.width, 4)
    atlas = torch.randint(0, 256, shape, dtype=torch.uint8, generator=torch.Generator().manual_seed(1))
    tiles = torch.from_numpy(packing.tiles).contiguous()
    bound = scene.config.weight_bound
    return BakedScene(surfels, "sv", tiles, atlas, offset=-0.2, scale=0.4, weight_bound=bound)


def timed(run: Callable[[], object], runs: int) -> tuple[float, float]:
    """Median wall-clock and CPU seconds."""
    for _ in range(WARM_UP):
        run()
    wall, cpu = [], []
    for _ in range(runs):
        a, b = time.perf_counter(), time.process_time()
        run()
        wall.append(time.perf_counter() - a)
        cpu.append(time.process_time() - b)
    return statistics.median(wall), statistics.median(cpu)


def pairs(projection: ops.Projection) -> int:
    """Pairs of surfel and tile that the tracer looks at."""
    geom = projection.geom.detach()
    with tracers(geom).borrow() as tracer:
        tracer.run(**projection.view(geom), most=1)
        return tracer.pairs


def cases(scene: Scene, camera: Camera) -> tuple[Sizes, list[tuple[str, Work, Callable[[], object]]]]:
    """The kernels with the work they do; backward passes run on a graph that is kept."""
    q, field, bound = scene.surfels, scene.field, scene.config.weight_bound
    assert field is not None
    geometry = (q["means"], q["quats"], q["log_scales"], q["opacity_logits"], q["beta_raw"])

    def project() -> ops.Projection:
        return ops.project(*geometry, camera, scene.near)

    projection = project()
    fragments = ops.trace(projection, scene.config.rim)
    base = scene.base_color(projection)
    weights = field.weights
    fixed = tuple(w.detach() for w in weights)
    # leaves, so that each backward pass is one kernel's
    leaf = base.detach().requires_grad_()
    frames = projection.frames.detach()

    def shade(source: torch.Tensor, params: tuple[torch.Tensor, ...]) -> torch.Tensor:
        return ops.shade(fragments, source, frames, field.geometry, params, bound)

    learning, frozen = shade(leaf, weights), shade(leaf, fixed)
    colors = frozen.detach().requires_grad_()
    geom = projection.geom.detach().requires_grad_()
    at = replace(projection, geom=geom)
    weight, uv = (values.detach().requires_grad_() for values in (fragments.weight, fragments.uv))
    alone = replace(fragments, weight=weight, uv=uv, depth=fragments.depth.detach())
    image = ops.composite_image(alone, at, colors)
    sizes = Sizes(
        n=len(scene),
        v=int(projection.visible.sum()),
        p=camera.width * camera.height,
        f=len(fragments),
        t=int((fragments.weight >= bound).sum()),
        b=pairs(projection),
        r=int(torch.unique_consecutive(fragments.surfel).numel()),
    )
    baked = baked_scene(scene, camera)
    photo = torch.rand(camera.height, camera.width, 3, generator=torch.Generator().manual_seed(2))
    other = photo.flip(0).requires_grad_()
    gradient = torch.Generator().manual_seed(3)

    def backward(
        output: torch.Tensor, inputs: tuple[torch.Tensor, ...], seed: torch.Tensor | None = None
    ) -> Callable[[], object]:
        given = torch.randn(output.shape, generator=gradient) if seed is None else seed
        return lambda: torch.autograd.grad(output, inputs, given, retain_graph=True)

    def without_graph(run: Callable[[], object]) -> Callable[[], object]:
        def call() -> object:
            with torch.no_grad():
                return run()

        return call

    side = torch.full((len(scene), 2), TILE_SIDE, dtype=torch.int32)
    tiles = ops.TexelTiles.of_sizes(side, projection.geom.new_full((len(scene),), SUPPORT))
    texels = (torch.rand(tiles.count, 3, generator=gradient) - 0.5).requires_grad_()

    def blend(*given: Any) -> torch.Tensor:
        return ops.blended_image(alone, at, leaf, *given, bound=bound)

    def ssim() -> object:
        return torch.autograd.grad(ops.ssim(other, photo), other)

    view = tuple(q[name] for name in ops.VIEW_COLORS["sv"].names)
    return sizes, [
        ("project", sizes.project(), without_graph(project)),
        ("project backward", sizes.project_backward(), backward(projection.geom, geometry)),
        ("view colour", sizes.view_color(), without_graph(lambda: scene.base_color(projection))),
        ("view colour backward", sizes.view_color_backward(), backward(base, (q["means"], *view))),
        ("trace", sizes.trace(), without_graph(lambda: ops.trace(projection, scene.config.rim))),
        ("trace backward", sizes.trace_backward(), backward(fragments.weight, (projection.geom,))),
        ("shade", sizes.shade(), without_graph(lambda: shade(leaf, fixed))),
        ("shade backward, field frozen", sizes.shade_backward_frozen(), backward(frozen, (leaf,))),
        ("shade backward, field training", sizes.shade_backward(), backward(learning, (leaf, *weights))),
        (
            "composite",
            sizes.composite(),
            without_graph(lambda: ops.composite_image(fragments, projection, colors)),
        ),
        (
            "composite backward",
            sizes.composite_backward(),
            backward(image, (weight, geom, colors)),
        ),
        ("blend", sizes.blend(), without_graph(lambda: blend())),
        ("blend backward", sizes.blend_backward(), backward(blend(), (alone.weight, geom, leaf))),
        ("blend, texels", sizes.blend_texels(), without_graph(lambda: blend(texels, tiles))),
        (
            "blend backward, texels",
            sizes.blend_texels_backward(),
            backward(blend(texels, tiles), (alone.weight, alone.uv, geom, leaf, texels)),
        ),
        ("ssim forward + backward", sizes.ssim(), ssim),
        ("baked render, uint8 atlas", sizes.baked(), lambda: baked.render(camera)),
    ]


@dataclass(frozen=True)
class Ceilings:
    """What the machine can do at most, per second."""

    operations: float
    bytes: float
    loads: float

    def shares(self, work: Work, seconds: float) -> dict[str, float]:
        """Share of each ceiling that a kernel reaches."""
        return {
            "arithmetic": work.operations / seconds / self.operations,
            "bandwidth": work.bytes / seconds / self.bytes,
            "loads": work.loads / seconds / self.loads,
        }


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("--surfels", nargs="+", type=int, default=[5_000, 20_000], help="sizes of the scene")
    parser.add_argument("--width", type=int, default=270)
    parser.add_argument("--height", type=int, default=480)
    parser.add_argument("--runs", type=int, default=9, help="timed runs a kernel (%(default)s)")
    parser.add_argument("--gflops", type=float, default=546.0, help="fp32 FMA ceiling, GFLOP/s (%(default)s)")
    parser.add_argument("--gbytes", type=float, default=77.0, help="memory triad, GB/s (%(default)s)")
    parser.add_argument("--mloads", type=float, default=2050.0, help="random loads in 8 MiB, M/s (%(default)s)")
    parser.add_argument("--output", type=Path, help="also write the Markdown to this file")
    options = parser.parse_args()
    ceilings = Ceilings(options.gflops * 1e9, options.gbytes * 1e9, options.mloads * 1e6)
    header = (
        "kernel",
        "limit",
        "ms",
        "CPU ms",
        "Mop",
        "MB",
        "M loads",
        "GFLOP/s",
        "GB/s",
        "M loads/s",
        "of arithmetic",
        "of bandwidth",
        "of loads",
    )
    parts, load = [], os.getloadavg()[0]
    for n in options.surfels:
        scene, camera = synthetic(n, options.width, options.height)
        sizes, kernels = cases(scene, camera)
        rows = []
        for name, work, run in kernels:
            seconds, cpu = timed(run, options.runs)
            say(f"{n:,} surfels, {name}: {1e3 * seconds:.2f} ms")
            shares = ceilings.shares(work, seconds)
            loads = work.loads > 0
            rows.append(
                [
                    name,
                    max(shares, key=lambda key: shares[key]),
                    number(1e3 * seconds),
                    number(1e3 * cpu),
                    number(work.operations / 1e6, 1),
                    number(work.bytes / 1e6, 1),
                    number(work.loads / 1e6, 1) if loads else "",
                    number(work.operations / seconds / 1e9, 1),
                    number(work.bytes / seconds / 1e9, 1),
                    number(work.loads / seconds / 1e6, 0) if loads else "",
                    f"{100 * shares['arithmetic']:.0f} %",
                    f"{100 * shares['bandwidth']:.0f} %",
                    f"{100 * shares['loads']:.0f} %" if loads else "",
                ]
            )
        title = (
            f"### {n:,} surfels at {options.width} x {options.height}\n\n{sizes.v:,} visible, {sizes.f:,} fragments "
            f"({sizes.f / sizes.p:.1f} per pixel), {100 * sizes.t / sizes.f:.0f} % of them textured, {sizes.b:,} pairs "
            f"of surfel and tile ({sizes.r:,} with a fragment)\n"
        )
        parts.append(title + "\n" + table(header, rows, (0, 1)))
    notes = [
        f"Ceilings: {options.gflops:,.0f} GFLOP/s, {options.gbytes:,.0f} GB/s, {options.mloads:,.0f} M random loads/s, "
        f"of all cores (--gflops, --gbytes, --mloads); median of {options.runs} runs; {torch.get_num_threads()} "
        "threads. Limit: the ceiling of which the kernel reaches the largest share.",
        f"Load average at the start: {load:.1f}. Other work on the machine spoils ms and shares, CPU ms hardly.",
        "Operations and bytes are counted by the formulas in this script's docstring.",
    ]
    publish(page("CPU kernels", "\n\n".join(parts), notes), options.output)
    return 0


if __name__ == "__main__":
    sys.exit(main())
