"""Checks of a bundle against the trained scene that it was baked from."""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from bitymi_ns.bake.field.errors import tile_errors
from bitymi_ns.bake.field.plan import Field, make_plan
from bitymi_ns.bake.inputs import BakeInput
from bitymi_ns.bake.view_colors import centers_of, view_color_errors
from bitymi_ns.bundle.bake_options import BakeOptions
from bitymi_ns.bundle.read import Bundle
from bitymi_ns.bundle.verify import SLACK_STEPS, Check, steps_text
from bitymi_ns.codec.pages import scene_texels, texel_alpha
from bitymi_ns.scene.camera import Camera
from bitymi_ns.scene.field import HashField
from bitymi_ns.scene.tile_sizes import kernel_parameters
from bitymi_ns.scene.visibility import visibility

_SLACK = 1.02  # sums in another order, rotations that were written with length 1
_SLACK_COUNT = 2  # surfels at the bound itself


def check_field(bundle: Bundle, field: Field, cameras: Sequence[Camera]) -> Check:
    """Measure the stored tiles against the field, and compare with the error that bundle.json states.

    Args:
        bundle: what `check_files` read.
        field: the residual field of the scene that was baked.
        cameras: its training views.
    """
    name, statistics, render = "error against the field", bundle.info.statistics, bundle.info.render
    stated = statistics.error
    if stated is None:
        return Check(name, True, "not stated: the texels were changed after the bake")
    if statistics.field is not None and isinstance(field, HashField):
        first, count = statistics.field.kept
        if first + count > field.levels:
            return Check(name, False, f"levels {first} to {first + count - 1} stated, the field has {field.levels}")
        field = field.only(first, count)
    options = statistics.options or BakeOptions()
    inputs = BakeInput(bundle.scene.surfels, cameras, render.near, render.weight_bound, bundle.scene.prefilter)
    plan = make_plan(inputs.with_visibility(options), field, options, whole=options.tolerance == 0)
    tiled = bundle.scene.tiles[:, 3] > 0
    plan.extent = torch.where(tiled, bundle.scene.extent, plan.extent)
    found = tile_errors(field, plan, bundle.scene.tiles[:, 3:], scene_texels(bundle.scene))
    lines, ok = [], True
    for what, measured, bound in (("rms", found.rms, stated.rms.p100), ("largest", found.largest, stated.largest.p100)):
        largest = float(measured.amax())
        ok &= bound is not None and largest <= bound * _SLACK + SLACK_STEPS
        lines.append(f"{what} {largest:.3f} (stated {steps_text(bound)})")
    certificate = statistics.certificate
    if certificate is not None:
        again = found.certificate(certificate.tolerance)
        assert again is not None
        ok &= certificate.worst is not None and again.worst <= certificate.worst * _SLACK + SLACK_STEPS
        ok &= again.beyond <= certificate.beyond * _SLACK + _SLACK_COUNT
        lines.append(f"as seen {again.beyond:,} beyond {certificate.tolerance:g} (stated {certificate.beyond:,})")
    return Check(name, ok, ", ".join(lines) + " steps")


def check_view_color(bundle: Bundle, surfels: Mapping[str, Tensor], cameras: Sequence[Camera]) -> Check:
    """Measure lean view colours against the trained ones, and compare with the error that bundle.json states.

    Args:
        bundle: what `check_files` read.
        surfels: per-surfel parameters of the scene that was baked; a surfel of the bundle is found by its geometry.
        cameras: its training views.
    """
    name = "error of the view colours"
    if "view_terms" not in bundle.scene.surfels:
        return Check(name, True, "none: all of them are kept")
    stated = bundle.info.statistics.view_color
    if stated is None:
        return Check(name, True, "not stated")
    if bundle.info.statistics.polish is not None and bundle.info.statistics.polish.steps:
        return Check(name, True, "not measured: the surfels learned after the bake and are those of no run")
    if bundle.info.statistics.rounding is not None:
        return Check(name, True, "not measured: the surfels were rounded after it, for a compact bundle")
    trained = {name: value.detach().float().cpu() for name, value in surfels.items()}
    places = {key: row for row, key in enumerate(_keys(trained))}
    rows = [places.get(key) for key in _keys(bundle.scene.surfels)]
    if None in rows:
        return Check(name, False, f"surfel {rows.index(None)} is none of the trained scene")
    trained = {name: value[torch.tensor(rows)] for name, value in trained.items()}
    means, render = bundle.scene.surfels["means"], bundle.info.render
    seen, transmittance = means.new_zeros(0, len(means), dtype=torch.bool), None
    if cameras:
        drawn = {"prefilter": bundle.scene.prefilter, "alpha": texel_alpha(bundle.scene)}
        views = visibility(trained, cameras, render.near, **drawn)
        seen, transmittance = views.seen, views.in_front
    opacity, _ = kernel_parameters(trained, transmittance)
    at = (means, seen, centers_of(cameras, means), opacity)
    found = float(view_color_errors(bundle.scene.view_color, trained, bundle.scene.surfels, *at).amax())
    bound = stated.error.p100
    ok = bound is not None and found <= bound * _SLACK + SLACK_STEPS
    return Check(name, ok, f"largest {found:.3f} (stated {steps_text(bound)}, tolerance {stated.tolerance:g}) steps")


def _keys(surfels: Mapping[str, Tensor]) -> list[bytes]:
    """Select the numbers per surfel that a bundle holds bit for bit."""
    parts = [surfels["means"], surfels["log_scales"], surfels["opacity_logits"][:, None], surfels["beta_raw"][:, None]]
    return [row.tobytes() for row in torch.cat(parts, dim=1).numpy()]
