"""Errors of a backend against the float64 reference, and errors caused by rounding the inputs."""

import math
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from bitymi_ns import ops
from bitymi_ns.ops.backend import emulated_cuda, module
from bitymi_ns.ops.project import geometry_of
from bitymi_ns.ops.reference import render as reference_render
from bitymi_ns.ops.reference import view_color as reference_view_color
from bitymi_ns.ops.reference.view_color import view_directions
from bitymi_ns.scene.camera import Camera
from .scenes import ALPHAS, PLAIN, RIM, SV_KEYS, TEXELS, SceneCase, Way, cells, tile_images, tiles_of


@dataclass(frozen=True)
class Backend:
    """A set of compiled kernels of `bitymi_ns.ops`."""

    name: str  # for tables and tests
    device: str  # of its tensors
    use: Callable[[], AbstractContextManager[object]] = nullcontext  # selects it in `bitymi_ns.ops`


_ALL = Backend("cpu", "cpu"), Backend("cuda", "cuda"), Backend("emulated", "cpu", emulated_cuda)
BACKENDS = {backend.name: backend for backend in _ALL}
"""By name; tests/stress runs every case on the available ones. `emulated`: CUDA kernels run on the host."""


def missing(backend: Backend) -> str:
    """Say why a backend cannot be used here; empty if it can."""
    device = torch.device(backend.device)
    if device.type == "cuda" and not torch.cuda.is_available():
        return "no CUDA device (or torch without CUDA)"
    try:
        with backend.use():
            module(device)
    except RuntimeError as error:
        return str(error)
    return ""


IMAGES = ("rgb", "alpha", "depth", "normal", "beta_map")
SIZES = {"rgb": 3, "alpha": 1, "beta_map": 1, "depth": 1, "normal": 3}
"""Channels of the image of `ops.blended_image`."""
ROUNDING = {torch.float32: 2.0**-24, torch.float64: 2.0**-53}
NOTHING = 1e-15
"""Images and gradients below this everywhere are rounding errors and compared absolutely."""
PROBES = 3  # random perturbations of the inputs for `Errors.input_*`


class Errors(NamedTuple):
    """Largest errors of one case, relative to the largest value of the image or gradient.

    A pixel is compared, and counts for the loss, only if both renderers blend the same surfels there, in the same
    branch of the kernel, and fetch between the same texels. In the other, flipped pixels rounding moved a value across
    a threshold.
    """

    forward: float  # largest error of rgb, alpha, depth, normal and Beta map
    input_forward: float
    """Change of the reference's images if each input is perturbed by up to half a unit in its last place."""
    gradient: float  # largest error of the gradients of a random linear loss of these images
    input_gradient: float  # their change as in `input_forward`
    worst: str  # parameter with the largest error of its gradient
    flipped: float  # share of flipped pixels
    drawn: int  # blended fragments of the reference
    finite: bool  # all images and gradients of the backend, over all pixels

    @property
    def pairs(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Errors of images and of gradients, with what rounded inputs cause."""
        return (self.forward, self.input_forward), (self.gradient, self.input_gradient)


class _Result(NamedTuple):
    images: dict[str, Tensor]  # [P, C] each, with autograd graph
    terms: Tensor  # [P, N], see `_terms`; 0: the surfel is not blended
    leaves: dict[str, Tensor]


def _terms(uv: Tensor, low_pass: Tensor, textured: bool) -> Tensor:
    """Number what fragments add, by branch of the kernel and cell between texels; -1 where rounding decides."""
    between = cells(uv) if textured else torch.zeros_like(low_pass, dtype=torch.int64)
    return torch.where(between < 0, -1, 1 + 2 * between + low_pass)


def _same(got: _Result, want: _Result) -> Tensor:
    """Find the pixels [P] in which both sum the same terms."""
    return ((got.terms == want.terms) & (got.terms >= 0)).all(1)


def measure(
    case: SceneCase, backend: Backend, dtype: torch.dtype = torch.float32, near: float = 0.2, way: Way = PLAIN
) -> Errors:
    """Compare renders and gradients of a backend with the reference's, from inputs rounded to `dtype`."""
    rounded = _map(way.of(case), lambda t: t.to(dtype).double())
    with backend.use():
        got = _by_kernels(rounded, backend.device, dtype, near)
        want = _by_reference(rounded, near)
        same = _same(got, want)
        weights = _loss_weights(want.images)
        grads = _gradients(got, weights, same)
        everywhere = _gradients(got, weights, torch.ones_like(same))
    wanted = _gradients(want, weights, same)
    gradient_errors = {key: _relative(grads[key], wanted[key]) for key in wanted}
    worst = max(gradient_errors, key=lambda key: gradient_errors[key])
    input_forward = input_gradient = 0.0
    generator = torch.Generator().manual_seed(0)

    def probe(values: Tensor) -> Tensor:
        signs = torch.randint(0, 2, values.shape, generator=generator).double() * 2 - 1
        return values * (1 + ROUNDING[dtype] * signs)

    for _ in range(PROBES):
        moved = _by_reference(_map(rounded, probe), near)
        agree = _same(moved, want)
        input_forward = max(input_forward, _image_error(moved.images, want.images, agree))
        here, there = (_gradients(result, weights, agree & same) for result in (want, moved))
        input_gradient = max(input_gradient, *(_relative(there[key], here[key]) for key in here))
    return Errors(
        forward=_image_error(got.images, want.images, same),
        input_forward=input_forward,
        gradient=gradient_errors[worst],
        input_gradient=input_gradient,
        worst=worst,
        flipped=1.0 - same.double().mean().item(),
        drawn=int((want.terms != 0).sum()),
        finite=all(bool(t.isfinite().all()) for t in (*got.images.values(), *grads.values(), *everywhere.values())),
    )


def _map(case: SceneCase, function) -> SceneCase:
    params = {key: function(value) for key, value in case.params.items()}
    return replace(case, params=params, viewmat=function(case.viewmat), K=function(case.K))


def _by_kernels(case: SceneCase, device: str, dtype: torch.dtype, near: float) -> _Result:
    leaves = {key: value.to(device, dtype).clone().requires_grad_() for key, value in case.params.items()}
    camera = Camera(case.viewmat.to(device, dtype), case.K.to(device, dtype), case.width, case.height)
    textured = {"texels": leaves[TEXELS], "tiles": tiles_of(leaves[TEXELS])} if TEXELS in leaves else {}
    alpha = ops.TexelAlpha(textured["tiles"], leaves[ALPHAS].squeeze(1), 0.0) if ALPHAS in leaves else None
    projection = ops.project(*geometry_of(leaves), camera=camera, near=near, alpha=alpha)
    fragments = ops.trace(projection, RIM)
    base = ops.view_color("sv", leaves, leaves["means"], camera.exact_center, projection.visible)
    image = ops.blended_image(fragments, projection, base, **textured, maps=True)
    terms = torch.zeros(case.width * case.height, len(leaves["means"]), dtype=torch.int64)
    numbers = _terms(fragments.uv.T, fragments.sigma < 0, TEXELS in leaves)
    terms[fragments.pixel.cpu().long(), fragments.surfel.cpu().long()] = numbers.cpu()
    parts = dict(zip(SIZES, image.split(list(SIZES.values()), dim=1), strict=True))
    return _Result({key: parts[key] for key in IMAGES}, terms, leaves)


def _by_reference(case: SceneCase, near: float) -> _Result:
    leaves = {key: value.clone().requires_grad_() for key, value in case.params.items()}
    directions = view_directions(leaves["means"], case.viewmat)
    colors = reference_view_color.sv(*(leaves[key] for key in SV_KEYS), dirs=directions)
    texels = [leaves[key] for key in (TEXELS, ALPHAS) if key in leaves]
    tiles = tile_images(torch.cat(texels, 1)) if texels else None
    result = reference_render.render(geometry_of(leaves), colors, case, tiles=tiles, near=near, rim=RIM)
    images = {key: getattr(result, key).reshape(case.width * case.height, -1) for key in IMAGES}
    trace = result.trace
    terms = torch.where(trace.blended, _terms(trace.uv, trace.low_pass, TEXELS in leaves), 0)
    return _Result(images, terms, leaves)


def _loss_weights(images: dict[str, Tensor]) -> dict[str, Tensor]:
    """Draw random loss weights per pixel and channel, relative to each image's largest value."""
    generator = torch.Generator().manual_seed(1)
    weights = {}
    for key, image in images.items():
        scale = image.detach().abs().max().item() if image.numel() else 0.0
        random = torch.rand(image.shape, generator=generator, dtype=torch.float64) - 0.3
        weights[key] = random / scale if scale > NOTHING else random
    return weights


def _gradients(result: _Result, weights: dict[str, Tensor], pixels: Tensor) -> dict[str, Tensor]:
    """Compute d sum(weights * images over `pixels`) / d leaves, float64 on the CPU."""
    loss = torch.zeros(())
    for key, image in result.images.items():
        loss = loss + (image * torch.where(pixels[:, None], weights[key], 0.0).to(image)).sum()
    grads = torch.autograd.grad(
        loss, list(result.leaves.values()), retain_graph=True, allow_unused=True, materialize_grads=True
    )
    return {key: grad.double().cpu() for key, grad in zip(result.leaves, grads, strict=True)}


def _image_error(got: dict[str, Tensor], want: dict[str, Tensor], pixels: Tensor) -> float:
    return max(_relative(got[key], want[key], pixels) for key in want)


def _relative(got: Tensor, want: Tensor, rows: Tensor | slice = slice(None)) -> float:
    """Compute the largest error in some rows, relative to the largest value of `want`; infinite for NaN."""
    want = want.detach()
    errors = (got.detach().double().cpu() - want).abs()[rows].nan_to_num(math.inf)
    if not errors.numel():
        return 0.0
    scale, error = want.abs().max().item(), errors.max().item()
    return error / scale if scale > NOTHING else error
