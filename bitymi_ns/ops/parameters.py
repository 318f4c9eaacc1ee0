"""Parameters of a surfel. Names, shapes, limits, learning rates and columns follow from `GEOMETRY_PARAMETERS` and, for
view colours, from `view_kinds.VIEW_COLORS`."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Protocol

from torch import Tensor

Limit = tuple[float, ...]
"""Largest absolute value of a parameter: one number, or one for each entry of its last axis."""
SHAPE_LIMIT = 1e4  # of logits, angles and log sharpnesses: sigmoid and exp saturate far below
SMALLEST_SHARE = 1.0 / 1024  # margin of stored sigmoids to 1, and of betas to 0, where the logit is infinite


class Tensors(Protocol):
    """A `Mapping` or an `nn.ParameterDict`."""

    def __getitem__(self, name: str, /) -> Tensor: ...
    def __contains__(self, name: Any, /) -> bool: ...
    def items(self) -> Iterable[tuple[str, Tensor]]: ...


@dataclass(frozen=True)
class Parameter:
    """A parameter with one row per surfel."""

    name: str  # as in checkpoints and optimiser groups
    shape: tuple[int, ...]  # of a row; -1 = number of terms, less the one that the first parameter may hold
    limit: Limit  # allowed in a bundle
    rate: str  # learning rate, a field of `train.config.LearningRates`, multiplied by:
    rate_factor: float = 1.0
    activation: str | None = None  # of a view colour as stated in bundle.json; None: not stated
    columns: tuple[str, ...] | None = None  # columns of surfels.ply; None: <name>_<i>
    code: str | None = None  # column of surfels.bin; None: its name
    step: float | None = None  # reference step of that column, coded number by number; None: not coded so
    start: float | None = None  # value of a new surfel; None: `train.init` has it
    absent: float | None = None  # value in bundles of earlier versions, which lack it; None: all have it
    least: float | None = None  # coded as sigmoids, from this to 1 - `SMALLEST_SHARE`; None: coded as they are

    @property
    def width(self) -> int:
        """Numbers per row, or per term of it."""
        return math.prod(size for size in self.shape if size > 0)


GEOMETRY_PARAMETERS: dict[str, Parameter] = {
    parameter.name: parameter
    for parameter in (
        Parameter("means", (3,), (1e9,), "mean_pixels", columns=("x", "y", "z"), code="place"),
        Parameter(
            *("quats", (4,), (math.inf,), "quats"), columns=("rot_0", "rot_1", "rot_2", "rot_3"), code="rotation"
        ),
        # beyond, exp() is 0 or infinite in float32
        Parameter("log_scales", (2,), (104.0,), "log_scales", columns=("scale_0", "scale_1"), step=1.0 / 32),
        Parameter(
            *("opacity_logits", (), (SHAPE_LIMIT,), "opacity_logits"),
            columns=("opacity",),
            code="opacity",
            step=1.0 / 64,
            least=1.0 / 255,  # `constants.ALPHA_MIN`
        ),
        Parameter(
            *("beta_raw", (), (SHAPE_LIMIT,), "beta_raw"),
            start=2.0,  # a nearly Gaussian kernel: beta = 4 sigmoid(2) = 3.52
            columns=("beta",),
            code="beta",
            step=1.0 / 32,
            least=SMALLEST_SHARE,
        ),
    )
}
"""Geometry of a surfel by name, in the order of the kernels."""
GEOMETRY = tuple(GEOMETRY_PARAMETERS)
