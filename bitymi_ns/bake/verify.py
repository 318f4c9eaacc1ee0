"""Checks of a bundle against its trained scene."""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from bitymi_ns.bundle.read import Bundle
from bitymi_ns.bundle.verify import SLACK_STEPS, Check, steps_text
from bitymi_ns.codec.pages import texel_alpha
from bitymi_ns.ops.parameters import GEOMETRY
from bitymi_ns.scene.camera import Camera
from bitymi_ns.scene.tile_sizes import kernel_parameters
from bitymi_ns.scene.visibility import visibility
from .view_colors import centers_of, view_color_errors

_SLACK = 1.02  # of the stated error: sums in another order, rotations written with length 1


def check_view_color(bundle: Bundle, surfels: Mapping[str, Tensor], cameras: Sequence[Camera]) -> Check:
    """Compare the error of the reduced view colours against `surfels`, the trained scene, with the stated one.

    `cameras`: of the training views."""
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
    seen = means.new_zeros(0, len(means), dtype=torch.bool)
    transmittance = None
    if cameras:
        views = visibility(trained, cameras, render.near, alpha=texel_alpha(bundle.scene))
        seen, transmittance = views.seen, views.in_front
    opacity, _ = kernel_parameters(trained, transmittance)
    views = (means, seen, centers_of(cameras, means), opacity)
    largest = float(view_color_errors(bundle.scene.view_color, trained, bundle.scene.surfels, *views).amax())
    bound = stated.error.p100
    ok = bound is not None and largest <= bound * _SLACK + SLACK_STEPS
    return Check(name, ok, f"largest {largest:.3f} (stated {steps_text(bound)}, tolerance {stated.tolerance:g}) steps")


def _keys(surfels: Mapping[str, Tensor]) -> list[bytes]:
    """Select the numbers of a surfel that a bundle holds bit for bit."""
    parts = [surfels[name][..., None].flatten(1) for name in GEOMETRY if name != "quats"]
    return [row.tobytes() for row in torch.cat(parts, dim=1).numpy()]
