"""The scene as a nerfstudio model."""

from __future__ import annotations

from dataclasses import dataclass, field

from nerfstudio.models.base_model import Model, ModelConfig

from bitymi_ns.scene.config import SceneConfig
from bitymi_ns.train.config import TrainConfig

SURFEL_PARAMETERS = (
    "means",
    "quats",
    "log_scales",
    "opacity_logits",
    "beta_raw",
    "sv_sites",
    "sv_log_tau",
    "sv_rgb",
    "sh_dc",
    "sh_rest",
    "sb_base",
    "sb_lobes",
    "sg_base",
    "sg_lobes",
)
PARAMETER_GROUPS = (*SURFEL_PARAMETERS, "field_table", "field_mlp")
"""Groups that an optimiser is configured for; a scene has those that its view colour and texture call for."""


@dataclass
class BitymiModelConfig(ModelConfig):
    """Configuration of the model."""

    _target: type = field(default_factory=lambda: BitymiModel)
    enable_collider: bool = False
    scene: SceneConfig = field(default_factory=SceneConfig)
    """What the scene is made of."""
    train: TrainConfig = field(default_factory=TrainConfig)
    """How it is trained."""
    curve_points: int = 20
    """Evaluations over a run, for the curve of quality against time (training_curve.jsonl); 0 = none."""
    curve_views: int = 8
    """Held-out views rendered for a point of that curve, all for the last one; 0 = all."""


class BitymiModel(Model):
    pass
