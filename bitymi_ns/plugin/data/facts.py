"""Carry the facts of a capture beside nerfstudio's fields, in one record, from the reader to the model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from bitymi_ns.capture.colmap_views import Source
from bitymi_ns.capture.depth_normal_maps import Values, read_depth, read_normal
from bitymi_ns.capture.lens import Lens
from bitymi_ns.capture.types import MapFiles
from bitymi_ns.train.views import View

KEY = "bitymi"  # in nerfstudio's `metadata`


class DepthFit(NamedTuple):
    """Camera z in units of the scene from a map's values v: z, or 1 / z, is scale v + shift."""

    scale: float
    shift: float = 0.0
    inverse: bool = False

    def z(self, values: npt.NDArray[np.floating]) -> Values:
        """Convert values; 0 = unknown."""
        linear = self.scale * values + self.shift
        known = (values > 0.0) & (linear > 0.0)
        linear = np.where(known, linear, 1.0)
        return np.where(known, 1.0 / linear if self.inverse else linear, 0.0).astype(np.float32)


class FittedMaps(NamedTuple):
    """Maps of a view in units of the scene; fit None = no depth."""

    files: MapFiles
    fit: DepthFit | None
    unit: float | None

    def read(self, lens: Lens) -> dict[str, Values]:
        """Read depth [H, W] and normal [H, W, 3], if they are used."""
        depth = {} if self.fit is None else {"depth": self.fit.z(read_depth(self.files, lens, self.unit))}
        return depth if self.files.normal is None else {**depth, "normal": read_normal(self.files, lens)}


@dataclass(frozen=True)
class CaptureFacts:
    """Facts of a capture: of views and poses by its parser, of the training views by the data manager."""

    lenses: Sequence[Lens] = ()  # of each view
    files: Sequence[Path] = ()  # of each view, which may share one
    maps: Sequence[MapFiles] = ()  # of each view; empty = there are none
    fitted: Sequence[FittedMaps] = ()  # likewise, in units of the scene; empty = none is used
    lost: bool = False  # the photographs are gone; the views have no lenses
    gray: bool = False  # lost photographs are grey, else refused
    declares_box: bool = False  # the capture states its box; else that is a default
    poses_report: Path | None = None  # folder of the report on structure from motion
    poses_found: Source | None = None  # by structure from motion; None = came with the capture

    alpha_color: Tensor | None = None  # [3] behind transparent photographs, as the capture states
    has_alpha: bool = False  # the first training photograph has transparency
    transparent: bool = False  # one of a few training photographs has
    train_pixels: int = 0  # of all training views
    camera_centers: Tensor = field(default_factory=lambda: torch.zeros(0, 3))  # [V, 3] of the training views
    background_views: Sequence[View] = ()  # those in which background points may be sought
    seed: int = 0  # of the background points

    @staticmethod
    def of(metadata: Mapping[str, Any]) -> CaptureFacts:
        """Return the record in nerfstudio's metadata, or an empty one."""
        return metadata.get(KEY) or CaptureFacts()

    def select(self, indices: Sequence[int]) -> CaptureFacts:
        per_view = {name: getattr(self, name) for name in ("lenses", "files", "maps", "fitted")}
        return replace(self, **{name: [values[i] for i in indices] for name, values in per_view.items() if values})

    def __deepcopy__(self, memo: object) -> CaptureFacts:
        """Return the record itself: nerfstudio copies the metadata."""
        return self
