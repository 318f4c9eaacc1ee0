"""A small bundle with cameras and a photograph."""

import io
import math
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import pytest
import torch
from PIL import Image

from bitymi_ns.bake import Coded, Reduced, export, prune_and_resample
from bitymi_ns.bake.compact import compacted
from bitymi_ns.bake.field.tiles import field_tiles
from bitymi_ns.bake.pipeline import trained_texels
from bitymi_ns.bake.stages import with_means
from bitymi_ns.bundle.bake_options import BakeOptions
from bitymi_ns.bundle.cameras import CapturedCamera, cameras_data
from bitymi_ns.codec.pages import joined, tile_means
from bitymi_ns.scene import Camera
from tests.bake.conftest import make_surfels
from tests.bake.test_real_scene import real_scene
from tests.cuda.baked_scenes import front

WIDTH, HEIGHT = 160, 120


def view() -> Camera:
    """A camera in front of the scene, with the size of the tests' screens."""
    return front(WIDTH, HEIGHT, 3.0)


def with_alpha(baked: Reduced) -> Reduced:
    """Add random alphas from 0 to 2 to a bake."""
    random = torch.Generator().manual_seed(0)
    texels = joined(baked.texels, 2 * torch.rand(len(baked.texels), generator=random))
    return replace(baked, texels=texels, scene=with_means(baked.scene, tile_means(texels, baked.sizes)))


@lru_cache
@torch.no_grad()
def baked_scene(
    format: str,
    count: int,
    compact: bool,
    seen: bool,
    kind: str,
    larger: float,
    alpha: bool,
    options: tuple[tuple[str, object], ...],
) -> Coded:
    """Bake the test scene; `compact`: version 3; `seen`: photographed by the camera, so that views adapt to their size;
    `larger`: added to the log scales; `alpha`: with alpha texels."""
    made = real_scene(make_surfels, count=count, kind=kind)
    made.surfels["log_scales"] += larger
    cameras = [view()] if seen else []
    trained = field_tiles(trained_texels(made, BakeOptions(format=format, **dict(options))), made.field, cameras)
    baked = prune_and_resample(trained, cameras)
    baked = with_alpha(baked) if alpha else baked
    return (compacted(baked, [], torch.zeros(3)) if compact else baked).encoded()


def write(
    folder: Path,
    format: str = "bc7",
    count: int = 120,
    compact: bool = False,
    seen: bool = False,
    poster: bool = False,
    kind: str = "sv",
    larger: float = 0.0,
    alpha: bool = False,
    near: float | None = None,
    unit: float = 1.0,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    **options: object,
) -> Path:
    """Write a bundle of `baked_scene` with a camera and its photograph, and optionally a poster; `unit`: factor of all
    lengths."""
    camera = view()
    camera.viewmat[:3, 3] *= unit
    picture = io.BytesIO()
    Image.new("RGB", (WIDTH, HEIGHT), (200, 80, 40)).save(picture, "JPEG")
    moved = camera.viewmat.clone()
    moved[0, 3] = 0.5 * unit
    rows = [CapturedCamera.of("first.jpg", camera, True, "photograph-0001.jpg")]
    rows.append(CapturedCamera.of("second.jpg", camera.posed(moved), False))
    extra = {"cameras.json": cameras_data(rows), "photograph-0001.jpg": picture.getvalue()}
    baked = baked_scene(format, count, compact, seen, kind, larger, alpha, tuple(options.items()))
    if near is not None:
        baked = replace(baked, scene=replace(baked.scene, near=near))
    if unit != 1.0:
        surfels = {**baked.scene.surfels, "means": baked.scene.surfels["means"] * unit}
        surfels["log_scales"] = surfels["log_scales"] + math.log(unit)
        baked = replace(baked, scene=replace(baked.scene, surfels=surfels, near=baked.scene.near * unit))
    export(baked, folder, background=background, extra_files=extra, first=camera if poster else None)
    return folder


@pytest.fixture(scope="session")
def solid(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bundle whose surfels have no gaps in the middle."""
    return write(tmp_path_factory.mktemp("view") / "solid", larger=1.5)


@pytest.fixture(scope="session")
def bundle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("view") / "little")
