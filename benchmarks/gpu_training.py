"""Sections of gpu.py: the training operations against the memory's limit, and training steps beside gsplat's.

Bytes that an operation cannot do without, single precision, with n surfels of which v are visible, b pairs of surfel
and tile, f fragments and p pixels (gathers count once; what a later kernel of the same operation reads counts again):

  project             152 n
  project backward    260 n
  tile lists          96 n + 64 v + 64 b   (two sorts: 4 passes of 16 bytes over n, 2 over b)
  trace               64 v + 100 b + 28 f  (marks written, counted, scanned and read again; fragments written)
  trace backward      32 f + 132 b + 72 n  (of the weights alone, as in training)
  composite           16 f + 44 b + 20 p
  composite backward  36 f + 16 b + 20 p + 72 n
  blend               8 f + 44 b + 20 p    (shading and compositing of surfels alone)
  blend backward      12 f + 48 b + 20 p + 96 n
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import gpu_gsplat
import torch
from common import number, say, table
from gpu_common import (
    Options,
    Section,
    attempt,
    backward,
    failures,
    milliseconds,
    missing,
    peak_memory,
    photo_loss,
    trained_like,
    training_step,
    with_texels,
    without_graph,
)
from torch import Tensor

from bitymi_ns import ops
from bitymi_ns.ops import trace_cuda
from bitymi_ns.scene.camera import Camera
from bitymi_ns.scene.scene import GEOMETRY, Scene

OPERATIONS = ("project_forward_f32", "trace_mark_f32", "trace_backward_f32", "composite_backward_f32")
OPERATIONS += ("blend_forward_f32", "blend_backward_f32")
STEP = (*OPERATIONS, "view_color_forward_f32", "shade_forward_f32", "shade_backward_f32")


def operations(options: Options) -> str:
    """Every operation on its own."""
    header = ("operation", "ms", "million fragments/s", "bytes/fragment", "GB/s", "of the copy bandwidth")
    parts = []
    for width, height in options.sizes:
        for n in options.surfels:
            scene, camera = trained_like(n, width, height, options.device, texture=False)
            where = f"{n:,} surfels, {width} x {height}"
            made = attempt(where, partial(_operations, scene, camera))
            if made is None:
                continue
            sizes, cases = made
            rows = []
            for name, needed, run in cases:
                ms = attempt(f"{where}, {name}", partial(milliseconds, run, options))
                if ms is None:
                    continue
                say(f"{n:,} surfels, {width} x {height}, {name}: {ms:.3f} ms")
                rate = needed / (1e-3 * ms)
                rows.append(
                    [
                        name,
                        number(ms, 3),
                        number(sizes["f"] / ms / 1e3, 0),
                        number(needed / sizes["f"], 1),
                        number(rate / 1e9, 0),
                        f"{100 * rate / options.copy_bytes:.0f} %",
                    ]
                )
            title = (
                f"#### {n:,} surfels at {width} x {height}\n\n{sizes['v']:,} visible, {sizes['b']:,} pairs of surfel "
                f"and tile, {sizes['f']:,} fragments ({sizes['f'] / sizes['p']:.1f} per pixel)\n"
            )
            parts.append(title + "\n" + table(header, rows))
    return "### Training operations\n\n" + "\n\n".join(parts) + failures()


def _operations(scene: Scene, camera: Camera) -> tuple[dict[str, int], list[tuple[str, int, Callable[[], object]]]]:
    q = scene.surfels
    geometry = tuple(q[name] for name in GEOMETRY)

    def project() -> ops.Projection:
        return ops.project(*geometry, camera, scene.near)

    projection = project()
    geom = projection.geom.detach()
    fragments = ops.trace(projection, scene.config.rim)
    bins = trace_cuda.tile_lists(geom, projection)
    colors = torch.rand(len(fragments), 3, device=geom.device).requires_grad_()
    image = ops.composite_image(fragments, projection, colors)
    base = torch.rand(len(scene), 3, device=geom.device).requires_grad_()
    blended = ops.blended_image(fragments, projection, base)

    def trace() -> object:
        layout, _ = trace_cuda.blended(geom, projection, bins)
        return trace_cuda.fill(geom, projection, layout)

    n, v, b = len(scene), int(projection.visible.sum()), bins.slot.shape[0]
    f, p = len(fragments), camera.width * camera.height
    return {"v": v, "b": b, "f": f, "p": p}, [
        ("project", 152 * n, without_graph(project)),
        ("project backward", 260 * n, backward(projection.geom, geometry)),
        ("tile lists", 96 * n + 64 * v + 64 * b, lambda: trace_cuda.tile_lists(geom, projection)),
        ("trace", 64 * v + 100 * b + 28 * f, trace),
        ("trace backward", 32 * f + 132 * b + 72 * n, backward(fragments.weight, (projection.geom,))),
        (
            "composite",
            16 * f + 44 * b + 20 * p,
            without_graph(lambda: ops.composite_image(fragments, projection, colors)),
        ),
        (
            "composite backward",
            36 * f + 16 * b + 20 * p + 72 * n,
            backward(image, (fragments.weight, projection.geom, colors)),
        ),
        (
            "blend",
            8 * f + 44 * b + 20 * p,
            without_graph(lambda: ops.blended_image(fragments, projection, base)),
        ),
        (
            "blend backward",
            12 * f + 48 * b + 20 * p + 96 * n,
            backward(blended, (fragments.weight, projection.geom, base)),
        ),
    ]


def steps(options: Options) -> str:
    """Whole training steps: rendering, L1 and, where its kernel is built, SSIM, backward, Adam."""
    with_ssim = not missing(("ssim_f32",), options.device)
    header = ("step", "ms", "pairs of surfel and tile", "peak MB")
    parts = []
    for width, height in options.sizes:
        photo = torch.rand(height, width, 3, generator=torch.Generator().manual_seed(1)).to(options.device)
        for n in options.surfels:
            rows = []
            where = f"{n:,} surfels, {width} x {height}"
            cases = attempt(where, partial(_steps, n, width, height, photo, with_ssim, options))
            for name, run, pairs in cases or ():
                ms = attempt(f"{where}, {name}", partial(milliseconds, run, options))
                if ms is None:
                    continue
                say(f"{n:,} surfels, {width} x {height}, step of {name}: {ms:.3f} ms")
                memory = peak_memory(run, options.device) / 1e6
                rows.append([name, number(ms, 3), number(pairs, 0), number(memory, 0)])
            parts.append(f"#### {n:,} surfels at {width} x {height}\n\n" + table(header, rows))
    loss = "0.8 L1 + 0.2 (1 - SSIM)" if with_ssim else "L1 (this build has no SSIM kernel)"
    note = f"Loss: {loss}. {gpu_gsplat.NOTE} Its pairs are its own count."
    return "### Training steps\n\n" + "\n\n".join(parts) + "\n\n" + note + failures()


def _steps(
    n: int, width: int, height: int, photo: Tensor, with_ssim: bool, options: Options
) -> list[tuple[str, Callable[[], object], int | None]]:
    device = options.device

    loss = photo_loss(photo, with_ssim)
    cases: list[tuple[str, Callable[[], object], int | None]] = []
    for name, mode in (
        ("bitymi, field training", "train"),
        ("bitymi, field frozen", "frozen"),
        ("bitymi, sv", "off"),
        ("bitymi, texels training", "train"),
    ):
        texels = "texels" in name  # which have no optimiser: the backward pass moves them
        scene, camera = (
            with_texels(n, width, height, device)
            if texels
            else trained_like(n, width, height, device, texture=mode != "off")
        )
        parameters = list(scene.parameters() if mode == "train" and not texels else scene.surfels.parameters())

        def render(scene: Scene = scene, camera: Camera = camera, mode: str = mode) -> Tensor:
            return scene.render(camera, field_mode=mode).rgb

        pairs = scene.render(camera, field_mode="off").fragments.layout.handle.pairs
        cases.append((name, training_step(render, loss, parameters), pairs))
    return cases + (gpu_gsplat.steps(n, width, height, loss, training_step, device) if options.peers else [])


SECTIONS = (Section("operations", OPERATIONS, operations), Section("steps", STEP, steps))
