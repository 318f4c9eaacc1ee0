"""nerfstudio's pipeline with averages that are valid JSON."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from nerfstudio.pipelines.base_pipeline import VanillaPipeline, VanillaPipelineConfig

from bitymi_ns.plugin.errors import fail, warn


class BitymiPipeline(VanillaPipeline):
    """Data manager and model, as nerfstudio pairs them."""

    def __init__(self, *args: Any, world_size: int = 1, local_rank: int = 0, **kwargs: Any) -> None:
        # as if alone: nerfstudio would wrap the model, to add gradients of parameters that keep their size
        super().__init__(*args, **kwargs)
        self.world_size = self.datamanager.world_size = world_size
        self.datamanager.local_rank = local_rank

    def load_pipeline(self, loaded_state: dict[str, Any], step: int) -> None:
        """Load the parameters of a checkpoint."""
        try:
            super().load_pipeline(loaded_state, step)
        except (RuntimeError, LookupError, TypeError, AttributeError) as error:  # torch's list of what does not fit
            fail(f"the checkpoint of step {step} does not fit this scene. {error}", error)

    def get_average_image_metrics(self, data_loader: Any, *args: Any, **kwargs: Any) -> dict[str, float]:
        """Averages over images, without NaN, which JSON does not know.

        The deviation of a single image is 0. A metric that an image has none of, because no pixel of it counts, is
        left out.
        """
        if len(data_loader) == 0:
            fail("there is no held-out view to evaluate: none was held out, or their masks exclude every pixel")
        metrics = super().get_average_image_metrics(data_loader, *args, **kwargs)
        missing = [k for k, v in metrics.items() if math.isnan(v) and not k.endswith("_std")]
        if missing:
            warn(f"{', '.join(missing)} is left out: there is a held-out view of which no pixel counts.")
        kept = {k: v for k, v in metrics.items() if k.removesuffix("_std") not in missing}
        return {k: 0.0 if math.isnan(v) else v for k, v in kept.items()}


@dataclass
class BitymiPipelineConfig(VanillaPipelineConfig):
    """Configuration of the pipeline."""

    _target: type = field(default_factory=lambda: BitymiPipeline)
