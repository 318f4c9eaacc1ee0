"""nerfstudio's pipeline with averages that are valid JSON."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from nerfstudio.pipelines.base_pipeline import VanillaPipeline, VanillaPipelineConfig

from bitymi_ns.host.errors import fail


class BitymiPipeline(VanillaPipeline):
    """Data manager and model, as nerfstudio pairs them."""

    def load_pipeline(self, loaded_state: dict[str, Any], step: int) -> None:
        """Load the parameters of a checkpoint."""
        try:
            super().load_pipeline(loaded_state, step)
        except (RuntimeError, LookupError, TypeError, AttributeError) as error:  # torch's list of what does not fit
            fail(f"the checkpoint of step {step} does not fit this scene. {error}", error)

    def get_average_image_metrics(self, *args: Any, **kwargs: Any) -> dict[str, float]:
        """Averages over images; the deviation of a single image is 0, not NaN, which JSON does not know."""
        metrics = super().get_average_image_metrics(*args, **kwargs)
        return {k: 0.0 if k.endswith("_std") and math.isnan(v) else v for k, v in metrics.items()}


@dataclass
class BitymiPipelineConfig(VanillaPipelineConfig):
    """Configuration of the pipeline."""

    _target: type = field(default_factory=lambda: BitymiPipeline)
