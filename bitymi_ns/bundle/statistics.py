"""Statistics of the bake in bundle.json: surfels left out, errors, sizes. Earlier versions lack some fields."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, model_serializer
from torch import Tensor

from .bake_options import BakeOptions

_LARGEST = 1e12
_P = TypeVar("_P", bound="Part")


class Part(BaseModel):
    """An object of bundle.json. Unknown keys are kept; numbers are finite and never bools or text. Only fields that
    were set are written."""

    model_config = ConfigDict(strict=True, extra="allow", allow_inf_nan=False)

    @model_serializer(mode="wrap")
    def _without_what_was_not_given(self, serialize: Any) -> dict[str, Any]:
        given = self.model_fields_set
        return {key: value for key, value in serialize(self).items() if value is not None or key in given}

    def replace(self: _P, **changes: Any) -> _P:
        """Copy with other values; None removes a field."""
        return type(self)(**{name: value for name, value in {**dict(self), **changes}.items() if value is not None})


def _number(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value


Whole = Annotated[int, Field(ge=0, le=2**31 - 1)]
Count = Annotated[int, Field(ge=0, le=2**60)]
NotNegative = Annotated[float, Field(ge=0, le=_LARGEST)]
Measured = Annotated[NotNegative | None, BeforeValidator(_number)]  # None: not finite
Share = Annotated[float, Field(ge=0, le=1)]
Decibels = Annotated[Annotated[float, Field(ge=-1e3, le=1e3)] | None, BeforeValidator(_number)]
"""None: not finite, as the pictures are equal or no pixel counts."""


class Percentiles(Part):
    """Percentiles of an error over the surfels. None: not finite, or too large to be stated."""

    p50: NotNegative | None = None
    p90: NotNegative | None = None
    p99: NotNegative | None = None
    p100: NotNegative | None = None

    @classmethod
    def of(cls, values: Tensor) -> Percentiles:
        """Compute the percentiles of [n] values, n >= 1, to four digits."""
        ordered = values.double().sort().values
        rounded = {p: round(float(ordered[round((len(ordered) - 1) * p / 100)]), 4) for p in (50, 90, 99, 100)}
        return cls(**{f"p{p}": value if value <= _LARGEST else None for p, value in rounded.items()})


class Certificate(Part):
    """Numbers of surfels whose stored residual, without alphas, is within the tolerance in the closest training view:
    error times blending weight, averaged per pixel, root mean square over the tile."""

    against: Literal["field", "texels"]  # reference: texels before quantisation; earlier: the field
    tolerance: NotNegative
    within: Whole
    beyond: Whole
    worst: Measured = None  # 8-bit steps
    texel_rms: Measured = None
    """Root mean square over all texels without weights, 8-bit steps."""

    @classmethod
    def of(cls, errors: Tensor, tolerance: float) -> Certificate:
        """Count the errors [n], 8-bit steps, within the tolerance and beyond it."""
        within = int((errors <= tolerance).sum())
        worst = float(errors.amax()) if len(errors) else 0.0
        return cls(against="texels", tolerance=tolerance, within=within, beyond=len(errors) - within, worst=worst)


class LeftOut(Part):
    """Numbers of surfels left out, by reason."""

    not_finite: Whole | None = None
    beyond_limits: Whole | None = None
    transparent: Whole | None = None
    unseen: Whole | None = None


class KeptSurfels(Part):
    trained: Whole | None = None
    kept: Whole | None = None
    left_out: LeftOut | None = None
    without_tile: Whole | None = None


class KeptTexels(Part):
    """Numbers of texels: by the paper's rule, after each reduction, and as stored."""

    paper: Count | None = None
    nyquist: Count | None = None
    after_cap_by_views: Count | None = None
    within_visible_part: Count | None = None
    polished: Count | None = None  # before the polish
    learned: Count | None = None  # trained ones
    kept: Count | None = None
    not_finite: Count | None = None  # of the field


class AtlasCost(Part):
    bytes: Count | None = None
    pages: tuple[Whole, Whole, Whole] | None = None  # layers, height, width in texels
    occupancy: Share | None = None
    psnr: Decibels = None
    clipped_fraction: Share | None = None


class Kept(Part):
    """Numbers of terms, or bytes, before and after."""

    before: Count | None = None
    after: Count


class ViewColorError(Part):
    """Terms of the reduced view colours, and their error in 8-bit steps."""

    kind: str | None = None
    tolerance: NotNegative
    unit: str | None = None
    sites: Kept
    one_color: Whole
    bytes: Kept | None = None
    error: Percentiles


class Gain(Part):
    """PSNR over some views, dB, with texels as baked and as tuned."""

    before: Decibels = None
    after: Decibels = None


class Rounding(Part):
    """Quantisation of the surfels of a compact bundle."""

    mse: Measured = None
    """Mean squared error in the training views before texels were tuned, colours in [0, 1]."""
    steps: dict[str, NotNegative] = {}  # by column, as in `surfel_codes.REFERENCE`
    alternatives: Annotated[list[tuple[NotNegative, Decibels]], Field(max_length=16)] | None = None
    """Other precisions: bytes relative to the chosen one, and PSNR difference over held-out, else training views, dB,
    before texels were tuned."""


class FineTuning(Part):
    """Fine-tuning or polish; 0 steps if too few views."""

    views: Whole | None = None
    held_in_views: Whole | None = None  # validation views
    steps: Whole | None = None
    steps_asked: Whole | None = None
    best_step: Whole | None = None
    psnr_held_in: Gain | None = None
    psnr_held_out: Gain | None = None
    curve: Annotated[list[tuple[Whole, Decibels]], Field(max_length=1 << 16)] | None = None
    """Step and PSNR over the validation views, dB."""
    seconds: NotNegative | None = None
    cpu_seconds: NotNegative | None = None


class HeldOut(Part):
    """Mean PSNR over the held-out views, dB, of bundle (`baked`), trained scene (`neural`) and photographs against each
    other; `worst`: of the view where bundle and trained scene differ most."""

    views: Whole | None = None
    psnr_baked_against_neural: Decibels = None
    psnr_neural_against_photos: Decibels = None
    psnr_baked_against_photos: Decibels = None
    fitted_psnr_neural_against_photos: Decibels = None  # after an affine fit of each view's colours to its photograph
    fitted_psnr_baked_against_photos: Decibels = None
    psnr_baked_against_neural_worst: Decibels = None


class Statistics(Part):
    """Statistics for reports; `bitymi verify` measures them again."""

    surfels: KeptSurfels | None = None
    texels: KeptTexels | None = None
    certificate: Certificate | None = None  # None: no texture, or no tolerance
    view_color: ViewColorError | None = None  # None: view colours unchanged
    atlas: AtlasCost | None = None
    polish: FineTuning | None = None
    rounding: Rounding | None = None
    finetune: FineTuning | None = None
    options: BakeOptions | None = None
    method: str | None = None
    held_out: HeldOut | None = None
