"""Sections of gpu.py: the operations of training and of the bake against the card's limits, and training steps.

Bytes that an operation cannot do without and its floating-point operations, single precision, with n surfels of which v
are visible, b pairs of surfel and tile, f fragments of which t are textured, p pixels, L = 4 levels, x values of an
image, q parameters, e texels. Gathers from the table (16 bytes each) and from texels come from the caches and are
counted apart. What a later kernel of the same operation reads counts again.

  project             152 n                  view colours        208 v + n; 330 v
  ... backward        260 n                  ... backward        404 v + 220 n; 550 v
  tile lists          96 n + 64 v + 64 b     shade               32 f + 12 t; 6 f + 1550 t; gathers 128 L t
  trace               64 v + 100 b + 28 f    ... backward        28 f + 52 t + 12 n + 64 MB; 9 f + 3850 t; 256 L t
  ... backward        32 f + 132 b + 72 n    blend, texels       16 f + 44 b + 20 p; 16 f + 50 t; 48 t
  composite           16 f + 44 b + 20 p     ... backward, step  24 f + 48 b + 20 p + 96 n + 60 e; 27 f + 75 t; 112 t
  ... backward        36 f + 16 b + 20 p     SSIM, both passes   60 x; 411 x
                      + 72 n                 Adam                28 q; 14 q
  blend               8 f + 44 b + 20 p      bake                12 e; 1560 e; 128 L e
  ... backward        12 f + 48 b + 20 p + 96 n
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import gpu_gsplat
import numpy as np
import torch
from common import number, say, table
from harness import (
    Options,
    arithmetic_rate,
    attempt,
    backward,
    deterministic,
    failures,
    milliseconds,
    peak_memory,
    photo_loss,
    trained_like,
    training_step,
    with_texels,
    without_graph,
)
from torch import Tensor

from bitymi_ns import ops
from bitymi_ns.codec.packing import pack
from bitymi_ns.ops import trace_cuda
from bitymi_ns.ops.field_tiles import field_tiles
from bitymi_ns.scene.camera import Camera
from bitymi_ns.scene.field import Shading
from bitymi_ns.scene.scene import GEOMETRY, Scene
from bitymi_ns.train.optimizers import make_optimizers

LEVELS = 4
LOOK_UP, LEARN = 1550, 3850  # operations of a look-up in the field, and of its gradients
HEADER = ("operation", "ms", "million/s", "of", "GB/s", "of the copy", "gathers GB/s", "Gflop/s", "of a product's")


@dataclass(frozen=True)
class Case:
    """One timing, with the least that it has to do."""

    name: str
    items: int
    unit: str
    bytes: float
    operations: float
    run: Callable[[], object]
    gathers: float = 0.0


def operations(options: Options) -> str:
    """Every operation on its own."""
    rate = arithmetic_rate(options)
    parts = []
    for width, height in options.sizes:
        for n in options.surfels:
            where, rows = f"{n:,} surfels, {width} x {height}", []
            for make in (geometry_cases, field_cases, texel_cases):
                for case in attempt(where, partial(make, n, width, height, options.device)) or ():
                    ms = attempt(f"{where}, {case.name}", partial(milliseconds, case.run, options))
                    if ms is None:
                        continue
                    say(f"{where}, {case.name}: {ms:.3f} ms")
                    giga = 1e-6 / ms  # per second and 1e-9
                    row = [case.name, number(ms, 3), number(1e3 * giga * case.items, 0), case.unit]
                    row += [number(giga * case.bytes, 0), f"{1e11 * giga * case.bytes / options.copy_bytes:.0f} %"]
                    row.append(number(giga * case.gathers, 0) if case.gathers else "")
                    row += [number(giga * case.operations, 0), f"{1e11 * giga * case.operations / rate:.0f} %"]
                    rows.append(row)
            parts.append(f"#### {n:,} surfels at {width} x {height}\n\n" + table(HEADER, rows, (0, 3)))
    note = f"A matrix product in full single precision: {number(1e-12 * rate, 1)} Tflop/s."
    return "### Operations\n\n" + "\n\n".join(parts) + "\n\n" + note + failures()


def _projected(scene: Scene, camera: Camera) -> ops.Projection:
    return ops.project(*(scene.surfels[name] for name in GEOMETRY), camera, scene.near)


def geometry_cases(n: int, width: int, height: int, device: torch.device) -> list[Case]:
    """From surfels to fragments and blended surfel colours."""
    scene, camera = trained_like(n, width, height, device, texture=False)
    projection = _projected(scene, camera)
    geom = projection.geom.detach()
    fragments = ops.trace(projection, scene.config.rim)
    bins = trace_cuda.tile_lists(geom, projection)
    colors = torch.rand(len(fragments), 3, device=device).requires_grad_()
    base = torch.rand(n, 3, device=device).requires_grad_()
    image, blended = ops.composite_image(fragments, projection, colors), ops.blended_image(fragments, projection, base)

    def trace() -> object:
        return trace_cuda.fill(geom, projection, trace_cuda.blended(geom, projection, bins))

    v, b = int(projection.visible.sum()), bins.slot.shape[0]
    f, p = len(fragments), width * height
    inputs = (fragments.weight, projection.geom)
    composite = without_graph(lambda: ops.composite_image(fragments, projection, colors))
    blend = without_graph(lambda: ops.blended_image(fragments, projection, base))
    geometry = tuple(scene.surfels[name] for name in GEOMETRY)
    cases = [
        ("project", 152 * n, without_graph(lambda: _projected(scene, camera))),
        ("project, backward", 260 * n, backward(projection.geom, geometry)),
        ("tile lists", 96 * n + 64 * v + 64 * b, lambda: trace_cuda.tile_lists(geom, projection)),
        ("trace", 64 * v + 100 * b + 28 * f, trace),
        ("trace, backward", 32 * f + 132 * b + 72 * n, backward(fragments.weight, (projection.geom,))),
        ("composite", 16 * f + 44 * b + 20 * p, composite),
        ("composite, backward", 36 * f + 16 * b + 20 * p + 72 * n, backward(image, (*inputs, colors))),
        ("blend", 8 * f + 44 * b + 20 * p, blend),
        ("blend, backward", 12 * f + 48 * b + 20 * p + 96 * n, backward(blended, (*inputs, base))),
    ]
    return [Case(name, f, "fragments", count, 0.0, run) for name, count, run in cases]


def field_cases(n: int, width: int, height: int, device: torch.device) -> list[Case]:
    """View colours, shading with the field, SSIM, Adam and the bake."""
    scene, camera = trained_like(n, width, height, device)
    field, q, bound = scene.field, scene.surfels, scene.config.weight_bound
    assert field is not None
    with torch.no_grad():
        projection = _projected(scene, camera)
        fragments = ops.trace(projection, scene.config.rim)
    v, f = int(projection.visible.sum()), len(fragments)
    t = int((fragments.weight >= bound).sum())
    base = scene.base_color(projection)
    leaf = base.detach().requires_grad_()

    def shade(textured: bool = True, learn: bool = False) -> Tensor:
        weights = tuple(w if learn else w.detach() for w in field.weights) if textured else ()
        return ops.shade(fragments, leaf, projection.frames, field.geometry if textured else None, weights, bound)

    learning = backward(shade(learn=True), (leaf, *field.weights))
    gathers, streamed = 128.0 * LEVELS, 28 * f + 52 * t + 12 * n
    a, b = (torch.rand(height, width, 3, device=device) for _ in range(2))
    a.requires_grad_()
    x = a.numel()
    adam, parameters = make_optimizers(scene), list(scene.parameters())
    for parameter in parameters:
        parameter.grad = torch.zeros_like(parameter)
    numbers = sum(parameter.numel() for parameter in parameters)
    tables = 2.0 * field.field_table.nbytes  # cleared and written back
    sides = 2 ** np.random.default_rng(0).integers(2, 6, (n, 2))  # 4 to 32
    packing, e = pack(sides), int(sides.prod(1).sum())
    extent, frames = torch.full((n,), 3.0, device=device), projection.frames.detach().contiguous()
    tiles, pages = torch.from_numpy(packing.tiles).to(device), (packing.layers, packing.height, packing.width)
    view, shaded = list(q.values())[5:], (9 * f + LEARN * t)
    return [
        Case("view colours", v, "surfels", 208 * v + n, 330 * v, without_graph(lambda: scene.base_color(projection))),
        Case("view colours, backward", v, "surfels", 404 * v + 220 * n, 550 * v, backward(base, view)),
        Case("shade, no field", f, "fragments", 32 * f, 6 * f, without_graph(lambda: shade(textured=False))),
        Case("shade", f, "fragments", 32 * f + 12 * t, 6 * f + LOOK_UP * t, without_graph(shade), gathers * t),
        Case("shade, backward, frozen", f, "fragments", 28 * f + 12 * n, 9 * f, backward(shade(), (leaf,))),
        Case("shade, backward, learning", f, "fragments", streamed + tables, shaded, learning, 2 * gathers * t),
        Case(
            "... deterministic", f, "fragments", streamed + 4 * tables, shaded, deterministic(learning), 3 * gathers * t
        ),
        Case("SSIM, both passes", x, "values", 60 * x, 411 * x, lambda: ops.ssim(a, b)),
        Case("Adam", numbers, "numbers", 28 * numbers, 14 * numbers, lambda: [o.step() for o in adam.values()]),
        Case(
            "bake", e, "texels", 12 * e, (LOOK_UP + 10) * e,
            lambda: field_tiles(frames, extent, tiles, pages, field.geometry, *field.weights), gathers * e,
        ),
    ]  # fmt: skip


def texel_cases(n: int, width: int, height: int, device: torch.device) -> list[Case]:
    """Blending with texels, and its backward pass, which moves them."""
    scene, camera = with_texels(n, width, height, device)
    field, bound = scene.field, scene.config.weight_bound
    with torch.no_grad():
        projection = _projected(scene, camera)
        fragments = ops.trace(projection, scene.config.rim)
    weight, uv = (x.detach().requires_grad_() for x in (fragments.weight, fragments.uv))
    fragments = replace(fragments, weight=weight, uv=uv)
    projection = replace(projection, geom=projection.geom.detach().requires_grad_())
    f, t, e = len(fragments), int((weight >= bound).sum()), len(field.texels)
    b, p = fragments.layout.handle.pairs, width * height
    base = scene.base_color(projection).detach().requires_grad_()

    def image() -> Tensor:
        return field.image(fragments, projection, base, Shading(bound, learns=True, moves_surfels=True, maps=False))

    back = backward(image(), (weight, uv, projection.geom, base))
    count, work = 24 * f + 48 * b + 20 * p + 96 * n, 27 * f + 75 * t
    forward = 16 * f + 44 * b + 20 * p
    return [
        Case("blend, texels", f, "fragments", forward, 16 * f + 50 * t, without_graph(image), 48.0 * t),
        Case("blend, texels, backward and step", f, "fragments", count + 60 * e, work, back, 112.0 * t),
        Case("... deterministic", f, "fragments", count + 92 * e, work, deterministic(back), 176.0 * t),
    ]


def steps(options: Options) -> str:
    """Whole training steps: rendering, 0.8 L1 + 0.2 (1 - SSIM), backward, Adam."""
    parts = []
    for width, height in options.sizes:
        photo = torch.rand(height, width, 3, generator=torch.Generator().manual_seed(1)).to(options.device)
        for n in options.surfels:
            rows, where = [], f"{n:,} surfels, {width} x {height}"
            for name, run, pairs in attempt(where, partial(_steps, n, width, height, photo, options)) or ():
                ms = attempt(f"{where}, {name}", partial(milliseconds, run, options))
                if ms is None:
                    continue
                say(f"{where}, step of {name}: {ms:.3f} ms")
                memory = peak_memory(run, options.device) / 1e6
                rows.append([name, number(ms, 3), number(pairs, 0), number(memory, 0)])
            header = ("step", "ms", "pairs of surfel and tile", "peak MB")
            parts.append(f"#### {n:,} surfels at {width} x {height}\n\n" + table(header, rows))
    note = f"Loss: 0.8 L1 + 0.2 (1 - SSIM). {gpu_gsplat.NOTE} Its pairs are its own count."
    return "### Training steps\n\n" + "\n\n".join(parts) + "\n\n" + note + failures()


def _steps(
    n: int, width: int, height: int, photo: Tensor, options: Options
) -> list[tuple[str, Callable[[], object], int | None]]:
    device, loss = options.device, photo_loss(photo)
    cases: list[tuple[str, Callable[[], object], int | None]] = []
    for name, mode in (
        ("bitymi, field training", "train"),
        ("bitymi, field frozen", "frozen"),
        ("bitymi, sv", "off"),
        ("bitymi, texels training", "train"),
    ):
        if "texels" in name:
            scene, camera = with_texels(n, width, height, device)
        else:
            scene, camera = trained_like(n, width, height, device, texture=mode != "off")
        # texels have no optimiser: the backward pass moves them
        whole = mode == "train" and "texels" not in name
        parameters = list(scene.parameters() if whole else scene.surfels.parameters())

        def render(scene: Scene = scene, camera: Camera = camera, mode: str = mode) -> Tensor:
            return scene.render(camera, field_mode=mode).rgb

        pairs = scene.render(camera, field_mode="off").fragments.layout.handle.pairs
        cases.append((name, training_step(render, loss, parameters), pairs))
    return cases + (gpu_gsplat.steps(n, width, height, loss, training_step, device) if options.peers else [])
