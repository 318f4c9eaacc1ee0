"""What a compact bundle keeps of a bake."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from bitymi_ns.codec.surfel_codes import SurfelCodes
from bitymi_ns.codec.texel_codes import TexelCodes


@dataclass(frozen=True)
class Codes:
    """Surfels and texels as integers.

    Attributes:
        surfels: of N surfels.
        texels: of their tiles; None where there are none, or as long as they are not coded.
        residual: [N, 3] int64 mean residuals: green, red less green, blue less green.
        residual_step: of these, colour units.
        page_width, page_rows: what tiles are packed with, see `packing.pack`.
    """

    surfels: SurfelCodes
    texels: TexelCodes | None
    residual: npt.NDArray[np.int64]
    residual_step: float
    page_width: int
    page_rows: int
