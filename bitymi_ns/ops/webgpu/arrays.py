"""Conversion of a baked scene to the shaders' arrays (shaders/scene.wgsl)."""

import re
from dataclasses import dataclass
from importlib import resources

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ..baked_scene import BakedSceneLike
from ..constants import SUPPORT
from ..parameters import GEOMETRY
from ..view_color import REDUCED, check_reduced, check_view_color
from ..view_kinds import VIEW_COLORS

WHOLE = " sites"  # suffix of a kind's form with all sites and no base
FORMS = [kind + end for kind, entry in VIEW_COLORS.items() for end in (("", WHOLE) if entry.sites else ("",))]
KINDS = {name: number for number, name in enumerate(FORMS)}
"""Numbers of the view-colour forms in view_color.wgsl."""


def _struct(name: str) -> np.dtype:
    """Read the layout of a struct of scene.wgsl, by WGSL's rules of alignment."""
    text = (resources.files("bitymi_ns.ops") / "shaders" / "scene.wgsl").read_text("utf8")
    body = text.split(f"struct {name} {{")[1].split("\n}")[0]
    offsets, formats, end = {}, [], 0
    for field, array, vector, kind, rows in re.findall(
        r"^  (\w+): (array<)?(?:vec(\d))?([fu])[\w<]*(?:, (\d))?", body, re.M
    ):
        width = int(vector or 1)
        alignment = (4, 8, 16, 16)[width - 1]
        offsets[field] = -(-end // alignment) * alignment
        formats.append(np.dtype((f"<{kind}4", (int(rows), width) if array else width if vector else ())))
        end = offsets[field] + formats[-1].itemsize
    size, starts = -(-end // 16) * 16, list(offsets.values())
    return np.dtype({"names": list(offsets), "formats": formats, "offsets": starts, "itemsize": size})


SURFEL, SEEN, FRAME = _struct("Surfel"), _struct("Seen"), _struct("Frame")
FIELDS = {**{name: name.removesuffix("s") for name in GEOMETRY}, "mean_residual": "residual", "view_base": "base"}
"""Fields of `SURFEL` by parameter."""


@dataclass
class Arrays:
    """Arrays that the shaders read."""

    surfels: npt.NDArray  # [N] of `SURFEL`
    terms: npt.NDArray[np.float32]  # terms of the view colours, flat
    kind: int  # a number of `KINDS`
    origin: npt.NDArray[np.float64]  # [3] subtracted from positions, for float32 resolution far from the world's origin


def arrays(scene: BakedSceneLike) -> Arrays:
    """Convert a scene. Raises TypeError: not float32. Raises ValueError: a view-colour parameter has a wrong shape, or
    a tile lies outside its page."""
    p = {name: value.detach().cpu() for name, value in scene.surfels.items()}
    for name, value in p.items():
        if value.dtype != torch.float32 and name != "view_span":
            raise TypeError(f"the WebGPU renderer takes float32 surfels, but {name} is {value.dtype}")
    n = len(scene.tiles)
    means = p["means"].double()
    seen = means[means.isfinite().all(1)]
    origin = (seen.amin(0) + seen.amax(0)) / 2 if len(seen) else torch.zeros(3, dtype=torch.float64)
    surfels = np.zeros(n, SURFEL)
    quats = torch.nn.functional.normalize(p["quats"].double(), dim=1, eps=1e-300)
    stored = {**p, "means": (means - origin).float(), "quats": quats.float()}
    for name in GEOMETRY:
        surfels[FIELDS[name]] = stored[name].numpy()
    surfels["extent"] = SUPPORT if scene.extent is None else scene.extent.detach().cpu().numpy()
    if scene.mean_residual is not None:
        surfels["residual"] = scene.mean_residual.detach().cpu().numpy()
    _set_tiles(surfels, scene)
    alpha = torch.ones(n) if scene.mean_alpha is None else scene.mean_alpha.detach().float().cpu()
    surfels["layer"] |= (128 * alpha).round().clamp(0, 255).numpy().astype(np.uint32) << 24
    kind, base, span, terms = _view_colors(scene.view_color, p, n)
    surfels["base"], surfels["first_term"], surfels["terms"] = base.numpy(), span[:, 0].numpy(), span[:, 1].numpy()
    _hide_broken(surfels, p)
    return Arrays(surfels, terms.numpy().ravel(), KINDS[kind], origin.numpy())


def _set_tiles(surfels: npt.NDArray, scene: BakedSceneLike) -> None:
    texels = scene.blocks if scene.atlas is None else scene.atlas
    if texels is None:
        return
    layers, height, width = texels.shape[:3]
    if scene.atlas is None:
        height, width = 4 * height, 4 * width
    tiles = scene.tiles.cpu().long()
    x, y, layer, columns, rows = tiles.unbind(1)
    good = (tiles >= 0).all(1) & (x + columns <= width) & (y + rows <= height) & (layer < layers) & (rows > 0)
    bad = (columns != 0) & ~good
    if bad.any():
        raise ValueError(f"the tile of surfel {int(bad.nonzero()[0])} does not lie on a page of the atlas")
    has = (columns > 0).numpy()
    surfels["tile"][has] = tiles[:, :2].numpy()[has]
    surfels["layer"][has] = layer.numpy()[has]
    surfels["sides"][has] = (columns + (rows << 16)).numpy()[has]


def _view_colors(kind: str, p: dict[str, Tensor], n: int) -> tuple[str, Tensor, Tensor, Tensor]:
    """Return form, base [N, 3], first term and number of terms [N, 2], and terms."""
    if "view_terms" in p:
        check_reduced(kind, p, n)
        base, span, terms = (p[name] for name in REDUCED)
        first, count = span.long().unbind(1)
        return kind, base, torch.stack([first * terms.shape[1], count], dim=1), terms
    check_view_color(kind, p, n)
    values = VIEW_COLORS[kind].of(p)
    whole = VIEW_COLORS[kind].sites is not None
    if whole:
        base = torch.zeros(n, 3)
        terms = torch.cat([values[0], values[1][..., None], values[2]], dim=2)
    else:
        base, terms = values
    count = torch.full((n,), terms.shape[1])
    first = torch.arange(n) * (terms.shape[1] * terms.shape[2])
    return kind + (WHOLE if whole else ""), base, torch.stack([first, count], dim=1), terms.contiguous()


def _hide_broken(surfels: npt.NDArray, p: dict[str, Tensor]) -> None:
    """Hide surfels with non-finite numbers or a zero rotation, so that shaders need not test for NaN."""
    geometry = torch.cat([p[name][..., None].flatten(1) for name in GEOMETRY], dim=1)
    broken = ~(geometry.isfinite().all(1) & (p["quats"].abs().amax(1) > 0)).numpy()
    for name in GEOMETRY:
        surfels[FIELDS[name]][broken] = 0
    surfels["opacity_logit"][broken] = -100
