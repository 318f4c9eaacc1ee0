"""Kinds of view colour: an entry of `VIEW_COLORS` holds all that depends on the kind, except the evaluation
(csrc/core/view_kinds.h, and in float64 `ops.reference.view_color`)."""

import math
from collections.abc import Callable, Collection
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, get_args

import torch
from torch import Tensor
from torch.nn import functional as F

from .constants import LOG_TAU_MAX, MAX_TERMS, SH_C0
from .parameters import GEOMETRY_PARAMETERS, SHAPE_LIMIT, Limit, Parameter, Tensors

COLOR_LIMIT = 256.0  # of colours and of coefficients and lobes' colours, 1 = white
DIRECTION_LIMIT = 1e6  # of unnormalised directions
VECTOR_LIMIT = 2e7  # of differences of two unit vectors, each times a temperature of at most exp(16)


@dataclass(frozen=True)
class ViewColor:
    """A kind of view colour.

    A term is a site, a coefficient or a lobe. Reduced colours (`ops.view_color.REDUCED`) have a base colour and a
    varying number of terms per surfel.
    """

    title: str  # display name
    # term, kept: name of a term, and heading of the number of terms in a bundle, base colours included
    term: str
    kept: str
    parameters: tuple[Parameter, ...]  # two or three, in the kernels' order; the second has one row per term
    counts: Collection[int]  # allowed numbers of terms
    rule: str  # the same in words, for messages, counting rows of the second parameter
    base_terms: int  # terms that the base of a reduced colour replaces: 1, or 0 if it is additional
    option: str  # option of `SceneConfig` for the number of terms,
    terms_of: Callable[[int], int]  # and the number of terms for its value
    # initial parameters from colours [N, 3] less `COLOR_BIAS`, the number of terms and a random generator; f_view is
    # that colour in every direction, or on average
    start: Callable[[Tensor, int, torch.Generator], tuple[Tensor, ...]]
    reduced_width: int  # numbers of a reduced term
    reduced_limit: Limit  # of a reduced term, allowed in a bundle
    reduced_formula: str  # evaluation of a reduced colour, for bundle.json
    reduced_counts: Collection[int] = range(MAX_TERMS + 1)  # allowed numbers of reduced terms of a surfel
    base_unit: float = 1.0  # colour for a base of 1
    # mean of f_view over all directions [N, 3] from the parameters, for display; None: no closed form
    mean: Callable[..., Tensor] | None = None
    # v and rgb [N, K, 3] of the form softmax_k(v_k . d) rgb_k, from the parameters, of which the bake can fit fewer;
    # None: no such form, a surfel keeps all terms or one colour
    sites: Callable[..., tuple[Tensor, Tensor]] | None = None
    stated: str | None = None  # key for the number of terms in bundle.json's surfels; None: not stated

    @cached_property
    def names(self) -> tuple[str, ...]:
        return tuple(parameter.name for parameter in self.parameters)

    @property
    def _in_first(self) -> int:
        """Terms in the first parameter: 1 for sh, whose dc is the coefficient of degree 0."""
        return 0 if -1 in self.parameters[0].shape else self.base_terms

    def of(self, params: Tensors) -> list[Tensor]:
        """Select the parameters from all of the surfels'."""
        return [params[name] for name in self.names]

    def terms(self, params: Tensors) -> int:
        return params[self.names[1]].shape[1] + self._in_first

    def shapes(self, terms: int) -> list[tuple[int, ...]]:
        """List the row shapes of the parameters."""
        rows = terms - self._in_first
        return [tuple(rows if size < 0 else size for size in p.shape) for p in self.parameters]

    def problem(self, terms: int) -> str | None:
        """Explain why a number of terms is not allowed; None if it is."""
        return None if terms in self.counts else f"{self.rule}, not {terms - self._in_first}"

    def first_values(self, color: Tensor, config: Any, generator: torch.Generator) -> dict[str, Tensor]:
        """Initialise the parameters (`start`); `config` is a `SceneConfig`."""
        values = self.start(color, self.terms_of(getattr(config, self.option)), generator)
        return dict(zip(self.names, values, strict=True))


def _sv_start(color: Tensor, sites: int, generator: torch.Generator) -> tuple[Tensor, ...]:
    n = len(color)
    return (
        fibonacci_sphere(sites).expand(n, sites, 3).clone(),
        torch.zeros(n, sites),
        color[:, None, :].repeat(1, sites, 1),
    )


def _sv_sites(sites: Tensor, log_tau: Tensor, rgb: Tensor) -> tuple[Tensor, Tensor]:
    return F.normalize(sites, dim=2) * log_tau.clamp(max=LOG_TAU_MAX).exp()[..., None], rgb


def _sh_start(color: Tensor, terms: int, generator: torch.Generator) -> tuple[Tensor, ...]:
    return color / SH_C0, torch.zeros(len(color), terms - 1, 3)


def _sb_start(color: Tensor, lobes: int, generator: torch.Generator) -> tuple[Tensor, ...]:
    # softplus maps raw colour 0 to 0.1, which keeps the gradient alive; the base compensates
    shape = torch.zeros(len(color), lobes, 6)
    shape[..., 3] = math.pi * torch.rand(len(color), lobes, generator=generator)
    shape[..., 4] = 2.0 * math.pi * torch.rand(len(color), lobes, generator=generator)
    return color - _SB_LOBE_MEAN * lobes, shape


_SB_LOBE_MEAN = 0.1 * 0.1
"""Mean of a new Spherical Beta lobe over the sphere: softplus(0) = 0.1 times the mean 0.1 of max(0, cos)^4."""


def _sb_mean(base: Tensor, lobes: Tensor) -> Tensor:
    """Average over the sphere: max(0, d.mu)^p has the mean 1 / (2 (p + 1))."""
    power = 4.0 * lobes[..., 5].exp()
    rgb = F.softplus(lobes[..., :3], beta=10.0 * math.log(2.0))
    return base + (rgb / (2.0 * (power + 1.0))[..., None]).sum(1)


def _sg_start(color: Tensor, lobes: int, generator: torch.Generator) -> tuple[Tensor, ...]:
    n = len(color)
    axes = F.normalize(torch.randn(n, lobes, 3, generator=generator), dim=-1)
    # log sharpness 1, colour 0
    return color.clone(), torch.cat([axes, torch.ones(n, lobes, 1), torch.zeros(n, lobes, 3)], -1)


def _sg_mean(base: Tensor, lobes: Tensor) -> Tensor:
    """Average over the sphere: exp(l (d.mu - 1)) has the mean (1 - exp(-2l)) / 2l."""
    sharpness = lobes[..., 3].exp().clamp(1e-6, 1e6)
    mean = -torch.expm1(-2.0 * sharpness) / (2.0 * sharpness)
    return base + (lobes[..., 4:] * mean[..., None]).sum(1)


_COLOR: Limit = (COLOR_LIMIT,)
_BETA_LOBE: Limit = (*[COLOR_LIMIT] * 3, *[SHAPE_LIMIT] * 3)
_GAUSSIAN_LOBE: Limit = (*[DIRECTION_LIMIT] * 3, SHAPE_LIMIT, *[COLOR_LIMIT] * 3)


def _with_lobes(
    title: str,
    name: str,
    limit: Limit,
    start: Callable[[Tensor, int, torch.Generator], tuple[Tensor, ...]],
    mean: Callable[[Tensor, Tensor], Tensor],
) -> ViewColor:
    return ViewColor(
        title=title,
        term="lobe",
        kept="Lobes and base colours",
        parameters=(
            Parameter(f"{name}_base", (3,), _COLOR, "view_color"),
            Parameter(f"{name}_lobes", (-1, len(limit)), limit, "view_shape"),
        ),
        counts=range(MAX_TERMS + 1),
        rule=f"{title} colours have at most {MAX_TERMS} lobes per surfel",
        base_terms=0,
        option="lobes",
        terms_of=int,
        start=start,
        reduced_width=len(limit),
        reduced_limit=limit,
        reduced_formula="view_base is the base colour, a term is a lobe",
        mean=mean,
    )


VIEW_COLORS: dict[str, ViewColor] = {
    "sv": ViewColor(
        title="Spherical Voronoi",
        term="site",
        kept="Sites",
        parameters=(
            Parameter("sv_sites", (-1, 3), (DIRECTION_LIMIT,), "view_shape", activation="unit"),
            Parameter("sv_log_tau", (-1,), (SHAPE_LIMIT,), "view_shape", activation="exp"),
            Parameter("sv_rgb", (-1, 3), _COLOR, "view_color"),
        ),
        counts=range(1, MAX_TERMS + 1),
        rule=f"Spherical Voronoi colours need 1 to {MAX_TERMS} sites per surfel",
        base_terms=1,
        option="sv_sites",
        terms_of=int,
        start=_sv_start,
        reduced_width=6,  # b, rgb relative to the first site
        reduced_limit=(*[VECTOR_LIMIT] * 3, *[COLOR_LIMIT] * 3),
        reduced_formula="(view_base + sum exp(b . d) rgb) / (1 + sum exp(b . d)); a term is b, rgb; d from the camera "
        "to the surfel",
        sites=_sv_sites,
        stated="sites",
    ),
    "sh": ViewColor(
        title="Spherical harmonics",
        term="coefficient",
        kept="Coefficients",
        parameters=(
            Parameter("sh_dc", (3,), _COLOR, "view_color"),
            Parameter("sh_rest", (-1, 3), _COLOR, "view_color", rate_factor=1.0 / 20.0),
        ),
        counts=(1, 4, 9, 16),
        rule="sh_rest must hold 0, 3, 8 or 15 coefficients",
        base_terms=1,
        option="sh_degree",
        terms_of=lambda degree: (degree + 1) ** 2,
        start=_sh_start,
        reduced_width=3,  # the coefficients of one function, from degree 1 on
        reduced_limit=_COLOR,
        reduced_counts=(0, 3, 8, 15),
        reduced_formula="view_base is the coefficient of degree 0, terms are those that follow",
        base_unit=SH_C0,
        mean=lambda dc, rest: dc * SH_C0,
    ),
    "sb": _with_lobes("Spherical Beta", "sb", _BETA_LOBE, _sb_start, _sb_mean),
    "sg": _with_lobes("Spherical Gaussian", "sg", _GAUSSIAN_LOBE, _sg_start, _sg_mean),
}
"""Kinds by name."""
PARAMETERS: dict[str, Parameter] = {
    **GEOMETRY_PARAMETERS,
    **{p.name: p for kind in VIEW_COLORS.values() for p in kind.parameters},
}
"""All parameters of a surfel by name, with the view colours of all kinds."""
Kind = Literal["sv", "sh", "sb", "sg"]
"""Names of `VIEW_COLORS`, for options and files checked by type."""


def entry_of(kind: str) -> ViewColor:
    """Return the entry of a kind. Raises ValueError: unknown kind."""
    if kind not in VIEW_COLORS:
        raise ValueError(f"unknown view colour '{kind}': choose one of {', '.join(VIEW_COLORS)}")
    return VIEW_COLORS[kind]


def kind_of(params: Tensors) -> Kind:
    """Return the kind whose parameters are complete. Raises ValueError: no kind is."""
    for kind in get_args(Kind):
        if all(name in params for name in VIEW_COLORS[kind].names):
            return kind
    raise ValueError(f"no view colour among the surfels' parameters {sorted(name for name, _ in params.items())}")


def fibonacci_sphere(n: int) -> Tensor:
    """Return unit vectors [n, 3] float32, evenly distributed along a Fibonacci spiral."""
    i = torch.arange(n, dtype=torch.float64)
    z = 1.0 - (2.0 * i + 1.0) / n
    phi = i * math.pi * (3.0 - math.sqrt(5.0))
    r = torch.sqrt(1.0 - z * z)
    return torch.stack([r * torch.cos(phi), r * torch.sin(phi), z], -1).float()
