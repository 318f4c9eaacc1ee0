"""Small scenes in float64 for tests and measurements: random ones, and ones of numbers that misbehave."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from bitymi_ns.ops import VIEW_COLORS
from bitymi_ns.scene.scene import GEOMETRY

SURFEL_KEYS = GEOMETRY
SV_KEYS = VIEW_COLORS["sv"].names


@dataclass
class SceneCase:
    """A scene and a camera, all float64."""

    name: str
    params: dict[str, Tensor]  # SURFEL_KEYS and SV_KEYS, as in docs/overview.md
    viewmat: Tensor  # [4, 4]
    K: Tensor  # [3, 3]
    width: int
    height: int
    background: Tensor  # [3]
    tiles: list[Tensor] | None = None  # one [r_v, r_u, 3] a surfel
    single: bool = True  # float32 is expected to agree with float64; if not, only to stay finite


def random_scene(
    n: int, seed: int, width: int = 48, height: int = 36, scale: float = 0.25, name: str = "random"
) -> SceneCase:
    """n surfels of about `scale` units at depths 2 to 6 in front of a camera with an oblique pose and fx != fy."""
    g = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=g, dtype=torch.float64)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(*shape, generator=g, dtype=torch.float64)

    axes = torch.linalg.qr(normal(3, 3)).Q
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = axes * torch.sign(torch.linalg.det(axes))
    viewmat[:3, 3] = normal(3)
    K = torch.tensor([[1.1 * width, 0, 0.52 * width], [0, 1.0 * width, 0.47 * height], [0, 0, 1]], dtype=torch.float64)
    depth = uniform(2, 6, n)
    pixel = torch.stack([uniform(0, width, n), uniform(0, height, n), torch.ones(n, dtype=torch.float64)], dim=-1)
    camera = pixel @ torch.linalg.inv(K).T * depth[:, None]
    params = {
        "means": (camera - viewmat[:3, 3]) @ viewmat[:3, :3],
        "quats": normal(n, 4),
        "log_scales": math.log(scale) + 0.5 * normal(n, 2),
        "opacity_logits": normal(n),
        "beta_raw": normal(n),
        **dict(zip(SV_KEYS, (normal(n, 7, 3), normal(n, 7), 0.3 * normal(n, 7, 3)), strict=True)),
    }
    background = torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64)
    return SceneCase(name, params, viewmat, K, width, height, background)


def front_scene(n: int, seed: int, width: int = 24, height: int = 16, **kwargs: float) -> SceneCase:
    """A random scene seen by a camera at the origin without rotation, so that camera coordinates are world ones."""
    case = random_scene(n, seed, width, height, **kwargs)
    case.params["means"] = case.params["means"] @ case.viewmat[:3, :3].T + case.viewmat[:3, 3]
    case.viewmat = torch.eye(4, dtype=torch.float64)
    return case


def with_params(case: SceneCase, name: str, single: bool = True, **params: Tensor | float) -> SceneCase:
    """The case renamed, with some parameters replaced (a number fills the whole parameter)."""
    new = {key: value.clone() for key, value in case.params.items()}
    for key, value in params.items():
        new[key] = torch.full_like(new[key], value) if isinstance(value, int | float) else value
    return replace(case, name=name, params=new, single=single)


def extreme_scenes() -> list[SceneCase]:
    """Finite inputs that break renderers: whatever is drawn must be finite, gradients too."""
    base = front_scene(12, 0)
    means, zero = base.params["means"], torch.zeros(12, dtype=torch.float64)
    cases = []

    # axis u along the ray, v along the camera's y axis where possible: the ray lies in the disc's plane
    along = torch.nn.functional.normalize(means, dim=-1)
    side = torch.nn.functional.normalize(
        torch.linalg.cross(along, torch.tensor([[0.3, 1.0, 0.2]]).double().expand(12, 3))
    )
    R = torch.stack([along, torch.linalg.cross(side, along), side], dim=-1)
    cases.append(with_params(base, "edge_on", single=False, quats=quaternions(R)))

    big = torch.full((12, 2), math.log(3.0), dtype=torch.float64)
    cases.append(with_params(base, "through_the_camera_plane", means=means * 0.3, log_scales=big))
    cases.append(with_params(base, "behind_the_camera", means=-means))
    on_plane = means.clone()
    on_plane[:, 2] = 0.2
    cases.append(with_params(base, "centre_on_the_near_plane", single=False, means=on_plane))
    cases.append(with_params(base, "surfel_on_the_camera_centre", means=torch.zeros_like(means)))

    cases.append(with_params(base, "subpixel", log_scales=math.log(1e-4)))
    cases.append(with_params(base, "screen_filling", single=False, log_scales=math.log(1e3)))
    ratio = torch.stack([zero, zero - math.log(1e6)], dim=-1)
    cases.append(with_params(base, "axis_ratio_1e6", single=False, log_scales=ratio))
    cases.append(with_params(base, "zero_scales", single=False, log_scales=-200.0))
    cases.append(with_params(base, "huge_scales", single=False, log_scales=20.0))
    some_zero = base.params["quats"].clone()
    some_zero[::2] = 0
    cases.append(with_params(base, "zero_quaternions", quats=some_zero))
    cases.append(with_params(base, "tiny_quaternions", quats=base.params["quats"] * 1e-15))
    cases.append(with_params(base, "long_quaternions", quats=base.params["quats"] * 1e15))

    cases.append(with_params(base, "opacity_0", opacity_logits=-100.0))
    cases.append(with_params(base, "opacity_1_255", single=False, opacity_logits=-math.log(254.0)))
    cases.append(with_params(base, "opacity_1", opacity_logits=100.0))
    cases.append(with_params(base, "beta_0", single=False, beta_raw=-100.0))
    cases.append(with_params(base, "beta_small", beta_raw=-6.0))
    cases.append(with_params(base, "beta_4", beta_raw=100.0))

    cases.append(with_params(base, "temperature_1e4", single=False, sv_log_tau=math.log(1e4)))
    cases.append(with_params(base, "temperature_0", sv_log_tau=-100.0))
    cases.append(with_params(base, "sites_of_length_0", sv_sites=0.0))

    crowd = front_scene(3000, 1, 2, 2)
    at_center = torch.tensor([0.0, 0.0, 4.0], dtype=torch.float64) + 1e-3 * crowd.params["means"]
    cases.append(with_params(crowd, "thousands_on_one_pixel", means=at_center, opacity_logits=-5.0))
    level = means.clone()
    level[:, 2] = 4.0
    cases.append(with_params(base, "equal_depths", means=level))
    same = {key: value[:1].expand_as(value).clone() for key, value in base.params.items()}
    cases.append(with_params(base, "identical_surfels", **same))

    cases.append(
        with_params(base, "coordinates_1e6", means=means * 1e6, log_scales=base.params["log_scales"] + math.log(1e6))
    )
    offset = torch.tensor([1e6, -1e6, 1e6], dtype=torch.float64)
    shifted = with_params(base, "camera_at_1e6", single=False, means=means + offset)
    shifted.viewmat = base.viewmat.clone()
    shifted.viewmat[:3, 3] = -offset
    cases.append(shifted)

    none = {key: value[:0] for key, value in base.params.items()}
    cases.append(with_params(base, "no_surfels", **none))
    for width, height in ((1, 1), (8192, 1), (1, 8192)):
        cases.append(replace(front_scene(12, 2, width, height), name=f"image_{width}x{height}"))
    return cases


def quaternions(R: Tensor) -> Tensor:
    """Quaternions wxyz [N, 4] of rotation matrices [N, 3, 3]: the eigenvector of the largest eigenvalue of a 4 x 4."""
    xx, xy, xz, yx, yy, yz, zx, zy, zz = R.flatten(1).unbind(-1)
    rows = [
        torch.stack([xx + yy + zz, zy - yz, xz - zx, yx - xy], -1),
        torch.stack([zy - yz, xx - yy - zz, xy + yx, xz + zx], -1),
        torch.stack([xz - zx, xy + yx, yy - xx - zz, yz + zy], -1),
        torch.stack([yx - xy, xz + zx, yz + zy, zz - xx - yy], -1),
    ]
    return torch.linalg.eigh(torch.stack(rows, -2)).eigenvectors[..., -1]
