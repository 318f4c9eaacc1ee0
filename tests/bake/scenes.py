"""Baked scenes for tests of bundles."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from bitymi_ns.bundle import write_bundle
from bitymi_ns.codec.quantise import EncodedAtlas
from bitymi_ns.ops.view_kinds import kind_of
from bitymi_ns.scene.baked import BakedScene

OF_THE_SCENE = ("extent", "mean_residual", "mean_alpha", "near", "weight_bound", "photographed")


def write(
    folder: Path,
    surfels: Mapping[str, Tensor],
    tiles: np.ndarray | None = None,
    atlas: EncodedAtlas | None = None,
    kind: str | None = None,
    **options: Any,
) -> Path:
    """Write a bundle of N surfels.

    Args:
        folder: bundle folder.
        surfels: N rows.
        tiles: [N, 5] int32; None: no tiles.
        atlas: encoded atlas.
        kind: view-colour kind, required for reduced colours.
        options: of the scene and of `write_bundle`.
    """
    rows = torch.zeros(len(surfels["means"]), 5, dtype=torch.int32) if tiles is None else torch.from_numpy(tiles)
    of_scene = {name: options.pop(name) for name in OF_THE_SCENE if name in options}
    scene = BakedScene(surfels, kind or kind_of(surfels), rows, **of_scene)
    write_bundle(folder, scene, atlas, **options)
    return Path(folder)
