"""Scenes like trained ones, cameras around bundles, and captures read without nerfstudio."""

import math
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

import bitymi_ns
from bitymi_ns.bundle import Bundle
from bitymi_ns.capture.types import OPENCV_AXES
from bitymi_ns.codec.packing import pack
from bitymi_ns.sample.capture import look_at
from bitymi_ns.scene.baked import BakedScene
from bitymi_ns.scene.camera import Camera
from bitymi_ns.scene.config import SceneConfig
from bitymi_ns.scene.field import HashField
from bitymi_ns.scene.scene import Scene
from bitymi_ns.train.config import TexelConfig
from bitymi_ns.train.texels import blank_texels
from bitymi_ns.train.views import View

SITES = 7
CROSSING = 0.016  # share of the surfels that cross the camera's plane out of view
PIXEL_SCALE = 0.9  # median scale of a surfel, in sides of its share of the image


def trained_like(n: int, width: int, height: int, device: torch.device, texture: bool = True) -> tuple[Scene, Camera]:
    """Generate a scene with the statistics of trained ones, and its camera, deterministically.

    Fitted to scenes of 17,000 to 22,000 surfels after 1,200 steps on three captures: ln(s_u / s_v) is normal with
    standard deviation 0.85, the mean log scale in pixels has 0.7, opacity and kernel exponent are logistic-normal
    (medians 0.45 and 2.4); about 23 fragments are blended per pixel for any n. A fifth of the surfels is out of view.
    """
    g = torch.Generator().manual_seed(0)
    normal, uniform = partial(torch.randn, generator=g), partial(torch.rand, generator=g)
    focal = 0.9 * width
    K = torch.tensor([[focal, 0.0, 0.5 * width], [0.0, focal, 0.5 * height], [0.0, 0.0, 1.0]])
    z = 2.0 * torch.exp(1.4 * uniform(n))  # 2 to 8
    margin = 0.5 * (math.sqrt(1.25) - 1)
    x, y = ((uniform(n) * (1 + 2 * margin) - margin) * size for size in (width, height))
    means = torch.stack([(x - K[0, 2]) / focal * z, (y - K[1, 2]) / focal * z, z], dim=-1)
    pixels = PIXEL_SCALE * math.sqrt(width * height / n)
    size = torch.log(pixels * z / focal) + 0.7 * normal(n)
    aspect = 0.425 * normal(n)
    surfels = {
        "means": means,
        "quats": normal(n, 4),
        "log_scales": torch.stack([size + aspect, size - aspect], dim=-1),
        "opacity_logits": 1.3 * normal(n) - 0.2,
        "beta_raw": normal(n) + 0.45,
    }
    # Discs that cross the camera's plane, as in a trained room: at 0.09 times the median depth of the others, 12 depths
    # off the axis, the larger scale 0.9 depths and three times the smaller.
    beside = slice(n - round(CROSSING * n), n)
    z = 0.35 * torch.exp(0.3 * normal(round(CROSSING * n))).clamp(min=0.75)  # behind `near`
    lateral = 12 * torch.exp(0.8 * normal(len(z))).clamp(min=0.25)
    turn = 2 * math.pi * uniform(len(z))
    means[beside] = z[:, None] * torch.stack([lateral * turn.cos(), lateral * turn.sin(), torch.ones(len(z))], dim=1)
    size = torch.log(0.9 * z) + 0.3 * normal(len(z))
    surfels["log_scales"][beside] = torch.stack([size, size - 1.1], dim=1)
    # turns the first axis to the camera's
    surfels["quats"][beside] = torch.tensor([1.0, 0.0, -1.0, 0.0]) + 0.2 * normal(len(z), 4)
    surfels |= {"sv_sites": normal(n, SITES, 3), "sv_log_tau": torch.zeros(n, SITES)}
    surfels |= {"sv_rgb": uniform(n, SITES, 3) - 0.5}
    config = SceneConfig(view_color="sv", sv_sites=SITES, texture="hash" if texture else "none", near=0.2)
    field = None
    if texture:
        field = HashField(config, (0.0, 0.0, 5.0), 5.0, True, log2_table_size=17, generator=g)
        with torch.no_grad():
            field.field_w3.copy_(0.1 * normal(*field.field_w3.shape))  # starts at zero
    scene = Scene(config, surfels, field).to(device)
    return scene, Camera(torch.eye(4), K, width, height).to(device)


def with_texels(n: int, width: int, height: int, device: torch.device) -> tuple[Scene, Camera]:
    """Generate `trained_like` with a tile of random texels per surfel, at the camera's resolution."""
    scene, camera = trained_like(n, width, height, device, texture=False)
    scene.config.texture = "texels"
    field, _ = blank_texels(scene, [View(camera, torch.zeros(height, width, 3, device=device))], 1, TexelConfig())
    g = torch.Generator().manual_seed(1)
    with torch.no_grad():
        field.texels.copy_(0.1 * torch.randn(field.texels.shape, generator=g))
    scene.field = field
    return scene, camera


def textured(n: int, width: int, height: int, device: torch.device) -> tuple[BakedScene, Camera]:
    """Generate `trained_like` with an atlas of random texels, one per pixel: BC7 on a GPU, else uint8."""
    scene, camera = trained_like(n, width, height, torch.device("cpu"), texture=False)
    surfels = {name: value.detach().contiguous() for name, value in scene.surfels.items()}
    pixels = 6 * surfels["log_scales"].exp() * camera.K[0, 0] / surfels["means"][:, 2:]
    packing = pack(torch.exp2(torch.log2(pixels).ceil()).clamp(4, 64).long().numpy())
    g = torch.Generator().manual_seed(1)
    atlas = blocks = None
    if device.type == "cuda":
        shape = (packing.layers, packing.height // 4, packing.width // 4, 16)
        blocks = torch.randint(0, 256, shape, dtype=torch.uint8, generator=g)
        blocks[..., 0] = 0x40  # mode 6: any other bits are a valid block
    else:
        shape = (packing.layers, packing.height, packing.width, 4)
        atlas = torch.randint(0, 256, shape, dtype=torch.uint8, generator=g)
    tiles, bound = torch.from_numpy(packing.tiles).contiguous(), scene.config.weight_bound
    baked = BakedScene(surfels, "sv", tiles, atlas, offset=-0.2, scale=0.4, weight_bound=bound, blocks=blocks)
    return baked.to(device), camera


def around(bundle: Bundle, width: int, height: int) -> list[Camera]:
    """Build three cameras around the centre of a bundle, whose training cameras were in the unit ball."""
    middle = bundle.scene.surfels["means"].median(dim=0).values.double().numpy()
    K = torch.tensor([[0.8 * width, 0, width / 2], [0, 0.8 * width, height / 2], [0, 0, 1]])
    cameras = []
    for angle in (0.0, 2.1, 4.2):
        eye = middle + 0.7 * np.array([math.cos(angle), math.sin(angle), 0.3])
        viewmat = np.linalg.inv(look_at(eye, middle) @ OPENCV_AXES)
        cameras.append(Camera(torch.from_numpy(viewmat).float(), K, width, height))
    return cameras


@dataclass
class SplitCapture:
    """A capture for training."""

    train: list[View]
    held_out: list[View]  # those of the capture's own split, else every eighth photograph
    points: Tensor  # [M, 3] sparse points
    colours: Tensor  # [M, 3] in [0, 1]
    white: bool = False  # evaluate images with alpha over white, as for Blender's captures


def load_capture(path: Path, downscale: int = 1) -> SplitCapture:
    """Read a capture, translated and scaled as in nerfstudio: the mean of the cameras is the origin, and their largest
    coordinate is 1. `path`: as for `bitymi_ns.load_capture`; Blender's get their points from the first *_pc.ply.
    `downscale`: integer factor by which photographs are downscaled. Raises CaptureError."""
    blender = (path / "transforms_train.json").exists()
    cloud = next(iter(sorted(path.glob("*_pc.ply"))), None) if blender else None
    given = {} if cloud is None else {"ply_path": cloud.absolute()}
    train, points, colours = bitymi_ns.load_capture(path, "train", downscale_factor=downscale, **given)
    held_out, *_ = bitymi_ns.load_capture(path, "test", downscale_factor=downscale, points="random")
    centers = torch.stack([view.camera.center.double() for view in (*train, *held_out)])
    middle = centers.mean(0)
    scale = 1.0 / float((centers - middle).abs().max())

    def moved(view: View) -> View:
        viewmat = view.camera.viewmat.double()
        viewmat[:3, 3] = (viewmat[:3, 3] + viewmat[:3, :3] @ middle) * scale
        return view._replace(camera=replace(view.camera, viewmat=viewmat.float()))

    points = ((points.double() - middle) * scale).float()
    return SplitCapture(list(map(moved, train)), list(map(moved, held_out)), points, colours, blender)
