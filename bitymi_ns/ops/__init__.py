"""Differentiable torch operations over the compiled kernels; float64 twins are in `ops.reference`.

Every function takes float32 or float64 tensors and dispatches on their device and dtype.
"""

from .composite import composite, composite_image
from .field import FieldGeometry, field
from .project import Projection, project
from .shade import shade
from .ssim import ssim
from .texel import TexelFragments, TexelTiles, add_texel_gradient, texel_image
from .trace import Fragments, masked_counts, trace
from .view_color import VIEW_COLORS, view_color

__all__ = [
    "VIEW_COLORS",
    "FieldGeometry",
    "Fragments",
    "Projection",
    "TexelFragments",
    "TexelTiles",
    "add_texel_gradient",
    "composite",
    "composite_image",
    "field",
    "masked_counts",
    "project",
    "shade",
    "ssim",
    "texel_image",
    "trace",
    "view_color",
]
