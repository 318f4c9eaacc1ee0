"""The scene in training as a nerfstudio model."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import torch
import tyro
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes
from torch import Tensor
from torch.nn import Parameter

from bitymi_ns.ops.view_kinds import VIEW_PARAMETERS
from bitymi_ns.plugin.errors import fail
from bitymi_ns.plugin.run.callbacks import TrainingRun
from bitymi_ns.plugin.run.checkpoints import STATE_VERSION
from bitymi_ns.plugin.run.scene_setup import new_scene
from bitymi_ns.plugin.run.surfel_model import SurfelModel, SurfelModelConfig
from bitymi_ns.scene.camera import Camera
from bitymi_ns.scene.config import SceneConfig
from bitymi_ns.scene.field import HashField
from bitymi_ns.scene.scene import GEOMETRY
from bitymi_ns.train.config import TrainConfig
from bitymi_ns.train.losses import photometric
from bitymi_ns.train.views import View, judging_background

SURFEL_PARAMETERS = (*GEOMETRY, *VIEW_PARAMETERS)
PARAMETER_GROUPS = (*SURFEL_PARAMETERS, "field_table", "field_mlp")
"""Groups that an optimiser is configured for; a scene has those that its view colour and texture call for."""


@dataclass
class BitymiModelConfig(SurfelModelConfig):
    """Configuration of the model."""

    _target: type = field(default_factory=lambda: BitymiModel)
    scene: SceneConfig = field(default_factory=SceneConfig)
    """What the scene is made of."""
    train: TrainConfig = field(default_factory=TrainConfig)
    """How it is trained."""
    steps: tyro.conf.Suppress[int | None] = None
    """Length of the run, where one is going to be made."""
    curve_points: int = 20
    """Evaluations over a run, for the curve of quality against time (training_curve.jsonl); 0 = none."""
    curve_views: int = 8
    """Held-out views rendered for a point of that curve, all for the last one; 0 = all."""


def train_config_for(config: TrainConfig, alpha_color: Tensor | None, transparent: bool) -> TrainConfig:
    """The training options with the colour that the capture states for its transparent images, if any: it is their
    `alpha_color`, and stands for a `background` of one colour. Where none is transparent, also for auto."""
    color = config.alpha_color if alpha_color is None else _name_of(alpha_color)
    one = config.background in ("black", "white") and alpha_color is not None
    background = color if one or (config.background == "auto" and not transparent) else config.background
    return dataclasses.replace(config, background=background, alpha_color=color)


def _name_of(alpha_color: Tensor) -> Literal["black", "white"]:
    for name, value in (("black", 0.0), ("white", 1.0)):
        if bool((alpha_color == value).all()):
            return name  # type: ignore[return-value]
    fail(f"the capture's alpha colour {alpha_color.tolist()} cannot be trained on; choose black or white")


class BitymiModel(SurfelModel):
    """Textured Beta surfels.

    The checkpoint holds, beside the parameters, everything that a resumed run needs to go on as if it had not been
    interrupted: the state of the strategy, of the random generators and of the clocks.
    """

    config: BitymiModelConfig

    def populate_modules(self) -> None:
        super().populate_modules()
        self.metadata: dict[str, Any] = self.kwargs.get("metadata") or {}
        self.train_config = train_config_for(
            self.config.train, self.metadata.get("alpha_color"), bool(self.metadata.get("transparent"))
        )
        points = self.kwargs.pop("seed_points", None)
        self.scene = new_scene(
            points, self.scene_box, self.config.scene, self.train_config, self.metadata, self.config.steps
        )
        self.metadata["first_surfels"] = len(self.scene)  # a checkpoint that is loaded may have another number
        self.trained_for: int | None = None
        self.resume_state: dict[str, Any] = {}
        self._run: TrainingRun | None = None

    # rendering

    @property
    def background(self) -> Tensor:
        """[3]: see `judging_background`."""
        color = judging_background(self.train_config, self.device)
        return torch.zeros(3, device=self.device) if color is None else color

    def render(self, camera: Camera, background: Tensor, maps: bool) -> Any:
        with torch.no_grad():
            return self.scene.render(camera, background=background, field_mode="frozen", maps=maps)

    def surfel_count(self) -> int:
        return len(self.scene)

    def get_outputs(self, ray_bundle: Any) -> dict[str, Any]:
        """Of a training view the terms of its loss, of cameras the pictures."""
        if isinstance(ray_bundle, View):
            if self._run is None:
                raise RuntimeError("losses exist in training only")
            return {"losses": self._run.losses(ray_bundle)}
        return super().get_outputs(ray_bundle)

    # training

    def get_param_groups(self) -> dict[str, list[Parameter]]:
        groups = {name: [parameter] for name, parameter in self.scene.surfels.items()}
        if isinstance(self.scene.field, HashField):
            named = dict(self.scene.field.named_parameters())
            groups["field_table"] = [p for n, p in named.items() if n.endswith("table")]
            groups["field_mlp"] = [p for n, p in named.items() if not n.endswith("table")]
        return groups

    def get_training_callbacks(
        self, training_callback_attributes: TrainingCallbackAttributes
    ) -> list[TrainingCallback]:
        self.measure_time = False
        self._run = TrainingRun(
            self.scene,
            self.train_config,
            training_callback_attributes,
            self.metadata,
            self.background,
            self.resume_state,
            self.config.curve_points,
            self.config.curve_views,
        )
        return self._run.callbacks()

    def get_loss_dict(
        self, outputs: dict[str, Any], batch: dict[str, Any], metrics_dict: Any = None
    ) -> dict[str, Tensor]:
        """Of a training view what `get_outputs` found; of a held-out one, which nerfstudio asks for where
        --steps-per-eval-batch is given, the photometric loss."""
        if "losses" in outputs:
            return outputs["losses"]
        target, mask = self.photograph(batch, outputs["rgb"])
        return {"photometric": photometric(outputs["rgb"], target, self.train_config.loss.ssim_weight, mask)}

    # checkpoints

    def get_extra_state(self) -> dict[str, Any]:
        """Tensors, numbers and text only, so that torch loads it in its safe mode."""
        state: dict[str, Any] = {"version": STATE_VERSION, "scene": json.dumps(dataclasses.asdict(self.config.scene))}
        state["near"], state["first_surfels"] = self.scene.near, self.metadata["first_surfels"]
        if self._run is not None:
            state["trained_for"] = self._run.total
            state["run"] = self._run.state()
        elif self.trained_for is not None:
            state["trained_for"] = self.trained_for
        return state

    def set_extra_state(self, state: Any) -> None:
        self.trained_for = state.get("trained_for")
        self.resume_state = state.get("run", {})
        self.metadata["first_surfels"] = state.get("first_surfels", self.metadata["first_surfels"])
        if self.config.scene.near is None:
            self.scene.near = state.get("near", 0.2)  # older checkpoints: what all scenes had

    def load_state_dict(self, state_dict: Mapping[str, Any], strict: bool = True, assign: bool = False) -> Any:
        """Load a checkpoint (`checkpoints.load` has checked that it belongs to this preset), whatever its number of
        surfels."""
        self.scene.make_room(state_dict, "scene.")
        for name, parameter in self.named_parameters():
            saved = state_dict.get(name)
            if saved is not None and saved.shape != parameter.shape:
                # the same Parameter object: nerfstudio's optimisers hold it already
                parameter.data = torch.zeros(saved.shape, dtype=parameter.dtype, device=parameter.device)
        return super().load_state_dict(state_dict, strict=True)
