"""Section of gpu.py: view colours, shading, SSIM, Adam and the bake against the limits of memory and arithmetic.

Bytes that an operation cannot do without and its floating-point operations, single precision, with v visible surfels
of 7 sites (n in all), f fragments of which t are textured, L = 4 levels, x values of an image, q parameters, e texels.
Gathers from the table are counted apart: they come from the caches, 16 bytes each, 8 L a look-up; and so are those of
texels and their gradients, 4 a look-up of 12 and 16 bytes.

  view colours        208 v + n; 330 v
  ... backward        404 v + 220 n; 550 v
  shade, no field     32 f; 6 f
  shade               32 f + 12 t; 6 f + 1550 t; gathers 128 L t
  ... backward,
    field frozen      28 f + 12 n; 9 f
  ... learning        28 f + 52 t + 12 n + 64 MB; 9 f + 3850 t; gathers and additions 256 L t
  blend, texels       16 f + 44 b + 20 p; 16 f + 50 t; gathers 48 t   (b pairs of surfel and tile, p pixels)
  ... backward, with
    a step            24 f + 48 b + 20 p + 96 n + 60 e; 27 f + 75 t; gathers and additions 112 t
  SSIM, forward and
    backward          60 x; 411 x   (both images twice, three parts of the gradient written and read, the gradient)
  Adam                28 q; 14 q
  bake                12 e; 1560 e; gathers 128 L e
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from common import number, say, table
from gpu_common import (
    Options,
    Section,
    arithmetic_rate,
    attempt,
    backward,
    deterministic,
    failures,
    milliseconds,
    trained_like,
    with_texels,
    without_graph,
)
from torch import Tensor

from bitymi_ns import ops
from bitymi_ns.codec.packing import pack
from bitymi_ns.ops.field_tiles import field_tiles
from bitymi_ns.scene.field import Shading
from bitymi_ns.scene.scene import GEOMETRY
from bitymi_ns.train.optimizers import make_optimizers

LEVELS = 4
LOOK_UP = 1550
LEARN = 3850
NEEDS = ("view_color_forward_f32", "shade_forward_f32", "shade_backward_f32", "ssim_f32", "field_tiles_f32")
NEEDS += ("blend_forward_f32", "blend_backward_f32")


@dataclass(frozen=True)
class Case:
    """One timing: how much of what it does at least."""

    name: str
    items: int
    what: str
    bytes: float
    operations: float
    run: Callable[[], object]
    gathers: float = 0.0


def appearance(options: Options) -> str:
    """Every operation on its own."""
    rate = arithmetic_rate(options)
    header = ("operation", "ms", "million/s", "of", "GB/s", "of the copy", "gathers GB/s", "Gflop/s", "of a product's")
    parts = []
    for width, height in options.sizes:
        for n in options.surfels:
            rows = []
            where = f"{n:,} surfels, {width} x {height}"
            for case in attempt(where, partial(_cases, n, width, height, options.device)) or ():
                ms = attempt(f"{where}, {case.name}", partial(milliseconds, case.run, options))
                if ms is None:
                    continue
                say(f"{n:,} surfels, {width} x {height}, {case.name}: {ms:.3f} ms")
                seconds = 1e-3 * ms
                rows.append(
                    [
                        case.name,
                        number(ms, 3),
                        number(1e-6 * case.items / seconds, 0),
                        case.what,
                        number(1e-9 * case.bytes / seconds, 0),
                        f"{100 * case.bytes / seconds / options.copy_bytes:.0f} %",
                        number(1e-9 * case.gathers / seconds, 0) if case.gathers else "",
                        number(1e-9 * case.operations / seconds, 0),
                        f"{100 * case.operations / seconds / rate:.0f} %",
                    ]
                )
            parts.append(f"#### {n:,} surfels at {width} x {height}\n\n" + table(header, rows))
    note = f"A matrix product in full single precision: {number(1e-12 * rate, 1)} Tflop/s."
    return "### Appearance\n\n" + "\n\n".join(parts) + "\n\n" + note + failures()


def _cases(n: int, width: int, height: int, device: torch.device) -> list[Case]:
    scene, camera = trained_like(n, width, height, device)
    field, q = scene.field, scene.surfels
    assert field is not None
    with torch.no_grad():
        projection = ops.project(*(q[name] for name in GEOMETRY), camera, scene.near)
        fragments = ops.trace(projection, scene.config.rim)
    bound = scene.config.weight_bound
    v, f = int(projection.visible.sum()), len(fragments)
    t = int((fragments.weight >= bound).sum())
    base = scene.base_color(projection)
    leaf = base.detach().requires_grad_()

    def shade(textured: bool = True, learn: bool = False) -> Tensor:
        weights = tuple(w if learn else w.detach() for w in field.weights) if textured else ()
        return ops.shade(fragments, leaf, projection.frames, field.geometry if textured else None, weights, bound)

    shaded, learned = shade(), shade(learn=True)
    exact = backward(learned, (leaf, *field.weights))
    gathers = 128.0 * LEVELS
    a, b = (torch.rand(height, width, 3, device=device) for _ in range(2))
    a.requires_grad_()
    x = a.numel()
    adam = make_optimizers(scene)
    parameters = list(scene.parameters())
    for parameter in parameters:
        parameter.grad = torch.zeros_like(parameter)
    numbers = sum(parameter.numel() for parameter in parameters)
    tables = 2.0 * field.field_table.nbytes  # cleared and written back
    return [
        Case("view colours", v, "surfels", 208 * v + n, 330 * v, without_graph(lambda: scene.base_color(projection))),
        Case("view colours, backward", v, "surfels", 404 * v + 220 * n, 550 * v, backward(base, list(q.values())[5:])),
        Case("shade, no field", f, "fragments", 32 * f, 6 * f, without_graph(lambda: shade(textured=False))),
        Case("shade", f, "fragments", 32 * f + 12 * t, 6 * f + LOOK_UP * t, without_graph(shade), gathers * t),
        Case("shade, backward, frozen", f, "fragments", 28 * f + 12 * n, 9 * f, backward(shaded, (leaf,))),
        Case(
            "shade, backward, learning",
            f,
            "fragments",
            28 * f + 52 * t + 12 * n + tables,
            9 * f + LEARN * t,
            backward(learned, (leaf, *field.weights)),
            2 * gathers * t,
        ),
        Case(
            "... with deterministic sums",
            f,
            "fragments",
            28 * f + 52 * t + 12 * n + 4 * tables,
            9 * f + LEARN * t,
            deterministic(exact),
            3 * gathers * t,
        ),
        *_texel_cases(n, width, height, device),
        Case("SSIM, both passes", x, "values", 60 * x, 411 * x, lambda: ops.ssim(a, b)),
        Case("Adam", numbers, "numbers", 28 * numbers, 14 * numbers, lambda: [o.step() for o in adam.values()]),
        _bake_case(n, scene, projection),
    ]


def _texel_cases(n: int, width: int, height: int, device: torch.device) -> list[Case]:
    scene, camera = with_texels(n, width, height, device)
    field, q, bound = scene.field, scene.surfels, scene.config.weight_bound
    with torch.no_grad():
        projection = ops.project(*(q[name] for name in GEOMETRY), camera, scene.near)
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
    count = 24 * f + 48 * b + 20 * p + 96 * n
    work = 27 * f + 75 * t
    return [
        Case(
            "blend, texels",
            f,
            "fragments",
            16 * f + 44 * b + 20 * p,
            16 * f + 50 * t,
            without_graph(image),
            48.0 * t,
        ),
        Case("blend, texels, backward and step", f, "fragments", count + 60 * e, work, back, 112.0 * t),
        Case("... with deterministic sums", f, "fragments", count + 92 * e, work, deterministic(back), 176.0 * t),
    ]


def _bake_case(n: int, scene, projection: ops.Projection) -> Case:
    sides = 2 ** np.random.default_rng(0).integers(2, 6, (n, 2))  # 4 to 32
    packing = pack(sides)
    frames = projection.frames.detach().contiguous()
    extent = torch.full((n,), 3.0, device=frames.device)
    tiles = torch.from_numpy(packing.tiles).to(frames.device)
    pages = (packing.layers, packing.height, packing.width)
    texels = int(sides.prod(1).sum())
    return Case(
        "bake",
        texels,
        "texels",
        12 * texels,
        (LOOK_UP + 10) * texels,
        lambda: field_tiles(frames, extent, tiles, pages, scene.field.geometry, *scene.field.weights),
        128.0 * LEVELS * texels,
    )


SECTIONS = (Section("appearance", NEEDS, appearance),)
