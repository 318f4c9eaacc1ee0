"""A compact bundle of a few random surfels."""

import base64
import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch

from bitymi_ns.bundle import write_bundle
from bitymi_ns.codec.packing import Packing, pack
from bitymi_ns.codec.pages import paged_texels
from bitymi_ns.codec.quantise import Range, encode
from bitymi_ns.codec.surfel_codes import REFERENCE, code_surfels
from bitymi_ns.codec.texel_codes import SceneCodes, TexelCoder, mean_alphas_of
from bitymi_ns.measure.stability.scenes import random_scene
from bitymi_ns.ops.view_kinds import VIEW_COLORS
from bitymi_ns.scene.baked import BakedScene
from tests.ops.test_view_color import reduced_parameters

SIDES = ((8, 4), (0, 0), (4, 4), (16, 8))
RANGE = Range(-0.5, 2.0, "test")


FINEST = {**REFERENCE, "place": 1e-9}
"""Steps for which positions use every bit of their grid."""


def reduced_surfels(kind: str, count: int) -> dict[str, torch.Tensor]:
    """Make random surfels with reduced view colours."""
    params = {key: value.float() for key, value in random_scene(count, 0).params.items()}
    params = {key: value for key, value in params.items() if key not in VIEW_COLORS["sv"].names}
    return params | reduced_parameters(kind, count, torch.float32)


def make_codes(
    kind: str = "sv",
    count: int = 12,
    textured: bool = True,
    steps: Mapping[str, float] = REFERENCE,
    alpha: bool = False,
) -> SceneCodes:
    """Build SceneCodes of random surfels, every fourth without a tile, with alpha texels or opaque."""
    params = reduced_surfels(kind, count)
    sizes = torch.tensor([SIDES[i % len(SIDES)] if textured else (0, 0) for i in range(count)])
    surfels, order = code_surfels(params, kind, sizes, torch.linspace(0.5, 3.0, count), steps)
    sizes = sizes[order]
    generator = torch.Generator().manual_seed(0)
    texels = torch.rand(int(sizes.clamp(min=1).prod(1).sum()), 3, generator=generator) - 0.5
    coder = TexelCoder(sizes, torch.ones(len(texels)))
    if alpha:
        coder.code_alpha(2 * torch.rand(len(texels), generator=generator))
    coded = coder.code(texels)
    return SceneCodes(surfels, coded if textured else None, coded.residual, coded.residual_step, 4096, 8192)


def scene_of(codes: SceneCodes) -> BakedScene:
    packing = pack(codes.surfels.sizes, codes.page_width, codes.page_rows)
    return BakedScene(
        codes.surfels.surfels(),
        codes.surfels.kind,
        torch.from_numpy(packing.tiles),
        extent=codes.surfels.extent(3.0),
        mean_residual=None,
        mean_alpha=None if codes.alpha is None else mean_alphas_of(codes.alpha),
    )


def pages_of(codes: SceneCodes) -> tuple[np.ndarray, Packing]:
    packing, alphas = pack(codes.surfels.sizes, codes.page_width, codes.page_rows), codes.texels.alphas()
    texels = codes.texels.texels()
    return paged_texels(texels if alphas is None else torch.cat([texels, alphas[:, None]], 1), packing).numpy(), packing


EARLIER = Path(__file__).parents[2] / "web" / "test" / "earlier_bundles.json"
"""By version, the files of a bundle as it wrote them, and the numbers that it read."""


def earlier(version: str) -> dict[str, dict[str, bytes]]:
    """Read a stored bundle of an earlier version."""
    parts = json.loads(EARLIER.read_text("utf8"))[version]
    return {part: {key: base64.b64decode(text) for key, text in values.items()} for part, values in parts.items()}


def write_earlier(version: str, folder: Path) -> Path:
    folder.mkdir()
    for file, data in earlier(version)["files"].items():
        (folder / file).write_bytes(data)
    return folder


def write_compact(folder: Path, codes: SceneCodes, **options) -> Path:
    atlas = None if codes.texels is None else encode(*pages_of(codes), "uint8", RANGE)
    write_bundle(folder, scene_of(codes), atlas, codes, **options)
    return Path(folder)
