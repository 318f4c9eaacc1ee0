"""nerfstudio's pipeline with averages that are valid JSON."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from nerfstudio.pipelines.base_pipeline import VanillaPipeline, VanillaPipelineConfig


class BitymiPipeline(VanillaPipeline):
    """Data manager and model, as nerfstudio pairs them."""

    def get_average_image_metrics(self, *args: Any, **kwargs: Any) -> dict[str, float]:
        """Averages over images; the deviation of a single image is 0, not NaN, which JSON does not know."""
        metrics = super().get_average_image_metrics(*args, **kwargs)
        return {k: 0.0 if k.endswith("_std") and math.isnan(v) else v for k, v in metrics.items()}


@dataclass
class BitymiPipelineConfig(VanillaPipelineConfig):
    """Configuration of the pipeline."""

    _target: type = field(default_factory=lambda: BitymiPipeline)
