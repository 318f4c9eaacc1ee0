"""Small float64 scenes for tests and measurements: random, numerically extreme, and in sweeps of one stiffness."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import torch
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.nn.functional import normalize

from bitymi_ns.ops import VIEW_COLORS, TexelTiles
from bitymi_ns.ops.constants import SUPPORT

SV_KEYS = VIEW_COLORS["sv"].names


@dataclass
class SceneCase:
    """A scene and a camera, all float64."""

    name: str
    params: dict[str, Tensor]  # GEOMETRY and SV_KEYS, as in docs/overview.md
    viewmat: Tensor  # [4, 4]
    K: Tensor  # [3, 3]
    width: int
    height: int
    background: Tensor  # [3]
    tiles: list[Tensor] | None = None  # one [r_v, r_u, 3] per surfel


def random_scene(
    n: int, seed: int, width: int = 48, height: int = 36, scale: float = 0.25, name: str = "random"
) -> SceneCase:
    """Generate n surfels of about `scale` units at depths 2 to 6 before an oblique camera with fx != fy."""
    g = torch.Generator().manual_seed(seed)
    normal = partial(torch.randn, generator=g, dtype=torch.float64)
    uniform = partial(torch.rand, generator=g, dtype=torch.float64)
    axes = torch.linalg.qr(normal(3, 3)).Q
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = axes * torch.sign(torch.linalg.det(axes))
    viewmat[:3, 3] = normal(3)
    K = torch.tensor([[1.1 * width, 0, 0.52 * width], [0, 1.0 * width, 0.47 * height], [0, 0, 1]], dtype=torch.float64)
    depth = 2 + 4 * uniform(n)
    pixel = torch.stack([width * uniform(n), height * uniform(n), torch.ones(n, dtype=torch.float64)], dim=-1)
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


def front_scene(
    n: int, seed: int, width: int = 24, height: int = 16, scale: float = 0.25, name: str = "random"
) -> SceneCase:
    """Generate a random scene before a camera whose frame is the world frame."""
    case = random_scene(n, seed, width, height, scale, name)
    case.params["means"] = case.params["means"] @ case.viewmat[:3, :3].T + case.viewmat[:3, 3]
    case.viewmat = torch.eye(4, dtype=torch.float64)
    return case


def changed(case: SceneCase, name: str = "", /, **params: Tensor | float) -> SceneCase:
    """Copy and rename a case with some parameters replaced; a number fills the whole parameter."""
    new = {key: value.clone() for key, value in case.params.items()}
    for key, value in params.items():
        new[key] = torch.full_like(new[key], value) if isinstance(value, int | float) else value
    return replace(case, name=name, params=new)


def quaternions(R: Tensor) -> Tensor:
    """Convert rotation matrices [N, 3, 3] to quaternions wxyz [N, 4]."""
    return torch.from_numpy(Rotation.from_matrix(R.numpy()).as_quat()[:, [3, 0, 1, 2]])


def rays_and_sides(means: Tensor) -> tuple[Tensor, Tensor]:
    """Compute the directions of the rays from the origin to centres [N, 3], and perpendicular ones."""
    rays = normalize(means, dim=-1)
    helper = torch.tensor([[0.3, 1.0, 0.2]], dtype=torch.float64).expand_as(rays)
    return rays, normalize(torch.linalg.cross(rays, helper), dim=-1)


def extreme_scenes() -> list[SceneCase]:
    """Build scenes of finite inputs that break renderers."""
    base = front_scene(12, 0)
    means, logs, quats = (base.params[key] for key in ("means", "log_scales", "quats"))

    # axis u along the ray, which lies in the disc's plane
    along, side = rays_and_sides(means)
    edge_on = quaternions(torch.stack([along, torch.linalg.cross(side, along), side], dim=-1))
    on_plane, level, some_zero = means.clone(), means.clone(), quats.clone()
    on_plane[:, 2] = 0.2
    level[:, 2] = 4.0
    some_zero[::2] = 0
    thin = torch.tensor([0.0, -math.log(1e6)], dtype=torch.float64).expand(12, 2)
    crowd = front_scene(3000, 1, 2, 2)
    at_center = torch.tensor([0.0, 0.0, 4.0], dtype=torch.float64) + 1e-3 * crowd.params["means"]
    offset = torch.tensor([1e6, -1e6, 1e6], dtype=torch.float64)
    shifted = changed(base, "camera_at_1e6", means=means + offset)
    shifted.viewmat = base.viewmat.clone()
    shifted.viewmat[:3, 3] = -offset
    return [
        changed(base, "edge_on", quats=edge_on),
        changed(base, "through_the_camera_plane", means=means * 0.3, log_scales=math.log(3.0)),
        changed(base, "behind_the_camera", means=-means),
        changed(base, "centre_on_the_near_plane", means=on_plane),
        changed(base, "surfel_on_the_camera_centre", means=0.0),
        changed(base, "subpixel", log_scales=math.log(1e-4)),
        changed(base, "screen_filling", log_scales=math.log(1e3)),
        changed(base, "axis_ratio_1e6", log_scales=thin),
        changed(base, "zero_scales", log_scales=-200.0),
        changed(base, "huge_scales", log_scales=20.0),
        changed(base, "zero_quaternions", quats=some_zero),
        changed(base, "tiny_quaternions", quats=quats * 1e-15),
        changed(base, "long_quaternions", quats=quats * 1e15),
        changed(base, "opacity_0", opacity_logits=-100.0),
        changed(base, "opacity_1_255", opacity_logits=-math.log(254.0)),
        changed(base, "opacity_1", opacity_logits=100.0),
        changed(base, "beta_0", beta_raw=-100.0),
        changed(base, "beta_small", beta_raw=-6.0),
        changed(base, "beta_4", beta_raw=100.0),
        changed(base, "temperature_1e4", sv_log_tau=math.log(1e4)),
        changed(base, "temperature_0", sv_log_tau=-100.0),
        changed(base, "sites_of_length_0", sv_sites=0.0),
        changed(crowd, "thousands_on_one_pixel", means=at_center, opacity_logits=-5.0),
        changed(base, "equal_depths", means=level),
        changed(base, "identical_surfels", **{k: v[:1].expand_as(v).clone() for k, v in base.params.items()}),
        changed(base, "coordinates_1e6", means=means * 1e6, log_scales=logs + math.log(1e6)),
        shifted,
        changed(base, "no_surfels", **{key: value[:0] for key, value in base.params.items()}),
        *(front_scene(12, 2, w, h, name=f"image_{w}x{h}") for w, h in ((1, 1), (8192, 1), (1, 8192))),
    ]


@dataclass(frozen=True)
class Sweep:
    """Scenes along one kind of stiffness, which differ in nothing else."""

    name: str
    axis: str  # quantity with its unit
    values: tuple[float, ...]  # from easy to hard
    make: Callable[[float], SceneCase]  # builds the scene of a value
    near: Callable[[float], float] = lambda value: 0.2  # near plane for a value


def decades(first: int, last: int) -> tuple[float, ...]:
    step = 1 if last > first else -1
    return tuple(10.0**k for k in range(first, last + step, step))


small = partial(front_scene, 16)


def _edge_on(angle: float) -> SceneCase:
    """Build discs whose planes make this angle with the ray through their centres."""
    base = small(0, scale=0.5)
    ray, side = rays_and_sides(base.params["means"])
    along = math.cos(angle) * ray + math.sin(angle) * torch.linalg.cross(side, ray)
    rotation = torch.stack([along, side, torch.linalg.cross(along, side)], dim=-1)
    return changed(base, quats=quaternions(rotation))


def _camera_plane(depth: float) -> SceneCase:
    """Build discs of scale 0.5 with centres at 0.5 to 1.5 times this depth, in scales."""
    base = small(1, scale=0.5)
    return changed(base, means=base.params["means"] * (0.5 * depth / 4.0))


def _axis_ratio(ratio: float) -> SceneCase:
    base = small(4, scale=0.8)
    logs = base.params["log_scales"][:, :1]
    return changed(base, log_scales=torch.cat([logs, logs - math.log(ratio)], 1))


def _world(size: float) -> SceneCase:
    """Build a scene and an oblique camera moved away from the origin, where float32 positions are coarse."""
    base = random_scene(16, 5, 24, 16)
    shift = size * torch.tensor([0.6, -0.7, 0.39], dtype=torch.float64)
    viewmat = base.viewmat.clone()
    viewmat[:3, 3] -= viewmat[:3, :3] @ shift
    return replace(changed(base, means=base.params["means"] + shift), viewmat=viewmat)


def _layers(count: float) -> SceneCase:
    """Build large overlapping discs, so faint that all of them are blended."""
    opacity = min(0.5, max(0.006, 6.0 / count))
    return changed(front_scene(int(count), 7, 8, 6, scale=2.0), opacity_logits=math.log(opacity / (1 - opacity)))


BETAS, CLEAR = (3.9, 1.0, *decades(-1, -7)), (0.5, *decades(-1, -7))
SWEEPS = (
    Sweep("edge-on", "angle between ray and disc [rad]", decades(0, -7), _edge_on),
    Sweep("camera plane", "depth of the centres / scale", decades(1, -6), _camera_plane, near=lambda d: 0.05 * d),
    Sweep("beta", "beta", BETAS, lambda beta: changed(small(2), beta_raw=math.log(beta) - math.log(4 - beta))),
    Sweep("temperature", "temperature", decades(0, 6), lambda tau: changed(small(3), sv_log_tau=math.log(tau))),
    Sweep("axis ratio", "axis ratio", decades(0, 6), _axis_ratio),
    Sweep("world size", "distance from the origin / size of the scene", decades(0, 6), _world),
    Sweep("opacity", "1 - opacity", CLEAR, lambda p: changed(small(6), opacity_logits=math.log1p(-p) - math.log(p))),
    Sweep("layers", "layers", (1, 4, 16, 64, 256, 1024), _layers),
)


RIM = 1e-3  # `SceneConfig.rim`, in backend and reference
TEXELS, ALPHAS = "texels", "texel_alpha"  # parameters of a case
TILE = (8, 4)  # texels of a tile along u and v
ON_A_TEXEL = 1e-6  # distance from a texel's centre, in tiles, below which rounding decides the cell


@dataclass(frozen=True)
class Way:
    """A rendering mode, measured on the same scenes."""

    name: str
    texels: bool = False  # each surfel has a tile of random texels
    alpha: bool = False  # the texels have random alphas from 0 to 2, without a weight bound

    def of(self, case: SceneCase) -> SceneCase:
        """Add the texels to a case."""
        if not self.texels:
            return case
        n = len(case.params["means"])
        g = torch.Generator().manual_seed(7)
        texels = {TEXELS: 0.2 * torch.randn(n * TILE[0] * TILE[1], 3, generator=g, dtype=torch.float64)}
        if self.alpha:
            texels[ALPHAS] = 2.0 * torch.rand(len(texels[TEXELS]), 1, generator=g, dtype=torch.float64)
        return replace(case, params={**case.params, **texels})


PLAIN = Way("plain")
WAYS = (Way(TEXELS, texels=True), Way("alpha", texels=True, alpha=True))


def tiles_of(texels: Tensor) -> TexelTiles:
    n = len(texels) // (TILE[0] * TILE[1])
    size = torch.tensor(TILE, dtype=torch.int32, device=texels.device).expand(n, 2)
    return TexelTiles.of_sizes(size, texels.new_full((n,), float(SUPPORT)))


def tile_images(texels: Tensor) -> list[Tensor]:
    """Split texels [T, C] into one image [r_v, r_u, C] per surfel."""
    return list(texels.view(-1, TILE[1], TILE[0], texels.shape[1]).unbind())


def cells(uv: Tensor) -> Tensor:
    """Find the cell between texel centres, where the slope of the bilinear fetch is constant, of coordinates [..., 2]:
    index [...] int64, or -1 if rounding decides it."""
    size = torch.tensor(TILE, dtype=torch.float64, device=uv.device)
    place = (uv.detach().double().clamp(-SUPPORT, SUPPORT) + SUPPORT) / (2 * SUPPORT) * size - 0.5  # -0.5 to size - 0.5
    column, row = (place.floor().long() + 1).unbind(-1)
    decided = ((place - place.round()).abs() > ON_A_TEXEL * size).all(-1)
    return torch.where(decided, column + (TILE[0] + 1) * row, -1)
