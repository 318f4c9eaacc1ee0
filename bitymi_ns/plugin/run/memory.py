"""Estimate memory of training or an export before the start: by fragments of a few views (docs/training.md, Memory),
and numbers measured with the default preset on the CPU, or counted from arrays on a GPU."""

from collections.abc import Sequence

import psutil
import torch

from bitymi_ns.bake.tuning_views import LEAST_KEPT
from bitymi_ns.bake.view_colors import choice_bytes
from bitymi_ns.ops import can_rasterize, project
from bitymi_ns.ops.capacity import NUMBERS, free_memory
from bitymi_ns.ops.project import geometry_of
from bitymi_ns.ops.trace_cpu import MOST, count
from bitymi_ns.ops.view_kinds import VIEW_COLORS
from bitymi_ns.ranges import spread
from bitymi_ns.scene.camera import Camera
from bitymi_ns.scene.field import TexelField
from bitymi_ns.scene.scene import Scene
from bitymi_ns.train.config import TexelConfig
from bitymi_ns.train.forecast import KEPT
from bitymi_ns.train.memory import (
    FILLED,
    PER_FRAGMENT,
    PER_PIXEL,
    PER_SURFEL,
    PER_TEXEL,
    PER_TEXEL_SUM,
    available_memory,
)
from bitymi_ns.train.texels import SMALLEST, most_texels
from bitymi_ns.train.views import DOWNSCALED_BYTES, photograph_budget
from ..console import say, warn
from ..data.dataset import PHOTOGRAPH_BYTES

COUNTED_VIEWS = 3  # views with counted fragments
MARGIN = 1.1  # other views may have more fragments
PROGRAM = 800e6  # bytes of Python, libraries, and a capture's cameras and points
FREED = 500e6
"""Bytes of freed blocks, each too small to be returned, that are kept for later views; less for small ones, which take
`KEPT_LISTS` times their lists and pictures so, and more for large ones, `KEPT_LISTS` times their pictures."""
KEPT_LISTS = 2
MOST_KEPT = 2.8e6  # pixels of a picture of such a block; larger ones are returned
PER_SHADED_FRAGMENT = 60
"""Further bytes with a hash-grid field: surfels, pixels, points and residuals, and their gradients."""
PER_GPU_FRAGMENT = 4 * NUMBERS  # bytes on a GPU in lists of training
PER_PASSING_FRAGMENT = 36  # bytes on a GPU in temporary lists, for the coverage of texels
PER_BAKED_FRAGMENT = 48
"""Bytes on a GPU in the fine-tuning of an export: 28 of the list, 1 + 36 of the part that shows texels, at most 43 % as
measured, and 3 of the pairs of surfel and tile."""
PER_BAKED_TEXEL = 96  # bytes in an export: eight copies
PER_KEPT_FRAGMENT, PER_KEPT_PIXEL = 20 * 0.22, 24
"""Bytes of a view that the fine-tuning keeps; 22 to 43 % of the fragments show a texel."""
VIEWS_OF_TEXELS = 7  # views' worth of texels; 3.7 to 15 were measured
SPREAD = 1.3  # factor to either side of the estimate


@torch.no_grad()
def most_fragments(scene: Scene, cameras: Sequence[Camera], bound: int = 0) -> int:
    """Estimate the most fragments of any of these views, by a count of a few; those with more than `bound` (0 = what
    fits) are drawn in bands."""
    p, most = scene.surfels, 0
    for i in spread(len(cameras), COUNTED_VIEWS):
        camera = cameras[i].to("cpu")
        geometry = (value.cpu() for value in geometry_of(p))
        most = max(most, count(project(*geometry, camera=camera, near=scene.near)))
    device = p["means"].device
    capacity = int(free_memory(device)) // PER_GPU_FRAGMENT if device.type == "cuda" else MOST
    return min(int(MARGIN * most), bound or capacity)


def state_training(
    scene: Scene,
    cameras: Sequence[Camera],
    most_surfels: float,
    texels: TexelConfig | None = None,
    to_come: int = 0,
    processes: int = 1,
    lists: bool = False,
) -> None:
    """Print the memory estimate of a training run, from its first `scene`, the views' cameras, on the CPU, and the
    expected largest number of surfels. `texels`: options of those that learn, from `to_come` renders. `processes`: of
    equal need on this machine. `lists`: losses need lists of fragments on a GPU."""
    (pixels, total), device = _pixels(cameras), scene.surfels["means"].device
    on_gpu = device.type == "cuda"
    fragments = most_fragments(scene, cameras, scene.config.max_fragments)
    if on_gpu:
        lists = lists or scene.config.max_fragments > 0 or not can_rasterize(device)
        kept = min(photograph_budget(device), 9 * total)
    else:
        kept = PROGRAM + min(PHOTOGRAPH_BYTES, 3 * total) + min(DOWNSCALED_BYTES, 3 * total)  # at half size
    view = PER_PIXEL * pixels
    view += _per_fragment(scene, PER_GPU_FRAGMENT if lists else PER_PASSING_FRAGMENT) * fragments
    freed = max(FREED, KEPT_LISTS * PER_PIXEL * min(pixels, MOST_KEPT))
    needed = kept + view + (0 if on_gpu else min(KEPT_LISTS * view, freed))
    surfels = max(len(scene), most_surfels)
    grown = PER_SURFEL * surfels
    if texels is not None:  # they begin after the error prune
        most = min(VIEWS_OF_TEXELS * pixels / texels.pixels_per_texel, most_texels(texels, to_come * pixels))
        most = max(most, SMALLEST**2 * KEPT * surfels)
        grown = max(grown, KEPT * grown + (PER_TEXEL + on_gpu * PER_TEXEL_SUM) * most)
        grown += len(cameras) * KEPT * surfels  # of `Visibility`, at most
    needed += grown
    if on_gpu:  # a bound would bring lists, which take more
        fewer = f"train fewer surfels (--max-surfels {max(1, int(surfels / 2))})"
        advice = f"{fewer} or smaller photographs (--downscale-factor 2)"
    else:
        option = f"--pipeline.model.scene.max-fragments {max(1, fragments // 4)}"
        advice = f"draw views in smaller parts, which takes longer: {option}"
    needed *= 1 if on_gpu else processes
    _state("Training", (needed / SPREAD, needed * SPREAD), cameras, advice, device)


def state_export(
    scene: Scene, cameras: Sequence[Camera], finetune_bytes: float, learning: int = 0, compact: bool = False
) -> None:
    """Print the memory estimate of an export, from the training views' cameras, on the CPU. `finetune_bytes`: for the
    views that the fine-tuning keeps. `learning`: number of surfels that learn in the polish. `compact`: view colours
    are chosen by rate-distortion."""
    pixels, total = _pixels(cameras)
    kept = min(PHOTOGRAPH_BYTES, 3 * total)
    fragments = most_fragments(scene, cameras)
    if finetune_bytes < LEAST_KEPT * len(cameras) * (PER_KEPT_FRAGMENT * fragments + PER_KEPT_PIXEL * pixels):
        finetune_bytes = 0  # too few views would fit
    device = scene.surfels["means"].device
    needed = PROGRAM * (device.type != "cuda") + kept + PER_PIXEL * pixels
    needed += _per_fragment(scene, PER_BAKED_FRAGMENT) * fragments
    kind = scene.config.view_color
    entry = VIEW_COLORS[kind]
    terms = scene.surfels[entry.parameters[1].name].shape[1] - entry.base_terms
    chosen = choice_bytes(kind, len(scene), len(cameras), terms) if compact else 0
    seen = 4 * len(cameras) * len(scene)  # of `Visibility`
    needed += max(seen, chosen, finetune_bytes + PER_SURFEL * learning)  # one after the other
    if isinstance(scene.field, TexelField):
        needed += PER_BAKED_TEXEL * len(scene.field.texels)
    _state("The export", (needed, needed), cameras, "export with --finetune-memory 0, which takes longer", device)


def _per_fragment(scene: Scene, of_gpu: float) -> float:
    """Return the bytes per fragment; on a GPU `of_gpu`, or those of a list if a hash-grid field shades."""
    if scene.surfels["means"].device.type == "cuda":
        return PER_GPU_FRAGMENT if scene.config.texture == "hash" else of_gpu
    return PER_FRAGMENT + PER_SHADED_FRAGMENT * (scene.config.texture == "hash")


def _pixels(cameras: Sequence[Camera]) -> tuple[int, int]:
    sizes = [camera.width * camera.height for camera in cameras]
    return max(sizes), sum(sizes)


def _state(
    what: str, needed: tuple[float, float], cameras: Sequence[Camera], advice: str, device: torch.device
) -> None:
    """Print the need, from low to high; warn if the machine or GPU has less."""
    sizes = {(camera.width, camera.height) for camera in cameras}
    width, height = max(sizes, key=lambda size: size[0] * size[1])
    photographs = f"{len(cameras)} training photographs of {'up to ' * (len(sizes) > 1)}{width} x {height}"
    on_gpu = device.type == "cuda"
    memory, where = ("memory of the GPU", "the GPU") if on_gpu else ("memory", "this machine")
    (low, high), numbers = needed, "about {:.1f}"
    if low < high:
        numbers = "{:.2f} to {:.2f}"
    say(f"{what} will take {numbers.format(low / 1e9, high / 1e9)} GB of {memory} for {photographs}.")
    available = free_memory(device) if on_gpu else available_memory(psutil.Process().memory_info().rss)
    there = f"the {available / 1e9:.1f} GB that {where} has available"
    if low > available:
        warn(f"That is more than {there}. Close other programs, or {advice}.")
    elif low < high and high > FILLED * available:
        warn(f"Surfels and texels stop growing before they fill {there}.")
