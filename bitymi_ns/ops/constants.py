"""Constants of the formulas and of the kernels' arrays, read from the compiled module (csrc states each once).

The float64 twins in `ops.reference` state those of the formulas again, as an independent check.
"""

from typing import Any

from bitymi_ns.errors import KernelsUnavailable
from .backend import load


def _compiled(name: str) -> Any:
    try:
        return getattr(load("_cpu"), name)
    except AttributeError as error:
        raise KernelsUnavailable(
            f"the compiled module bitymi_ns._cpu does not know {name}: it is older than the package. Install the "
            "package again (`pip install .`, or `make setup` in a checkout)"
        ) from error


SUPPORT: float = _compiled("SUPPORT")  # R: radius of the kernel in scale units
ALPHA_MAX: float = _compiled("ALPHA_MAX")  # upper bound of the effective opacity sigma
ALPHA_MIN: float = _compiled("ALPHA_MIN")  # fragments of smaller sigma are skipped
TRANSMITTANCE_MIN: float = _compiled("TRANSMITTANCE_MIN")
"""A pixel ends before the fragment that would leave less transmittance."""
BETA_MAX: float = _compiled("BETA_MAX")  # beta = BETA_MAX sigmoid(beta_raw)
COLOR_BIAS: float = _compiled("COLOR_BIAS")  # added to f_view before the inner ReLU
SH_C0: float = _compiled("SH_C0")  # spherical harmonic of degree 0
LOG_TAU_MAX: float = _compiled("LOG_TAU_MAX")  # of logarithms of temperatures and sharpnesses
MAX_TERMS: int = _compiled("MAX_TERMS")  # most sites or lobes of a view colour
FEATURES: int = _compiled("FEATURES")  # features per level of the field
WIDTH: int = _compiled("WIDTH")  # of both hidden layers of the field
MAX_LEVELS: int = _compiled("MAX_LEVELS")  # of the field
TILE: int = _compiled("TILE")  # side of a screen tile, pixels
GEOM: int = _compiled("GEOM")
"""Columns of a row of `geom`: cx, cy, u1, u2, v1, v2, w0, w1, w2, z, opacity, beta, normal (3), area."""
FRAME: int = _compiled("FRAME")  # columns of a row of `frames`: mean, s_u t_u, s_v t_v
IMAGE_CHANNELS: int = _compiled("IMAGE_CHANNELS")  # channels of a blended image: rgb, alpha, beta
MAP_CHANNELS: int = _compiled("MAP_CHANNELS")  # also depth and normal
BAKED_CHANNELS: int = _compiled("BAKED_CHANNELS")  # channels of a baked frame without maps: rgb, alpha
