"""Numbers of the formulas and of the kernels' arrays. csrc states each once; these are read from what was compiled.

The float64 twins in `ops.reference` state those of the formulas again: they are what the kernels are held against.
"""

from typing import Any

from bitymi_ns import KernelsUnavailable

from .backend import load


def _compiled(name: str) -> Any:
    try:
        return getattr(load("_cpu"), name)
    except AttributeError as error:
        raise KernelsUnavailable(
            f"the compiled module bitymi_ns._cpu does not know {name}: it is older than the package. Install the "
            "package again (`pip install .`, or `make setup` in a checkout)"
        ) from error


SUPPORT: float = _compiled("SUPPORT")  # R: the kernel ends at this distance from the centre, in scale units
ALPHA_MAX: float = _compiled("ALPHA_MAX")  # the effective opacity sigma is clamped to this
ALPHA_MIN: float = _compiled("ALPHA_MIN")  # fragments of smaller sigma are skipped
TRANSMITTANCE_MIN: float = _compiled("TRANSMITTANCE_MIN")
"""A pixel takes no fragment that would leave it less transmittance."""
BETA_MAX: float = _compiled("BETA_MAX")  # beta = BETA_MAX sigmoid(beta_raw)
COLOR_BIAS: float = _compiled("COLOR_BIAS")  # what is added to f_view before the inner ReLU
SH_C0: float = _compiled("SH_C0")  # value of the spherical harmonic of degree 0
LOG_TAU_MAX: float = _compiled("LOG_TAU_MAX")  # logarithms of temperatures and sharpnesses are clamped to this
MAX_TERMS: int = _compiled("MAX_TERMS")  # sites or lobes that a view colour may have
FEATURES: int = _compiled("FEATURES")  # features per level of the field
WIDTH: int = _compiled("WIDTH")  # width of both hidden layers of the field
MAX_LEVELS: int = _compiled("MAX_LEVELS")  # levels that the field may have
TILE: int = _compiled("TILE")  # pixels along a side of a tile
GEOM: int = _compiled("GEOM")
"""Columns of a row of `geom`: cx, cy, u1, u2, v1, v2, w0, w1, w2, z, opacity, beta, normal (3), area."""
FRAME: int = _compiled("FRAME")  # columns of a row of `frames`: mean, s_u t_u, s_v t_v
IMAGE_CHANNELS: int = _compiled("IMAGE_CHANNELS")  # channels of a blended image: rgb, alpha, beta
MAP_CHANNELS: int = _compiled("MAP_CHANNELS")  # the same with maps: also depth and normal
BAKED_CHANNELS: int = _compiled("BAKED_CHANNELS")  # channels of a baked frame without maps: rgb, alpha
