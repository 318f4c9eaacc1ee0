"""Differentiable torch operations over the compiled kernels; float64 twins are in `ops.reference`.

Functions take float32 or float64 tensors and dispatch on device and dtype.
"""

from .bands import Unlisted, draw_by_lists, fitting_lists
from .blend import blended_image, soft_overdraw
from .capacity import TooManyFragments
from .coverage import add_texel_coverage, surfel_coverage
from .field import FieldGeometry, field, fragment_residual
from .project import Projection, project
from .rasterize_cuda import can_rasterize, rasterize_image
from .ssim import ssim
from .texel import TexelAlpha, TexelDescent, TexelTiles
from .trace import Fragments, select, trace
from .view_color import view_color
from .view_kinds import VIEW_COLORS

__all__ = [
    "VIEW_COLORS",
    "FieldGeometry",
    "Fragments",
    "Projection",
    "TexelAlpha",
    "TexelDescent",
    "TexelTiles",
    "TooManyFragments",
    "Unlisted",
    "add_texel_coverage",
    "blended_image",
    "can_rasterize",
    "draw_by_lists",
    "field",
    "fitting_lists",
    "fragment_residual",
    "project",
    "rasterize_image",
    "select",
    "soft_overdraw",
    "ssim",
    "surfel_coverage",
    "trace",
    "view_color",
]
