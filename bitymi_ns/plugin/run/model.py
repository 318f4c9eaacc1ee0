"""The scene in training as a nerfstudio model."""

import dataclasses
import json
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Literal

import torch
import tyro
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes
from torch import Tensor
from torch.nn import Parameter

from bitymi_ns.ops.view_kinds import PARAMETERS
from bitymi_ns.scene.camera import Camera
from bitymi_ns.scene.config import SceneConfig
from bitymi_ns.scene.field import HashField
from bitymi_ns.scene.scene import Scene
from bitymi_ns.train import messages
from bitymi_ns.train.background_points import background_points
from bitymi_ns.train.config import TrainConfig
from bitymi_ns.train.init import build_scene, limit_first_surfels
from bitymi_ns.train.losses import photometric
from bitymi_ns.train.poses import aligned, view_psnr
from bitymi_ns.train.views import View, eval_background
from ..console import fail, say, warn
from ..data.facts import CaptureFacts
from .callbacks import TrainingRun
from .checkpoints import STATE_VERSION
from .surfel_model import SurfelModel, SurfelModelConfig

_NO_OPACITY = -1e4  # logit
PARAMETER_GROUPS = (*PARAMETERS, "field_table", "field_mlp")
"""Groups with a configured optimiser; a scene has those of its view colour and texture."""


@dataclass
class BitymiModelConfig(SurfelModelConfig):
    _target: type = field(default_factory=lambda: BitymiModel)
    scene: SceneConfig = field(default_factory=SceneConfig)  # The scene's options.
    train: TrainConfig = field(default_factory=TrainConfig)  # Training options.
    steps: tyro.conf.Suppress[int | None] = None  # Length of a run to come.
    curve_points: int = 20
    """Evaluations over a run for the curve of quality against time; 0 = none."""
    curve_views: int = 8  # Held-out views per point; all for the last one; 0 = all.


def train_config_for(config: TrainConfig, alpha_color: Tensor | None, transparent: bool) -> TrainConfig:
    """Return training options with the colour that the capture states for transparent images, if any, as `alpha_color`
    and in place of a `background` of black or white. Without transparent images, auto becomes `alpha_color`."""
    color = config.alpha_color
    if alpha_color is not None:
        names: dict[float, Literal["black", "white"]] = {0.0: "black", 1.0: "white"}
        values = alpha_color.unique().tolist()
        if len(values) != 1 or values[0] not in names:
            fail(f"the capture's alpha colour {alpha_color.tolist()} cannot be trained on; choose black or white")
        color = names[values[0]]
    one = config.background in ("black", "white") and alpha_color is not None
    background = color if one or (config.background == "auto" and not transparent) else config.background
    return dataclasses.replace(config, background=background, alpha_color=color)


class BitymiModel(SurfelModel):
    """Textured Beta surfels. Checkpoints hold all that a resumed run needs to go on as if uninterrupted."""

    config: BitymiModelConfig

    def populate_modules(self) -> None:
        super().populate_modules()
        self.facts = CaptureFacts.of(self.kwargs.get("metadata") or {})
        self.train_config = train_config_for(self.config.train, self.facts.alpha_color, self.facts.transparent)
        points = self.kwargs.pop("seed_points", None)
        config, steps = self.config.scene, self.config.steps
        self.scene = new_scene(points, self.scene_box, config, self.train_config, self.facts, steps)
        self.first_surfels = len(self.scene)
        self.trained_for: int | None = None
        self.resume_state: dict[str, Any] = {}
        self.recorded_options: str | None = None  # of a resumed run
        self.run: TrainingRun | None = None  # in training
        self.carry: Callable[[Camera], Camera] | None = None  # if a finished run refined poses

    @property
    def background(self) -> Tensor:
        color = eval_background(self.train_config, self.device)
        return torch.zeros(3, device=self.device) if color is None else color

    def render(self, camera: Camera, background: Tensor, maps: bool) -> Any:
        with torch.no_grad(), self._cropped():
            return self.scene.render(camera, background=background, field_mode="frozen", maps=maps)

    @contextmanager
    def _cropped(self) -> Iterator[None]:
        """Set the opacity of surfels outside the crop box to 0 meanwhile: none may be missing, as tiles are counted by
        surfels."""
        if self.crop_box is None:
            yield
            return
        logits = self.scene.surfels["opacity_logits"]
        opacities = logits.data
        logits.data = opacities.masked_fill(~self.crop_box.contains(self.scene.surfels["means"].data), _NO_OPACITY)
        try:
            yield
        finally:
            logits.data = opacities

    @property
    def seconds_left(self) -> float | None:
        return None if self.run is None else self.run.forecast.left

    def sizes(self) -> dict[str, float]:
        return {"surfels": float(len(self.scene))}

    def get_image_metrics_and_images(
        self, outputs: dict[str, Tensor], batch: dict[str, Any]
    ) -> tuple[dict[str, float], dict[str, Tensor]]:
        """Measure a held-out view; after a run that refined poses, also with its pose carried along with those of the
        training views (carried_psnr), and aligned to the scene (refined_psnr)."""
        metrics, images = super().get_image_metrics_and_images(outputs, batch)
        camera = getattr(self, "_last_camera", None)
        if self.carry is not None and camera is not None:
            view = View(self.carry(camera), *self.photograph(batch, outputs["rgb"]))
            metrics["carried_psnr"] = view_psnr(self.scene, view, self.background)
            view = view._replace(camera=aligned(self.scene, view, self.background, self.train_config.loss.ssim_weight))
            metrics["refined_psnr"] = view_psnr(self.scene, view, self.background)
        return metrics, images

    def get_param_groups(self) -> dict[str, list[Parameter]]:
        groups = {name: [parameter] for name, parameter in self.scene.surfels.items()}
        if isinstance(self.scene.field, HashField):
            table, *mlp = self.scene.field.weights
            groups |= {"field_table": [table], "field_mlp": mlp}
        return groups

    def get_training_callbacks(
        self, training_callback_attributes: TrainingCallbackAttributes
    ) -> list[TrainingCallback]:
        self.measure_time = False
        self.run = TrainingRun(self, training_callback_attributes)
        return self.run.callbacks()

    def get_loss_dict(
        self, outputs: dict[str, Any], batch: dict[str, Any], metrics_dict: Any = None
    ) -> dict[str, Tensor]:
        """Return the photometric loss of a held-out view (--steps-per-eval-batch)."""
        target, mask = self.photograph(batch, outputs["rgb"])
        return {"photometric": photometric(outputs["rgb"], target, self.train_config.loss.ssim_weight, mask)}

    def get_extra_state(self) -> dict[str, Any]:
        """Return tensors, numbers and text only."""
        state: dict[str, Any] = {"version": STATE_VERSION, "scene": json.dumps(dataclasses.asdict(self.config.scene))}
        state["train"] = messages.recorded(self.train_config)
        state["near"], state["first_surfels"] = self.scene.near, self.first_surfels
        if self.run is not None:
            state["trained_for"] = self.run.total
            state["run"] = self.run.state()
        elif self.trained_for is not None:
            state["trained_for"] = self.trained_for
        return state

    def set_extra_state(self, state: Any) -> None:
        self.trained_for = state.get("trained_for")
        self.resume_state, self.recorded_options = state.get("run", {}), state.get("train")
        self.first_surfels = state.get("first_surfels", self.first_surfels)
        if self.config.scene.near is None:
            self.scene.near = state.get("near", 0.2)  # of older checkpoints

    def load_state_dict(self, state_dict: Mapping[str, Any], strict: bool = True, assign: bool = False) -> Any:
        """Load a checkpoint of any number of surfels, which `checkpoints.load` has checked."""
        self.scene.resize_for_state(state_dict, "scene.")
        for name, parameter in self.named_parameters():
            saved = state_dict.get(name)
            if saved is not None and saved.shape != parameter.shape:
                # the optimisers hold the Parameter already
                parameter.data = torch.zeros(saved.shape, dtype=parameter.dtype, device=parameter.device)
        return super().load_state_dict(state_dict, strict=True)


MANY_POINTS = 500_000  # points, of which surfels take long to make
FEW_POINTS = 50  # below, much of a scene may have none near it


def new_scene(
    points: tuple[Tensor, Tensor] | None,
    scene_box: SceneBox | None,
    config: SceneConfig,
    train: TrainConfig,
    facts: CaptureFacts,
    steps: int | None = None,
) -> Scene:
    """Make surfels at points (positions [N, 3], colours [N, 3] uint8 or empty), or at random in the capture's box;
    `steps`: length of a run to come."""
    centers, pixels = facts.camera_centers, facts.train_pixels
    if steps is not None:
        train = limit_first_surfels(train, steps, pixels, len(centers))
    xyz, rgb = points or (torch.zeros(0, 3), torch.zeros(0, 3))
    xyz, rgb = xyz.detach().reshape(-1, 3), rgb.detach()
    if rgb.shape[:1] == xyz.shape[:1]:
        rgb = rgb.float().reshape(-1, 3) / (255.0 if rgb.dtype == torch.uint8 else 1.0)
    else:
        rgb = torch.full_like(xyz, 0.5, dtype=torch.float32)
    xyz = xyz.float()
    declared = None if scene_box is None or not facts.declares_box else _corners(scene_box)
    box = None
    advice = "start from random ones: `bitymi-data --points random`."
    if not bool(torch.isfinite(xyz).all(1).any()):
        if len(xyz):
            fail(f"all {len(xyz)} points of the capture are NaN or infinite. Make them again, or {advice}")
        box = None if scene_box is None else _corners(scene_box)
    many, started = len(xyz) >= MANY_POINTS, time.perf_counter()
    if many:
        say(f"Making surfels of {len(xyz):,} points. This may take minutes.")
    background, views = None, facts.background_views
    if len(xyz) and len(views) and train.background_points:
        background = background_points(xyz, views, facts.seed)
    scene, report = build_scene(xyz, rgb, centers, config, train, facts.has_alpha, pixels, box, declared, background)
    if many:
        say(f"Making surfels took {time.perf_counter() - started:.1f} s.")
    for sentence in messages.warnings_at_start(report, train, pixels, config):
        say(sentence)
    if report.random:
        say(f"Surfels are made of {report.random:,} random points.")
    if report.background:
        say(f"{report.background:,} more surfels start where the photographs show no point.")
    usable = report.given - report.not_finite - report.duplicates
    if 0 < usable < FEW_POINTS:
        warn(f"The capture has only {usable} different points. If little appears, {advice}")
    if report.not_finite:
        row = int(torch.nonzero(~torch.isfinite(xyz).all(1))[0])
        what = f"{report.not_finite} of {report.given} points of the capture are not finite"
        warn(f"{what} (the first is point {row}); they are left out.")
    return scene


def _corners(scene_box: SceneBox) -> Tensor:
    corners = scene_box.aabb.float().cpu().reshape(2, 3)
    low, high = corners
    if not bool(torch.isfinite(corners).all()) or not bool((high > low).all()):
        fail(
            f"the scene box of the capture, from {low.tolist()} to {high.tolist()}, is empty. Correct it; in "
            "nerfstudio's format give a point cloud, or a positive --scene-scale after `nerfstudio-data`."
        )
    return corners
