"""Base of nerfstudio models of trained and baked scenes."""

from __future__ import annotations

import threading
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import torch
import tyro
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.scene_box import OrientedBox
from nerfstudio.models.base_model import Model, ModelConfig
from torch import Tensor
from torch.nn import Parameter

from bitymi_ns.scene.camera import Camera
from bitymi_ns.scene.crop import Box
from bitymi_ns.train.views import as_float, downscale_image, downscale_mask, over_background, shown
from ..console import InputError, warn_once
from ..data.cameras import normal_image, ray_distance, to_camera
from ..data.dataset import POSE_STEP
from .device import kernel_device
from .metrics import image_metrics, render_milliseconds

OVERDRAW_SCALE = 64.0
"""Blended surfels per pixel at the end of overdraw's colour map."""


@dataclass
class SurfelModelConfig(ModelConfig):
    """Base of model options. nerfstudio's options for models of rays are hidden in --help."""

    enable_collider: tyro.conf.Suppress[bool] = False
    collider_params: tyro.conf.Suppress[dict[str, float] | None] = None
    loss_coefficients: tyro.conf.Suppress[dict[str, float]] = field(default_factory=dict)
    eval_num_rays_per_chunk: tyro.conf.Suppress[int] = 4096
    prompt: tyro.conf.Suppress[str | None] = None


def box_of(box: OrientedBox | None) -> Box | None:
    """Convert nerfstudio's box, whose scale is its sides."""
    return None if box is None else Box.of(box.T.tolist(), (box.S / 2).tolist(), box.R.tolist())


class SurfelModel(Model):
    measure_time = True  # measures render_ms; off in training
    crop_box: Box | None = None  # hides surfels with centres outside
    corrections: Sequence[tuple[Camera, Tensor | None]] = ()
    """Cameras of the capture's photographs with their colour corrections, if the run made some."""

    @abstractmethod
    def render(self, camera: Camera, background: Tensor, maps: bool) -> Any:
        """Draw a RenderOutput: rgb, alpha, beta, overdraw, and with maps depth and normal."""

    @abstractmethod
    def sizes(self) -> dict[str, float]:
        """Return the number of `surfels`, and other sizes."""

    @property
    @abstractmethod
    def background(self) -> Tensor:
        """Colour [3] in evaluation."""

    def crop_to(self, box: OrientedBox | None) -> None:
        """Hide the surfels outside of nerfstudio's crop box."""
        self.crop_box = box_of(box)

    def to(self, *args: Any, **kwargs: Any) -> SurfelModel:
        """Move the model, except to a device without kernels."""
        core: Any = torch._C
        device, dtype, _, _ = core._nn._parse_to(*args, **kwargs)
        if dtype is not None:
            raise ValueError("the scene is float32")
        return self if device is None else super().to(kernel_device(device))

    def get_outputs(self, ray_bundle: Any) -> dict[str, Any]:
        if not isinstance(ray_bundle, Cameras):
            raise TypeError("this model renders cameras, not bundles of rays")
        return self.outputs_of(to_camera(ray_bundle, self.device), maps=True)

    def outputs_of(self, camera: Camera, maps: bool) -> dict[str, Tensor]:
        """Draw the outputs of viewer and ns-render, [H, W, C] float32: rgb, accumulation; with maps also depth =
        expected distance along the ray, normal = world normal as (n + 1) / 2 (0 for none), beta = blended kernel
        exponent / 4, overdraw = surfels blended at the pixel / OVERDRAW_SCALE."""
        output = self.render(camera, self.background, maps=maps)
        outputs = {"rgb": output.rgb.clamp(0.0, 1.0), "accumulation": output.alpha}
        if output.depth is not None:
            outputs["depth"] = ray_distance(output.depth, output.alpha, camera)
        if output.normal is not None:
            outputs["normal"] = normal_image(output.normal, camera)
        if getattr(output, "beta", None) is not None:
            outputs["beta"] = output.beta / 4.0
        if output.overdraw is not None:
            outputs["overdraw"] = output.overdraw.float() / OVERDRAW_SCALE
        return outputs

    @torch.no_grad()
    def get_outputs_for_camera(self, camera: Cameras, obb_box: OrientedBox | None = None) -> dict[str, Tensor]:
        """Render a camera, with only the surfels in the crop box if given. In the viewer's thread, which a refusal
        would end, a camera that cannot be rendered gives an empty picture."""
        self.crop_to(obb_box)
        try:
            self._last_camera = to_camera(camera, self.device)
            outputs = self.get_outputs(camera)
        except InputError as error:
            if threading.current_thread() is threading.main_thread():
                raise
            warn_once(str(error))
            black = torch.zeros(int(camera.height.flatten()[0]), int(camera.width.flatten()[0]), 3, device=self.device)
            one = dict.fromkeys(("accumulation", "depth", "beta", "overdraw"), black[..., :1])
            return {"rgb": black + self.background.to(black), "normal": black, **one}
        return {name: value for name, value in outputs.items() if isinstance(value, Tensor)}

    def photograph(self, batch: dict[str, Any], rgb: Tensor) -> tuple[Tensor, Tensor | None]:
        """Return the batch's photograph [H, W, 3] over the background and its mask [H, W, 1], at a render's size."""
        height, width = rgb.shape[:2]
        target = downscale_image(as_float(batch["image"].to(rgb.device)), width, height)
        mask = batch.get("mask")
        mask = None if mask is None else downscale_mask(mask.to(rgb.device), width, height)
        return over_background(target, self.background), mask

    def get_image_metrics_and_images(
        self, outputs: dict[str, Tensor], batch: dict[str, Any]
    ) -> tuple[dict[str, float], dict[str, Tensor]]:
        """Measure a held-out view's quality and cost; show photograph and render side by side."""
        rgb = outputs["rgb"]
        height, width = rgb.shape[:2]
        target, mask = self.photograph(batch, rgb)
        camera = getattr(self, "_last_camera", None)
        if camera is not None and (camera.width, camera.height) != (width, height):
            camera = None  # drawn elsewhere
        if camera is not None and self.corrections:
            rgb, drawn = self._exposed(camera), rgb
            metrics = image_metrics(rgb, target, mask, drawn)
        else:
            metrics = image_metrics(rgb, target, mask)
        metrics["fragments_per_pixel"] = float(outputs["overdraw"].mean()) * OVERDRAW_SCALE
        metrics.update(self.sizes())
        if self.measure_time and camera is not None:
            draw = partial(self.render, camera, self.background, maps=False)
            metrics["render_ms"] = render_milliseconds(draw, self.device)
        return metrics, {"img": torch.cat([target, rgb], dim=1)}

    def _exposed(self, camera: Camera) -> Tensor:
        """Draw a view [H, W, 3] with its photograph's colour correction, if any."""

        def apart(other: Camera) -> float:
            return float((other.viewmat.cpu() - camera.viewmat.cpu()).abs().max())

        nearest, correction = min(self.corrections, key=lambda each: apart(each[0]))
        if correction is not None:
            correction = correction.to(self.device) if apart(nearest) <= POSE_STEP else None
        drawn = self.render(camera, self.background, maps=False)
        return shown(drawn.rgb, correction, drawn.alpha, self.background)

    def get_rgba_image(self, outputs: dict[str, Tensor], output_name: str = "rgb") -> Tensor:
        """Return [H, W, 4] with straight alpha."""
        alpha = outputs["accumulation"]
        rgb = (outputs[output_name] - (1.0 - alpha) * self.background.to(alpha)) / alpha.clamp(min=1e-6)
        return torch.cat([torch.where(alpha > 0, rgb, 0.0).clamp(0.0, 1.0), alpha], dim=-1)

    def get_metrics_dict(self, outputs: dict[str, Any], batch: dict[str, Any]) -> dict[str, Tensor]:
        return {"surfels": torch.tensor(self.sizes()["surfels"])}

    def get_loss_dict(
        self, outputs: dict[str, Any], batch: dict[str, Any], metrics_dict: Any = None
    ) -> dict[str, Tensor]:
        raise NotImplementedError("this scene is not trained any further")

    def get_param_groups(self) -> dict[str, list[Parameter]]:
        return {}
