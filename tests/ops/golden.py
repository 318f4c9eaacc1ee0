"""Golden renders and their drawing; other scenes are in bitymi_ns.measure.stability."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from bitymi_ns import ops
from bitymi_ns.measure.stability.scenes import SceneCase, quaternions, random_scene
from bitymi_ns.ops.parameters import GEOMETRY
from bitymi_ns.ops.reference import project as reference_project
from bitymi_ns.ops.reference import trace as reference_trace
from bitymi_ns.ops.reference.render import texel
from bitymi_ns.ops.reference.trace import SUPPORT
from bitymi_ns.scene import Camera

GOLDEN = Path(__file__).resolve().parent.parent / "golden"
GOLDEN_NAMES = sorted(path.stem for path in GOLDEN.glob("*.npz"))


@dataclass
class Golden(SceneCase):
    """A golden render: case, images, and gradients of loss = sum of loss_weights[k] * outputs[k]."""

    outputs: dict[str, Tensor] = field(default_factory=dict)  # rgb, alpha, depth, beta_map, overdraw
    loss_weights: dict[str, Tensor] = field(default_factory=dict)  # rgb, alpha, depth, beta_map
    loss: float = 0.0
    grads: dict[str, Tensor] = field(default_factory=dict)  # as params
    tile_grads: list[Tensor] | None = None


def reference_ssim(a: Tensor, b: Tensor) -> Tensor:
    """Compute the mean SSIM of two images [H, W, C] in [0, 1] over pixels with a complete window, by torchmetrics, some
    versions of which include padded windows."""
    from torchmetrics.functional.image.ssim import _ssim_update  # here because the import takes seconds

    pair = (image.permute(2, 0, 1)[None] for image in (a, b))
    _, values = _ssim_update(*pair, data_range=1.0, return_full_image=True)
    return (values[..., 5:-5, 5:-5] if values.shape[-2:] == a.shape[:2] else values).mean()


def load_golden(name: str) -> Golden:
    """Load one of GOLDEN_NAMES from tests/golden (conventions: the README there)."""
    with np.load(GOLDEN / f"{name}.npz") as file:
        data = {key: torch.from_numpy(file[key]) for key in file.files}

    def group(prefix: str) -> dict[str, Tensor]:
        return {key[len(prefix) :]: value for key, value in data.items() if key.startswith(prefix)}

    def split(values: dict[str, Tensor]) -> tuple[dict[str, Tensor], list[Tensor] | None]:
        tiles = [values[key] for key in sorted(values) if key.startswith("tile_")]
        return {key: value for key, value in values.items() if not key.startswith("tile_")}, tiles or None

    params, tiles = split(group("in_"))
    grads, tile_grads = split(group("grad_"))
    return Golden(
        name=name,
        params=params,
        viewmat=data["cam_viewmat"],
        K=data["cam_K"],
        width=int(data["cam_width"]),
        height=int(data["cam_height"]),
        background=data["cam_background"],
        tiles=tiles,
        outputs=group("out_"),
        loss_weights=group("lossweight_"),
        loss=float(data["loss"]),
        grads=grads,
        tile_grads=tile_grads,
    )


def atlas_of(golden: Golden) -> tuple[Tensor, Tensor]:
    """Lay out a textured scene's tiles [N, 5] int32 side by side on a page [1, 64, 1024, 4] float32."""
    atlas, tiles, x = torch.zeros(1, 64, 1024, 4), [], 0
    for tile in golden.tiles:
        rows, columns = tile.shape[:2]
        atlas[0, :rows, x : x + columns, :3] = tile.float()
        tiles.append((x, 0, 0, columns, rows))
        x += columns
    return torch.tensor(tiles, dtype=torch.int32), atlas


def camera_of(case: SceneCase, dtype: torch.dtype = torch.float64) -> Camera:
    return Camera(case.viewmat.to(dtype), case.K.to(dtype), case.width, case.height)


def values_of(
    case: SceneCase, dtype: torch.dtype = torch.float64, device: torch.device | str = "cpu", grad: bool = False
) -> list[Tensor]:
    """Return the values of GEOMETRY; grad: as new leaves."""
    values = [case.params[key].to(device, dtype) for key in GEOMETRY]
    return [value.clone().requires_grad_() for value in values] if grad else values


def relative(a: Tensor, b: Tensor) -> float:
    """Compute the largest error relative to the largest value; absolute if all values are 0."""
    scale = b.abs().max().item() if b.numel() else 0.0
    error = (a.double() - b.double()).abs().max().item() if b.numel() else 0.0
    return error / scale if scale > 0 else error


def traced(case: SceneCase, values: Sequence[Tensor]) -> tuple[ops.Fragments, ops.Projection]:
    """Trace the fragments of a case; values: those of GEOMETRY."""
    projection = ops.project(*values, camera_of(case, values[0].dtype))
    return ops.trace(projection, 0.0), projection


def reference(case: SceneCase, values: Sequence[Tensor]) -> reference_trace.Trace:
    """Evaluate every surfel at every pixel of a case; values: those of GEOMETRY."""
    projected = reference_project.project(*values, case.viewmat, case.K)
    return reference_trace.trace(projected, case.width, case.height)


def crossing_scene(n: int, seed: int, width: int = 96, height: int = 80) -> SceneCase:
    """Make n faint surfels across the camera's plane: centres in front of it, mostly beside the view."""
    case = random_scene(n, seed, width, height, name="crossing")
    g = torch.Generator().manual_seed(seed)
    depth = 0.25 + 1.25 * torch.rand(n, generator=g, dtype=torch.float64)
    turn = 2 * math.pi * torch.rand(n, generator=g, dtype=torch.float64)
    lateral = torch.exp(2.5 * torch.rand(n, generator=g, dtype=torch.float64) - 0.7)  # 0.5 to 6 depths off-axis
    camera = depth[:, None] * torch.stack([lateral * turn.cos(), lateral * turn.sin(), torch.ones_like(turn)], dim=-1)
    case.params["means"] = (camera - case.viewmat[:3, 3]) @ case.viewmat[:3, :3]
    size = depth.log()[:, None] + 0.4 * torch.randn(n, 2, generator=g, dtype=torch.float64)
    case.params |= {"log_scales": size, "opacity_logits": case.params["opacity_logits"] - 3.0}
    return case


def far_floor() -> SceneCase:
    """Make a floor below the camera with its centre to the side, just beyond `near`: millions of pixels away."""
    case = replace(crossing_scene(1, 0, width=40, height=30), viewmat=torch.eye(4, dtype=torch.float64))
    x, z = torch.eye(3, dtype=torch.float64)[[0, 2]]
    case.params |= {
        "means": torch.tensor([[9000.0, 0.5, 0.21]], dtype=torch.float64),
        "quats": quaternions(torch.stack([x, z, torch.linalg.cross(x, z)], dim=1)[None]),
        "log_scales": torch.full((1, 2), 8.5, dtype=torch.float64),
        "opacity_logits": torch.zeros(1, dtype=torch.float64),
    }
    return case


def tiles_reached(weights: Tensor, width: int, height: int) -> Tensor:
    """Count the 16 x 16 screen tiles in which each surfel has a fragment: [N], from weights [H W, N]."""
    across, down = -(-width // 16), -(-height // 16)
    padded = weights.new_zeros(16 * down, 16 * across, weights.shape[1])
    padded[:height, :width] = weights.view(height, width, -1)
    return (padded.view(down, 16, across, 16, -1).amax((1, 3)) > 0).sum((0, 1))


def composite(fragments: ops.Fragments, values: Tensor) -> Tensor:
    """Composite values [F, C]: sums of w times value per pixel, [H * W, C]."""
    out = values.new_zeros(fragments.width * fragments.height, values.shape[1])
    return out.index_add(0, fragments.pixel, fragments.weight[:, None] * values)


def composite_colors(
    fragments: ops.Fragments, projection: ops.Projection, colors: Tensor, maps: bool = False
) -> Tensor:
    """Composite fragments' colours [F, 3] like `ops.blended_image`, in torch."""
    geom = projection.geom.index_select(0, fragments.surfel)
    values = [colors, torch.ones_like(colors[:, :1]), geom[:, 11:12]]
    values += [fragments.depth[:, None], geom[:, 12:15]] if maps else []
    return composite(fragments, torch.cat(values, 1))


def dense(fragments: ops.Fragments, values: Tensor, n: int) -> Tensor:
    """Scatter one number per fragment to [P, N]."""
    out = values.new_zeros(fragments.width * fragments.height, n)
    return out.index_put((fragments.pixel.long(), fragments.surfel.long()), values)


def reference_colors(
    fragments: ops.Fragments, base: Tensor, texels: Tensor, tiles: ops.TexelTiles, bound: float
) -> Tensor:
    """Compute the colours ReLU(ReLU(base + 0.5) + texel(u, v)) [F, 3] of fragments by `reference.texel`, in the dtype
    of their weights; those of weight below the bound have no residual."""
    weight = fragments.weight.detach()
    color = torch.relu(base + 0.5)[fragments.surfel.long()]
    residual = torch.zeros_like(color)
    for i, (first, (r_u, r_v)) in enumerate(zip(tiles.first.tolist(), tiles.size.tolist(), strict=True)):
        if r_u * r_v:
            tile = texels[first : first + r_u * r_v].view(r_v, r_u, 3)
            rows = torch.nonzero((fragments.surfel == i) & (weight >= bound)).squeeze(1)
            at = fragments.uv[:, rows].T * (SUPPORT / tiles.extent[i])
            residual = residual.index_put((rows,), texel(tile, at))
    return torch.relu(color + residual)
