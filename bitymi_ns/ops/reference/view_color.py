"""View-dependent surfel colour in float64: Spherical Voronoi, spherical harmonics, Spherical Beta, Gaussians.

`dirs` are unit view directions [N, 3], world frame, from the camera to the surfel; colours are [N, 3].
"""

import math

import torch
from torch import Tensor
from torch.nn import functional as F

from .project import unit

SOFTPLUS_BETA = 10 * math.log(2)


def sv(sites: Tensor, log_tau: Tensor, rgb: Tensor, dirs: Tensor) -> Tensor:
    """Evaluate Spherical Voronoi: sum_k softmax_k(tau_k s_k . d) rgb_k, with tau = exp(log_tau) (Di Sario et al. 2025).

    Args:
        sites: [N, K, 3] site vectors, normalised to s_k; a site of length 0 has logit 0.
        log_tau: [N, K] natural logarithm of the temperatures.
        rgb: [N, K, 3].
    """
    logits = log_tau.exp() * (unit(sites) * dirs[:, None]).sum(-1)  # [N, K]
    return (torch.softmax(logits, dim=-1)[..., None] * rgb).sum(1)


def sh_basis(degree: int, dirs: Tensor) -> Tensor:
    """Evaluate real spherical harmonics up to degree 3: [N, (degree + 1)^2], in the order l, m = -l .. l, with the
    Condon-Shortley sign (-1)^m, as in 3DGS: Y_1 = sqrt(3 / 4 pi) (-y, z, -x)."""
    x, y, z = dirs.unbind(-1)
    pi = math.pi
    basis = [torch.full_like(x, math.sqrt(1 / (4 * pi)))]
    if degree >= 1:
        a = math.sqrt(3 / (4 * pi))
        basis += [-a * y, a * z, -a * x]
    if degree >= 2:
        a = math.sqrt(15 / (4 * pi))
        basis += [
            a * x * y,
            -a * y * z,
            math.sqrt(5 / (16 * pi)) * (3 * z * z - 1),
            -a * x * z,
            a / 2 * (x * x - y * y),
        ]
    if degree >= 3:
        a = math.sqrt(35 / (32 * pi))
        b = math.sqrt(105 / (4 * pi))
        c = math.sqrt(21 / (32 * pi))
        basis += [
            -a * y * (3 * x * x - y * y),
            b * x * y * z,
            -c * y * (5 * z * z - 1),
            math.sqrt(7 / (16 * pi)) * z * (5 * z * z - 3),
            -c * x * (5 * z * z - 1),
            b / 2 * z * (x * x - y * y),
            -a * x * (x * x - 3 * y * y),
        ]
    return torch.stack(basis, dim=-1)


def sh(dc: Tensor, rest: Tensor, dirs: Tensor) -> Tensor:
    """Evaluate spherical harmonics from dc [N, 3] and rest [N, (degree + 1)^2 - 1, 3]."""
    coefficients = torch.cat([dc[:, None], rest], dim=1)
    degree = math.isqrt(coefficients.shape[1]) - 1
    return (sh_basis(degree, dirs)[..., None] * coefficients).sum(1)


def sb(base: Tensor, lobes: Tensor, dirs: Tensor) -> Tensor:
    """Evaluate Spherical Beta: base + sum_k softplus(rgb_k) max(0, d . mu_k)^(4 exp(b_k)) (DBS: Liu et al. 2025).

    mu = (sin t cos p, sin t sin p, cos t); softplus(x) = log(1 + exp(a x)) / a with a = 10 ln 2, so softplus(0) = 0.1.

    `base`: [N, 3]; `lobes`: [N, K, 6], columns r, g, b, theta, phi, b.
    """
    theta, phi, b = lobes[..., 3], lobes[..., 4], lobes[..., 5]  # [N, K]
    mu = torch.stack([theta.sin() * phi.cos(), theta.sin() * phi.sin(), theta.cos()], dim=-1)  # [N, K, 3]
    cosine = (mu * dirs[:, None]).sum(-1)
    lit = cosine > 0
    falloff = torch.where(lit, torch.where(lit, cosine, 1.0) ** (4 * b.exp()), 0.0)
    return base + (F.softplus(lobes[..., :3], beta=SOFTPLUS_BETA) * falloff[..., None]).sum(1)


def sg(base: Tensor, lobes: Tensor, dirs: Tensor) -> Tensor:
    """Evaluate Spherical Gaussians: base + sum_k rgb_k exp(exp(l_k) (d . mu_k - 1)), mu_k a unit vector.

    `base`: [N, 3]; `lobes`: [N, K, 7], columns mu (3, any length), l = log sharpness, r, g, b.
    """
    cosine = (unit(lobes[..., :3]) * dirs[:, None]).sum(-1)  # [N, K]
    falloff = torch.exp(lobes[..., 3].exp() * (cosine - 1))
    return base + (lobes[..., 4:] * falloff[..., None]).sum(1)


def reduced(kind: str, base: Tensor, span: Tensor, terms: Tensor, dirs: Tensor) -> Tensor:
    """Evaluate reduced view colours, with a varying number of terms per surfel.

    sv: (base + sum_k exp(b_k . d) rgb_k) / (1 + sum_k exp(b_k . d)), a term is b, rgb: Spherical Voronoi relative to
    its first site. sh: base is dc, terms are the coefficients from degree 1 on. sb, sg: base plus lobes.

    Args:
        base: [N, 3].
        span: [N, 2] first term and number of terms.
        terms: [T, 6] (sv, sb), [T, 3] (sh) or [T, 7] (sg).
    """
    out = []
    for color, (first, count), d in zip(base, span.tolist(), dirs, strict=True):
        own = terms[first : first + count]
        if kind == "sv":
            weights = torch.softmax(torch.cat([own.new_zeros(1), own[:, :3] @ d]), dim=0)
            out.append(weights @ torch.cat([color[None], own[:, 3:]]))
        else:
            out.append({"sh": sh, "sb": sb, "sg": sg}[kind](color[None], own[None], d[None])[0])
    return torch.stack(out) if out else base


def view_directions(means: Tensor, viewmat: Tensor) -> Tensor:
    """Compute `dirs` from the surfels' centres [N, 3] and a camera [4, 4]; differentiable."""
    return unit(means + viewmat[:3, :3].T @ viewmat[:3, 3])
