"""Images of the worst held-out views: errors, and the contribution of each part of the scene."""

import io
import json
import re
from functools import partial
from pathlib import Path
from typing import Any

import torch
from PIL import Image
from torch import Tensor

from bitymi_ns.files import complete_folder, write_errors_as
from bitymi_ns.measure.report.pictures import ERROR_CAPTION, ERROR_SCALE, heat
from bitymi_ns.measure.report.read import PICTURES
from bitymi_ns.ops import blended_image, fragment_residual
from bitymi_ns.ops.constants import COLOR_BIAS
from bitymi_ns.plugin.console import InputError, fail, say
from bitymi_ns.plugin.export.trained import load_trained
from bitymi_ns.plugin.run.metrics import image_metrics
from bitymi_ns.plugin.run.surfel_model import OVERDRAW_SCALE
from bitymi_ns.scene import RenderOutput, Scene
from bitymi_ns.scene.baked import as_bytes
from bitymi_ns.scene.field import TexelField

FILE = re.compile(r"view\d{4,}-\w+\.png")  # name of an image
RESIDUAL_GAIN = 4.0  # residuals are small; their images are scaled by this factor

KINDS = {
    "photo": "photograph",
    "final": "render",
    "error": ERROR_CAPTION,
    "view_color": "view colour alone (f_view)",
    "residual_positive": f"positive residual, x{RESIDUAL_GAIN:g}",
    "residual_negative": f"negative residual, x{RESIDUAL_GAIN:g}",
    "overdraw": f"overdraw: surfels blended at a pixel, 0 (black) to {OVERDRAW_SCALE:g} (yellow)",
}
"""Images of a view in order, with their captions."""


def heat_map(values: Tensor, scale: float) -> Tensor:
    """Map values [H, W] or [H, W, 1] to colours [H, W, 3]: black at 0, yellow at `scale` and above."""
    return torch.from_numpy(heat(values.reshape(*values.shape[:2]).float().cpu().numpy(), scale))


@torch.no_grad()
def residual_parts(scene: Scene, output: RenderOutput) -> tuple[Tensor, Tensor]:
    """Blend the positive and the negative part of the residual: sum of w max(rho, 0) and of w max(-rho, 0), [H, W, 3].

    As in rendering, fragments below the weight bound have no residual. View colour + positive - negative is the render
    wherever no colour was clamped at 0. The scene must have a texture.
    """
    field, bound = scene.field, scene.config.weight_bound
    # with view colours of 0 a fragment's colour is the positive part of its residual
    dark = torch.full_like(scene.surfels["means"], -COLOR_BIAS)
    bands = []
    for fragments in output.fragments.lists():
        if isinstance(field, TexelField):
            textures = [{"texels": sign * field.texels.detach(), "tiles": field.tiles} for sign in (1, -1)]
        else:
            rho = fragment_residual(fragments, output.projection.frames, field.geometry, field.weights, bound)
            textures = [{"residual": rho}, {"residual": -rho}]
        parts = [blended_image(fragments, output.projection, dark, bound=bound, **t)[:, :3] for t in textures]
        bands.append(torch.cat(parts, dim=1).view(fragments.height, fragments.width, 6))
    positive, negative = torch.cat(bands).split(3, dim=-1)
    return positive, negative


@torch.no_grad()
def decompose(scene: Scene, camera: Any, background: Tensor, photo: Tensor) -> dict[str, Tensor]:
    """Render the images of one view, [H, W, 3] each, by name (`KINDS`); view colour and residual need a texture."""
    output = scene.render(camera, background, "frozen")
    final = output.rgb.clamp(0.0, 1.0)
    pictures = {"photo": photo, "final": final, "error": heat_map((final - photo).abs().mean(-1), ERROR_SCALE)}
    if scene.field is not None:
        pictures["view_color"] = scene.render(camera, background, "off").rgb
        positive, negative = residual_parts(scene, output)
        pictures |= {"residual_positive": RESIDUAL_GAIN * positive, "residual_negative": RESIDUAL_GAIN * negative}
    pictures["overdraw"] = heat_map(output.overdraw, OVERDRAW_SCALE)
    return pictures


def png(image: Tensor) -> bytes:
    """Encode [H, W, 3] in [0, 1] as PNG."""
    buffer = io.BytesIO()
    Image.fromarray(as_bytes(image).numpy()).save(buffer, format="PNG")
    return buffer.getvalue()


def _check_output(folder: Path) -> None:
    """Fail if a folder holds other files than earlier images, which would be lost."""
    if folder.is_dir() and not all(FILE.fullmatch(path.name) or path.name == PICTURES for path in folder.iterdir()):
        fail(f"the folder {folder} holds other files than pictures of a run and is not replaced: choose another one.")


@torch.no_grad()
def draw_worst(load_config: Path, output_dir: Path, views: int) -> None:
    """Write images of the held-out views with the lowest PSNR, and pictures.json, which describes them.

    Args:
        load_config: config.yml of a trained run.
        output_dir: folder of the files; earlier ones are replaced, others refused.
        views: number of views.
    """
    if views < 1:
        fail(f"--views must be at least 1, not {views}")
    with (
        write_errors_as(output_dir, InputError, "."),
        complete_folder(output_dir, partial(_check_output, output_dir)) as new,
    ):
        config, pipeline = load_trained(load_config)
        model, datamanager = pipeline.model, pipeline.datamanager
        count = len(datamanager.eval_dataset)
        if count == 0:
            fail("the run has no held-out views to choose the worst of")
        background = model.background
        ranked = []
        for index, view in enumerate(datamanager.eval_views):
            photo = view.target(background, model.device)
            rgb = model.render(view.camera, background, maps=False).rgb.clamp(0.0, 1.0)
            ranked.append((image_metrics(rgb, photo, view.mask), index, view.camera, photo))
        ranked.sort(key=lambda entry: (entry[0]["psnr"], entry[1]))
        shown = []
        for rank, (metrics, index, camera, photo) in enumerate(ranked[:views]):
            files = {}
            for kind, image in decompose(model.scene, camera, background, photo).items():
                files[kind] = f"view{index:04d}-{kind}.png"
                (new / files[kind]).write_bytes(png(image))
            figures = {name: round(value, 4) for name, value in metrics.items()}
            shown.append({"view": index, "rank": rank + 1, "of": count, "metrics": figures, "files": files})
        about = {"scene": config.experiment_name, "method": config.method_name}
        text = json.dumps({"bitymi_pictures": 1, **about, "captions": KINDS, "views": shown}, indent=1)
        (new / PICTURES).write_text(text, "utf8")
    say(f"Wrote {len(shown)} views to {output_dir}")
